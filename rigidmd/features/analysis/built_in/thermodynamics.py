"""Response functions from fluctuations: heat capacities, compressibility, thermal expansion and
thermal pressure coefficient.

Momenta are independent of positions and contribute exactly. Only fluctuations in potential energy,
volume and virial are measured, at the set temperature. See the theory chapter `sampling`.
"""

from collections.abc import Callable
from math import inf
from typing import NamedTuple

import numpy as np

from rigidmd.core.statistics import correlation_time, inefficiency
from rigidmd.errors import OutputError
from rigidmd.features.analysis.conditions import equilibrium
from rigidmd.features.analysis.registry import built_in
from rigidmd.features.analysis.result import AnalysisResult, Curve, converged_value, mean_of_series
from rigidmd.features.analysis.rigid_frames import RigidFrames
from rigidmd.features.analysis.runs import Runs
from rigidmd.units import BAR, BOLTZMANN, KJ_PER_MOL


class Unit(NamedTuple):
    name: str
    size: float  # in u, Å, ps, K; a mole is one molecule


UNITS = {
    "c_p": Unit("J/(mol K)", 1e-3 * KJ_PER_MOL),
    "kappa_T": Unit("1e-6/bar", 1e-6 / BAR),
    "alpha_p": Unit("1e-3/K", 1e-3),
    "c_v": Unit("J/(mol K)", 1e-3 * KJ_PER_MOL),
    "gamma_V": Unit("bar/K", BAR),
}
#: Minimum length of a run in correlation times: variances then have errors of 20 %, and a smaller
#: variance that comes with a smaller error does not matter.
LEAST = 100.0
#: Relative change of moments for the derivatives of what follows from them.
CHANGE = 1e-5
#: A running estimate starts at this fraction of a run, and has this number of points at most.
FIRST, POINTS = 0.05, 500
#: Largest fraction of a variance that the subtraction of the mean is taken to hide.
MOST_HIDDEN = 0.5


class Matter(NamedTuple):
    """The molecules that move, and their conditions; u, Å, ps, K."""

    thermal_energy: float  # kB T
    volume: float  # mean
    count: int
    mass: float
    momenta: float  # heat capacity of all momenta
    counted: float  # the same without the total momentum, if it is kept at zero

    @property
    def temperature(self) -> float:
        return self.thermal_energy / BOLTZMANN


#: One value, or an array of them.
Numbers = float | np.ndarray


class Fluctuations(NamedTuple):
    """Covariances of an energy x, in kT, with y.

    At constant volume: the potential energy, and the pressure of the virial, u/(Å ps²). At constant
    pressure: the potential energy with p V, and the volume, Å³.
    """

    y: Numbers  # mean
    xx: Numbers
    xy: Numbers
    yy: Numbers


def at_constant_volume(matter: Matter, of: Fluctuations) -> dict[str, Numbers]:
    """Responses in the canonical ensemble (Allen & Tildesley 2017, section 2.5)."""
    return {
        "c_v": (matter.momenta + BOLTZMANN * of.xx) / matter.count,
        "gamma_V": matter.count * BOLTZMANN / matter.volume + of.xy / matter.temperature,
    }


def at_constant_energy(matter: Matter, of: Fluctuations) -> dict[str, Numbers]:
    """The same from the fluctuations at constant energy, which are smaller by one factor (Lebowitz,
    Percus & Verlet 1967)."""
    factor = 1 / (1 - BOLTZMANN * of.xx / matter.counted)
    return at_constant_volume(matter, of._replace(xx=factor * of.xx, xy=factor * of.xy))


def at_constant_pressure(matter: Matter, of: Fluctuations) -> dict[str, Numbers]:
    """Responses at constant temperature and pressure (Lagache et al. 2001)."""
    at_same_volume = of.xx - of.xy**2 / of.yy
    return {
        "c_p": (matter.momenta + BOLTZMANN * of.xx) / matter.count,
        "kappa_T": of.yy / (matter.thermal_energy * of.y),
        "alpha_p": of.xy / (matter.temperature * of.y),
        "c_v": (matter.momenta + BOLTZMANN * at_same_volume) / matter.count,
        "gamma_V": BOLTZMANN * of.xy / of.yy,
    }


#: Ensemble -> its formulas. The piston of nph keeps the enthalpy, and is not among them.
RESPONSES: dict[str, Callable[[Matter, Fluctuations], dict[str, Numbers]]] = {
    "nvt": at_constant_volume,
    "nve": at_constant_energy,
    "npt": at_constant_pressure,
}


