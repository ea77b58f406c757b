"""Integrators as data: rows of flows such as kick, drift, thermostat and barostat, with fractions
of the time step. See the theory chapter `dynamics` for their orders and for the rows that need the
exact rotor."""

from itertools import pairwise, takewhile
from math import inf, log2
from typing import Literal, NamedTuple

#: Kinds of flows: forces; free flight and rotation; thermostat; removal of the total momentum;
#: barostat; change of the volume by the inertia of a piston; what the extension of a thermostat
#: does before and after some steps.
KICK, DRIFT, THERMOSTAT, REMOVE_MOMENTUM, BAROSTAT, SCALE_BOX, BEGIN, END = range(8)
#: Error of sums and mirrored fractions of a row, from printed coefficients.
ROUNDING = 1e-10


class Flow(NamedTuple):
    """One flow of a step."""

    kind: int  # KICK, DRIFT, ...
    fraction: (
        float  # of the time step; of `every` time steps for a flow that acts every `every` steps
    )
    # of a kick: tau/dt² of its gradient (dynamics.force_gradient), without its fraction
    gradient: float = 0.0
    every: int = 1  # it acts in one of `every` steps of a segment,
    phase: int = 1  # 1: in the last one of them, 0: in the first one

    def describe(self) -> str:
        """Description of a kick or drift for messages."""
        gradient = f", gradient {self.gradient:.12g}" if self.gradient else ""
        return f"{'kick' if self.kind == KICK else 'drift'} {self.fraction:.12g}{gradient}"


class _SchemeFields(NamedTuple):
    name: str
    flows: tuple[Flow, ...]  # kicks sum to 1, drifts too
    order: int
    exact_rotor: bool  # whether its order needs the exact rotor
    source: str
    thermostat: tuple | None = None  # with the flow THERMOSTAT (dynamics.thermostats)
    barostat: tuple | None = None  # with the flows BAROSTAT and SCALE_BOX (dynamics.barostats)
    is_default: bool = False  # whether `rigidmd accuracy` measures it by default
    auto: int = (
        0  # its position among the integrators that integrator = "auto" tries; 0: it is not tried
    )