class Samples:
    """The samples of some runs.

    moments : of each run (5, l), means of x, y, x², xy and y² (see `Fluctuations`) where x and y
        are differences from their means: from those of all runs, but in nve from those of each run,
        as each has its energy
    hidden : covariances (3,) that these means hide
    """

    def __init__(self, runs: Runs):
        ensemble = runs.first.stage.ensemble
        self.formulas = RESPONSES[ensemble]
        self.matter = _matter_of(runs)
        pairs = [_pair_of(run) for run in runs.members]
        of_runs = [pair.mean(axis=1, keepdims=True) for pair in pairs]
        self.mean = runs.mean(of_runs)
        self.hidden = _hidden_covariances(pairs)
        if ensemble != "nve":
            of_runs = [self.mean] * len(pairs)
            self.hidden /= len(pairs)
        self.moments = []
        for pair, mean in zip(pairs, of_runs, strict=True):
            x, y = pair - mean
            self.moments.append(np.array([x, y, x * x, x * y, y * y]))
        self.mean_of_runs = [moments.mean(axis=1) for moments in self.moments]
        self.mean_of_all = runs.mean(self.mean_of_runs)
        self.names = [*UNITS] if ensemble == "npt" else ["c_v", "gamma_V"]
        if _why_no_pressure(runs):
            self.names.remove("gamma_V")

    def responses(self, moments: np.ndarray, fraction: Numbers = 1.0) -> np.ndarray:
        """The responses (r, ...) in their units.

        moments : means (5, ...) over a fraction of the samples
        """
        x, y, xx, xy, yy = moments
        covariances = np.array([xx - x * x, xy - x * y, yy - y * y])
        covariances = covariances.T + self.hidden / fraction
        found = Fluctuations(self.mean[1, 0] + y, *covariances.T)
        with np.errstate(divide="ignore", invalid="ignore"):
            values = self.formulas(self.matter, found)
        return np.array([values[name] / UNITS[name].size for name in self.names])

    def changes(self, run: int) -> np.ndarray:
        """What each sample of a run changes in the responses (r, l), to first order."""
        mean = self.mean_of_all[:, None]
        change = CHANGE * (self.moments[run] - mean)
        above, below = self.responses(mean + change), self.responses(mean - change)
        return (above - below) / (2 * CHANGE)


@built_in(
    "heat capacities, compressibility, thermal expansion, pressure coefficient",
    position=95,
    needs=(equilibrium,),
)
def response(runs: Runs) -> AnalysisResult:
    """Response functions from fluctuations: in nvt and nve c_v and the thermal pressure coefficient
    gamma_V = (dp/dT)_V. In npt also c_p, the compressibility kappa_T and the thermal expansion
    alpha_p.

    Heat capacities are classical. The error of one run is from the series of what each sample
    changes in a value to first order."""
    _check_conditions(runs)
    samples = Samples(runs)
    values = samples.responses(samples.mean_of_all)
    changes = [samples.changes(k) for k in range(len(runs.members))]
    errors: list[float | None]
    if runs.are_several:
        errors = runs.estimate(samples.mean_of_runs, samples.responses)[1].tolist()
    else:
        errors = [mean_of_series(runs, [series])[1] for series in changes[0]]
    times = [run.columns["time"] for run in runs.members]
    span = sum(float(time[-1] - time[0]) for time in times)
    interval = span / sum(len(time) - 1 for time in times)
    result = AnalysisResult("response", "response functions", notes=_notes(runs, samples.matter))
    per_gram = samples.matter.count / samples.matter.mass
    for k, name in enumerate(samples.names):
        unit = UNITS[name].name
        error = errors[k]
        tau = float(runs.mean([correlation_time(series[k], interval) for series in changes]))
        value = converged_value(name, unit, float(values[k]), error, span, tau, least=LEAST)
        result.values.append(value)
        if name.startswith("c_") and value.value is not None and value.error is not None:
            result.values.append(
                value._replace(
                    name=f"{name} per gram",
                    unit="J/(g K)",
                    value=per_gram * value.value,
                    error=per_gram * value.error,
                )
            )
    result.curves = _running_estimates(runs, samples)
    return result


def _check_conditions(runs: Runs) -> None:
    """Raise OutputError where fluctuations do not give response functions."""
    stage = runs.first.stage
    need = "response functions need"
    if min(len(run.columns["time"]) for run in runs.members) < 2:
        raise OutputError(f"{need} samples: set output.log_interval_ps to less than the run")
    if stage.ensemble not in RESPONSES:
        raise OutputError(
            f"{need} nvt, npt or nve: {stage.ensemble} keeps the enthalpy, and fluctuates otherwise"
        )
    if stage.ensemble == "nve" and not runs.has_box:
        raise OutputError(f"{need} a thermostat without a box, where the angular momentum is kept")
    if stage.ensemble == "npt":
        xx, *others = stage.pressures[0]
        if others != [xx, xx, 0.0, 0.0, 0.0] or stage.pressure_coupling in ("normal", "lateral"):
            raise OutputError(f"{need} one pressure on all sides of a box that changes along all")


def _why_no_pressure(runs: Runs) -> str:
    """Why the run has no pressure that follows from its energy, or an empty text if it has such a
    pressure."""
    if not runs.has_box:
        return "the run has no periodic box"
    names = ", ".join(runs.system.position_dependent)
    return f"the pressure does not contain {names}" if names else ""


def _matter_of(runs: Runs) -> Matter:
    freedom = runs.system.freedom
    count = sum(len(kind.index) for kind in runs.moving)
    return Matter(
        float(runs.mean([thermal_energy_of(run) for run in runs.members])),
        runs.volume if runs.has_box else inf,
        count,
        sum(kind.molecule.mass * len(kind.index) for kind in runs.moving),
        0.5 * BOLTZMANN * (3 * count + freedom.rotation),
        0.5 * BOLTZMANN * freedom.total,
    )


def thermal_energy_of(run: RigidFrames) -> float:
    """kB T of the thermostat, or the measured one without a thermostat."""
    stage = run.stage
    return BOLTZMANN * stage.temperatures[0] if stage.has_thermostat else run.thermal_energy


def _pair_of(run: RigidFrames) -> np.ndarray:
    """x and y in each sample (2, l), see `Fluctuations`."""
    stage, columns = run.stage, run.columns
    energy = KJ_PER_MOL * columns["potential"]
    other = np.zeros(len(columns["potential"]))
    if stage.ensemble == "npt":
        other = 1e3 * columns["volume"]
        energy = energy + BAR * stage.pressures[0][0] * other
    elif run.has_box:
        k = run.system.scene.stages.index(stage)
        freedom = run.system.freedom_in(k).translation + run.system.at_rest_in(k).sum()
        momenta = BOLTZMANN * freedom * columns["temperature_translation"]
        other = BAR * columns["pressure"] - momenta / (3 * run.mean_volume)
    return np.array([energy / thermal_energy_of(run), other])


def _hidden_covariances(pairs: list[np.ndarray]) -> np.ndarray:
    """Covariances (3,), xx, xy and yy, of the means of x and y over a run, mean over runs. Samples
    about these means scatter less by them."""
    hidden = []
    for pair in pairs:
        size = pair.std(axis=1)
        about = pair - pair.mean(axis=1, keepdims=True)
        x, y = about / np.where(size > 0, size, 1.0)[:, None]
        xy = (_variance_of_mean(x + y) - _variance_of_mean(x - y)) / 4
        relative = np.array([_variance_of_mean(x), xy, _variance_of_mean(y)])
        hidden.append(relative * size[[0, 0, 1]] * size[[0, 1, 1]])
    return np.mean(hidden, axis=0)


def _variance_of_mean(centred: np.ndarray) -> float:
    fraction = min(MOST_HIDDEN, inefficiency(centred) / len(centred))
    return fraction * float(np.mean(centred**2))


def _notes(runs: Runs, matter: Matter) -> list[str]:
    stage = runs.first.stage
    momenta = matter.momenta / matter.count / UNITS["c_v"].size
    notes = [
        f"{stage.ensemble} at {matter.temperature:.5g} K; of each heat capacity {momenta:.4g}"
        " J/(mol K) are of the momenta, which have no error"
    ]
    if stage.ensemble != "npt":
        notes.append("c_p, kappa_T and alpha_p need a stage with ensemble = 'npt'")
    if why := _why_no_pressure(runs):
        notes.append(f"no gamma_V: {why}")
    if len(runs.moving) < len(runs.kinds):
        notes.append("per mole and per gram of the molecules that are not frozen")
    if runs.system.thermostat is not None:
        notes.append("the user-defined thermostat is taken to sample the canonical ensemble")
    return notes


def _running_estimates(runs: Runs, samples: Samples) -> list[Curve]:
    """The responses so far against time, from the same part of all runs."""
    fewest = min(moments.shape[1] for moments in samples.moments)
    last = np.unique(np.linspace(int(FIRST * fewest), fewest - 1, POINTS).astype(int))
    sums = [np.cumsum(moments[:, :fewest], axis=1)[:, last] for moments in samples.moments]
    so_far = samples.responses(np.mean(sums, axis=0) / (last + 1), (last[:, None] + 1) / fewest)
    time = runs.first.columns["time"][last]
    curves = []
    for name, values in zip(samples.names, so_far, strict=True):
        title = f"{name} ({UNITS[name].name})"
        curves.append(
            Curve(f"response_{name}", ("Time (ps)", time), f"{title} so far", {title: values})
        )
    return curves