class Scheme(_SchemeFields):
    """A step as a row of flows, with its name, order and requirements.

    Raises ValueError unless kicks and drifts each sum to 1 and read the same from both ends, so
    that the step is consistent and time-reversible.
    """

    __slots__ = ()

    def __new__(cls, *args, **kwargs):
        made = super().__new__(cls, *args, **kwargs)
        for what, fractions in (("drifts", made.drifts), ("kicks", made.kicks)):
            if not abs(sum(fractions) - 1) <= ROUNDING:
                wrong = f"its {what} sum to {sum(fractions):.12g}, not to 1"
                raise ValueError(
                    f"integrator {made.name}: {wrong}; odd() and even() complete a sum"
                )
        moving = [flow for flow in made.flows if flow.kind in (KICK, DRIFT)]
        for k, (one, other) in enumerate(zip(moving, reversed(moving), strict=True)):
            if not max(abs(a - b) for a, b in zip(one[:3], other[:3], strict=True)) <= ROUNDING:
                n = len(moving)
                pair = f"{one.describe()} and {other.describe()}"
                wrong = (
                    f"its flows {k + 1} and {n - k} of {n} differ ({pair}), so that it is not"
                    " time-reversible"
                )
                raise ValueError(
                    f"integrator {made.name}: {wrong}; odd() and even() mirror fractions"
                )
        return made

    def with_rotor(self, rotor: str | None) -> "Scheme":
        """This scheme with the named rotor ("split" or "exact"); unchanged for None."""
        return self if rotor is None else self._replace(exact_rotor=rotor == "exact")

    @property
    def has_thermostat(self) -> bool:
        """Whether the row itself contains a thermostat flow."""
        return any(flow.kind == THERMOSTAT for flow in self.flows)

    def with_thermostat(self, thermostat: tuple, halved: bool = False) -> "Scheme":
        """This scheme with a thermostat where its row has one; else half before and half after a
        step, or all after."""
        if self.has_thermostat:
            return self._replace(thermostat=thermostat)
        if halved:
            flows = (Flow(THERMOSTAT, 0.5), *self.flows, Flow(THERMOSTAT, 0.5))
            return self._replace(flows=flows, thermostat=thermostat)
        return self._replace(flows=(*self.flows, Flow(THERMOSTAT, 1.0)), thermostat=thermostat)

    def with_groups(self, thermostat: tuple, steps: int) -> "Scheme":
        """This scheme with a thermostat that acts before every `steps` steps, and with what its
        extension does before and after them."""
        begins = (
            Flow(THERMOSTAT, 1.0, every=steps, phase=0),
            Flow(BEGIN, 0.0, every=steps, phase=0),
        )
        flows = (*begins, *self.flows, Flow(END, 0.0, every=steps))
        return self._replace(flows=flows, thermostat=thermostat)

    def with_barostat(self, barostat: tuple, every: int) -> "Scheme":
        """This scheme with a barostat that acts at the end of every `every` steps."""
        return self._replace(
            flows=(*self.flows, Flow(BAROSTAT, float(every), every=every)), barostat=barostat
        )

    def with_piston(self, piston: tuple) -> "Scheme":
        """This scheme, a composition of Verlet steps, with a volume that has inertia: volume kicks
        around the kicks of each step, and volume changes around the drift. See the theory chapter
        `sampling`."""
        steps = self.drifts
        flows = []
        for before, after in pairwise((0.0, *steps, 0.0)):
            flows += [
                Flow(KICK, before / 2),
                Flow(BAROSTAT, (before + after) / 2),
                Flow(KICK, after / 2),
            ]
            flows += [Flow(SCALE_BOX, after / 2), Flow(DRIFT, after), Flow(SCALE_BOX, after / 2)]
        return self._replace(flows=tuple(flow for flow in flows if flow.fraction), barostat=piston)

    def with_momentum_removal(self, every: int) -> "Scheme":
        """This scheme with the total momentum of all molecules removed at the end of every `every`
        steps."""
        return self._replace(flows=(*self.flows, Flow(REMOVE_MOMENTUM, 0.0, every=every)))

    @property
    def has_groups(self) -> bool:
        """Whether its thermostat has an extension (dynamics.step_parts.StepExtension)."""
        return any(flow.kind == BEGIN for flow in self.flows)

    @property
    def variables(self) -> int:
        """How many numbers its thermostat and its barostat have in `state.extra_variables`."""
        return sum(getattr(flow, "variables", 0) for flow in (self.thermostat, self.barostat))

    @property
    def kicks(self) -> tuple[float, ...]:
        return tuple(flow.fraction for flow in self.flows if flow.kind == KICK)

    @property
    def drifts(self) -> tuple[float, ...]:
        return tuple(flow.fraction for flow in self.flows if flow.kind == DRIFT)

    @property
    def kinetic_correction(self) -> float:
        """The number c in the kinetic energy K + c dt² (sum F²/m + sum n²/I) of temperatures and
        pressures, with K at the ends of steps.

        With a thermostat it is the mean kinetic energy where the thermostat acts, without one that
        without an error of order dt². See "Temperatures" in the theory chapter `zero_step`.
        """
        kinds = [flow.kind for flow in self.flows]
        if END in kinds:
            return 0.0  # steps that are accepted or rejected together have no time-step error
        if THERMOSTAT not in kinds:
            return self.shadow_correction
        last = len(kinds) - kinds[::-1].index(THERMOSTAT)
        drifted = kicked = lever = 0.0  # from the end of the step backwards
        for flow in reversed(self.flows[last:]):
            if flow.kind == DRIFT:
                drifted += flow.fraction
            elif flow.kind == KICK:
                kicked += flow.fraction
                lever += flow.fraction * drifted
        return kicked**2 / 2 - lever

    @property
    def shadow_correction(self) -> float:
        """Like `kinetic_correction`, for the temperature of the shadow Hamiltonian; 0 from order 4
        on."""
        drifted = moment = 0.0
        for flow in self.flows:
            if flow.kind == DRIFT:
                drifted += flow.fraction
            elif flow.kind == KICK:
                moment += flow.fraction * drifted * (1 - drifted)
        return (1 / 6 - moment) / 2

    @property
    def shadow_squares(self) -> float:
        """The number in the shadow Hamiltonian, H + dt² [shadow_correction p U'' p +
        shadow_squares (sum F²/m + sum n²/I)]; 0 from order 4 on."""
        kicked = moment = gradients = 0.0
        for flow in self.flows:
            if flow.kind == KICK:
                kicked += flow.fraction
                gradients += flow.fraction * flow.gradient
            elif flow.kind == DRIFT:
                moment += flow.fraction * kicked * (1 - kicked)
        return (1 / 6 - moment - gradients) / 2

    @property
    def has_gradient(self) -> bool:
        return any(flow.gradient for flow in self.flows)

    @property
    def force_evaluations(self) -> int:
        """Force evaluations per step: one after each drift, and one more for each gradient. A kick
        uses what kicks since the last drift have evaluated, in the step before too."""
        return self._evaluations_in(2) - self._evaluations_in(1)

    def _evaluations_in(self, steps: int) -> int:
        """Force evaluations of a run of a number of steps."""
        # gradients of the forces at the current positions: 0, and the last one
        count, known = 0, set[float]()
        for flow in self.flows * steps:
            if flow.kind == DRIFT:
                known.clear()
            elif flow.kind == KICK:
                count += len({0.0, flow.gradient} - known)
                known = {0.0, flow.gradient} if flow.gradient else known | {0.0}
        return count


def composed(name: str, steps: tuple[float, ...], order: int, source: str, **flags: int) -> Scheme:
    """Velocity Verlet steps of these lengths in succession; neighbouring kicks are merged."""
    kicks = tuple((a + b) / 2 for a, b in pairwise((0.0, *steps, 0.0)))
    return Scheme(
        name, _alternating(kicks, steps), order, exact_rotor=False, source=source, **flags
    )


def split(
    name: str,
    kicks: tuple[float, ...],
    drifts: tuple[float, ...],
    order: int,
    source: str,
    gradients: tuple[float, ...] | None = None,
    **flags: int,
) -> Scheme:
    """kick(kicks[0] dt) drift(drifts[0] dt) ... kick(kicks[-1] dt), for an exact rotor.

    gradients : of each kick, see `Flow.gradient`
    """
    if len(kicks) != len(drifts) + 1 or (gradients is not None and len(gradients) != len(kicks)):
        counts = f"{len(kicks)} kicks, {len(drifts)} drifts" + (
            f", {len(gradients)} gradients" if gradients else ""
        )
        wrong = f"{counts}: kicks must be one more than drifts, and gradients as many as kicks"
        raise ValueError(f"integrator {name}: {wrong}; a fraction may be 0")
    return Scheme(
        name,
        _alternating(kicks, drifts, gradients),
        order,
        exact_rotor=True,
        source=source,
        **flags,
    )


def _alternating(
    kicks: tuple[float, ...], drifts: tuple[float, ...], gradients: tuple[float, ...] | None = None
) -> tuple[Flow, ...]:
    """Kick, drift, ..., kick, without flows of length 0."""
    flows = []
    for k, (kick, tau) in enumerate(zip(kicks, gradients or (0.0,) * len(kicks), strict=True)):
        flows.append(Flow(KICK, kick, tau))
        flows += [Flow(DRIFT, drift) for drift in drifts[k : k + 1]]
    return tuple(flow for flow in flows if flow.fraction)


def odd(*half: float) -> tuple[float, ...]:
    """Fractions mirrored about a single middle one that makes their sum 1."""
    return (*half, 1 - 2 * sum(half), *reversed(half))


def even(*half: float) -> tuple[float, ...]:
    """Fractions mirrored about two equal middle ones that make their sum 1."""
    half = (*half, 0.5 - sum(half))
    return (*half, *reversed(half))


def measured_order(scheme: Scheme) -> float:
    """Order of the error for the force -x - x^3, from one step and two of half the length. Steps
    are the shortest at which rounding does not dominate. The order may be lower for other
    forces."""
    lengths = [0.4 / 2**k for k in range(7)]
    errors = [abs(_oscillate(scheme, h, 1) - _oscillate(scheme, h / 2, 2)) for h in lengths]
    errors = list(takewhile(lambda error: error > 3e-14, errors))
    return log2(errors[-2] / errors[-1]) - 1 if len(errors) > 1 else inf


def _oscillate(scheme: Scheme, h: float, steps: int) -> complex:
    """Position + i velocity of an oscillator with the force -x - x^3 after steps of h."""
    x, v = 0.6, 0.7
    for flow in scheme.flows * steps:
        if flow.kind == DRIFT:
            x += flow.fraction * h * v
        else:
            v -= flow.fraction * h * (x + x * x * x) * (1 - flow.gradient * h * h * (1 + 3 * x * x))
    return complex(x, v)


Rotor = Literal["split", "exact"]
AUTO = "auto"  # instead of a name: pilot runs find the cheapest integrator for an accuracy


def auto_errors(
    integrator: str, requested: dict[str, float | None], unused: list[str]
) -> list[str]:
    """Conflicts between an integrator, the requested errors (key -> value) and keys that pilot runs
    decide."""
    set_keys = [key for key, value in requested.items() if value is not None]
    if integrator != AUTO:
        if set_keys:
            return [f"{', '.join(set_keys)} would have no effect without integrator = 'auto'"]
        return []
    if unused:
        errors = [
            f"{', '.join(unused)} would have no effect with integrator = 'auto', which chooses it"
        ]
    else:
        errors = []
    if len(set_keys) != 1:
        errors.append(f"integrator = 'auto' needs one of {', '.join(requested)}")
    return errors


#: General ODE solvers for the textbook equations, and the variables of attitude for them.
RK4, DOP853, RADAU = "rk4", "dop853", "radau"
SOLVERS = (RK4, DOP853, RADAU)
FORMULATIONS = ("matrix", "quaternion", "euler_angles")


class Solver(NamedTuple):
    """A general ODE solver instead of a scheme of flows."""

    name: str  # RK4, DOP853 or RADAU
    formulation: str  # of FORMULATIONS
    duration: float = 1.0  # of the whole run
    relative_tolerance: float = 1e-12  # of DOP853 and RADAU
    absolute_tolerance: float = (
        1e-12  # of DOP853 and RADAU, relative to the sizes of the variables in this run
    )


BLANES_MOAN = "Blanes & Moan 2002, J. Comput. Appl. Math. 142, 313"
KAHAN_LI = "Kahan & Li 1997, Math. Comp. 66, 1089; Hairer, Lubich & Wanner, section V.3"
OMELYAN = "Omelyan, Mryglod & Folk 2002, Comput. Phys. Commun. 146, 188"

SCHEMES = {
    scheme.name: scheme
    for scheme in (
        composed(
            "velocity_verlet",
            (1.0,),
            order=2,
            source=(
                "Swope et al. 1982, J. Chem. Phys. 76, 637; for rigid bodies Dullweber et al. 1997"
            ),
            is_default=True,
            auto=3,
        ),
        split(
            "position_verlet",
            (0.0, 1.0, 0.0),
            (0.5, 0.5),
            order=2,
            source="Tuckerman, Berne & Martyna 1992, J. Chem. Phys. 97, 1990",
        ),
        split(
            "two_stage",
            odd(0.1931833275037836),
            (0.5, 0.5),
            order=2,
            source=(
                "McLachlan 1995, SIAM J. Sci. Comput. 16, 151; van Zon, Omelyan & Schofield 2008"
            ),
            is_default=True,
            auto=2,
        ),
        composed(
            "yoshida_4",
            odd(1.3512071919596578),
            order=4,
            source="Yoshida 1990, Phys. Lett. A 150, 262",
        ),
        composed(
            "suzuki_4",
            odd(0.4144907717943757, 0.4144907717943757),
            order=4,
            source="Suzuki 1990, Phys. Lett. A 146, 319",
            is_default=True,
            auto=6,
        ),
        split(
            "pefrl",
            (0.0, *even(0.7123418310626054), 0.0),
            odd(0.1786178958448091, -0.06626458266981849),
            order=4,
            source=OMELYAN,
            is_default=True,
            auto=4,
        ),
        split(
            "vefrl",
            odd(0.1644986515575760, 1.235692651138917),
            even(0.52094339103989808),
            order=4,
            source=OMELYAN,
        ),
        split(
            "blanes_moan_4",
            (0.0, *even(0.209515106613362, -0.143851773179818), 0.0),
            odd(0.0792036964311957, 0.353172906049774, -0.0420650803577195),
            order=4,
            source=f"{BLANES_MOAN}, S6",
        ),
        split(
            "srkn_4",
            odd(0.0829844064174052, 0.396309801498368, -0.0390563049223486),
            even(0.245298957184271, 0.604872665711080),
            order=4,
            source=f"{BLANES_MOAN}, SRKN6b",
            is_default=True,
            auto=1,
        ),
        split(
            "takahashi_imada",
            (0.0, 1.0, 0.0),
            (0.5, 0.5),
            order=2,
            source=(
                "Takahashi & Imada 1984, J. Phys. Soc. Jpn. 53, 3765; of order 4 but for a change"
                " of variables"
            ),
            gradients=(0.0, 1 / 12, 0.0),
        ),
        split(
            "chin_4a",
            odd(1 / 6),
            (0.5, 0.5),
            order=4,
            source="Chin 1997, Phys. Lett. A 226, 344, scheme A",
            gradients=(0.0, 1 / 24, 0.0),
            is_default=True,
        ),
        composed(
            "kahan_li_6",
            odd(
                0.39216144400731413928,
                0.33259913678935943860,
                -0.70624617255763935981,
                0.082213596293550800230,
            ),
            order=6,
            source=f"{KAHAN_LI}, s9odr6a",
            is_default=True,
            auto=7,
        ),
        split(
            "blanes_moan_6",
            (
                0.0,
                *even(0.148816447901042, -0.132385865767784, 0.067307604692185, 0.432666402578175),
                0.0,
            ),
            odd(
                0.0502627644003922,
                0.413514300428344,
                0.0450798897943977,
                -0.188054853819569,
                0.541960678450780,
            ),
            order=6,
            source=f"{BLANES_MOAN}, S10",
        ),
        split(
            "srkn_6",
            even(
                0.0414649985182624,
                0.198128671918067,
                -0.0400061921041533,
                0.0752539843015807,
                -0.0115113874206879,
            ),
            odd(
                0.123229775946271,
                0.290553797799558,
                -0.127049212625417,
                -0.246331761062075,
                0.357208872795928,
            ),
            order=6,
            source=f"{BLANES_MOAN}, SRKN11b",
            is_default=True,
            auto=5,
        ),
        composed(
            "kahan_li_8",
            odd(
                0.13020248308889008088,
                0.56116298177510838456,
                -0.38947496264484728641,
                0.15884190655515560090,
                -0.39590389413323757734,
                0.18453964097831570709,
                0.25837438768632204729,
                0.29501172360931029887,
            ),
            order=8,
            source=f"{KAHAN_LI}, s17odr8a",
            is_default=True,
            auto=8,
        ),
    )
}

#: Rows that contain a thermostat flow and need a thermostat.
WITH_THERMOSTAT = {
    "baoab": Scheme(
        "baoab",
        (
            Flow(KICK, 0.5),
            Flow(DRIFT, 0.5),
            Flow(THERMOSTAT, 1.0),
            Flow(DRIFT, 0.5),
            Flow(KICK, 0.5),
        ),
        order=2,
        exact_rotor=False,
        source=(
            "Leimkuhler & Matthews 2013, Appl. Math. Res. Express 34; for rigid bodies Davidchack"
            " et al. 2015"
        ),
    )
}
