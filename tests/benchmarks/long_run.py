"""The rounding errors of 1e8 steps: how |L|, the energy and the orthogonality of Q change, in
double and mixed precision.

    python tests/benchmarks/long_run.py top_exact top_split heavy_top dimer_double dimer_mixed
    dimer_6_double dimer_6_mixed
    python tests/benchmarks/long_run.py            # draws the figure and prints the table

writes evidence/data/long_run.json and images/long_run.png in rigidmd/docs, or the folder of --to. A curve is the
root mean square change of a quantity in n steps, over all pairs of samples n steps from each other in one
run: a random walk of rounding errors has slope 1/2 (Brouwer 1937), a drift slope 1, a bounded error
slope 0. The change over the whole run is one number besides.
"""

import json
import sys
import time
from pathlib import Path

import numpy as np
from command_line import SMOKE, new_parser, read_options
from matplotlib.ticker import NullFormatter

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd import Scene, Simulation
from rigidmd.core.integrators import SCHEMES
from rigidmd.features.bodies.trials import body_trial_system
from rigidmd.features.view.figures.style import (
    DASHES,
    FAINT,
    INK,
    TEXT,
    TITLE,
    curve_style,
    new_figure,
    open_axis,
    save_files,
)
from rigidmd.run.trial_systems import molecular_trial_system

ROOT = Path(__file__).parents[2]
DOCS, FILE = ROOT / "rigidmd" / "docs", "long_run.json"
SMOKE_STEPS = 4000
#: Name -> text of the legend, scene, overrides, integrator, rotor, time step (s or fs), steps.
CASES = {
    "top_exact": (
        "free top, exact rotor",
        "free_asymmetric_top",
        {},
        "velocity_verlet",
        "exact",
        0.1,
        10**8,
    ),
    "top_split": (
        "free top, split rotor",
        "free_asymmetric_top",
        {},
        "velocity_verlet",
        "split",
        0.1,
        10**8,
    ),
    "heavy_top": ("heavy top, srkn_6", "heavy_top_3", {}, "srkn_6", "exact", 0.002, 10**8),
    "dimer_double": (
        "two waters, velocity_verlet, double",
        "water_dimer",
        {"precision": "double"},
        "velocity_verlet",
        "exact",
        0.5,
        10**8,
    ),
    "dimer_mixed": (
        "two waters, velocity_verlet, mixed",
        "water_dimer",
        {"precision": "mixed"},
        "velocity_verlet",
        "exact",
        0.5,
        2 * 10**7,
    ),
    "dimer_6_double": (
        "two waters, srkn_6, double",
        "water_dimer",
        {"precision": "double"},
        "srkn_6",
        "exact",
        0.5,
        10**7,
    ),
    "dimer_6_mixed": (
        "two waters, srkn_6, mixed",
        "water_dimer",
        {"precision": "mixed"},
        "srkn_6",
        "exact",
        0.5,
        10**6,
    ),
}
QUANTITIES = {
    "L": "angular momentum, relative",
    "energy": "energy / kinetic energy",
    "QTQ": "orthogonality, QᵀQ per entry",
}
#: Samples 10 steps from each other at the start, then evenly over the run.
FINE, COARSE = (100, 100) if SMOKE else (1000, 20_000)
FITTED = (1e3, 1e7)  # steps between which a slope is fitted


def trial_system(scene: str, overrides: dict, rotor: str):
    """The start of a scene with its methods, and the same in double precision, which measures
    energies."""

    def read(more):
        return Scene.read(ROOT / "systems" / f"{scene}.toml", more)

    if "top" in scene:
        system = body_trial_system(read(overrides))[0]
        return system, system
    simulations = [
        Simulation(read(more | {"threads": 1})) for more in (overrides, {"precision": "double"})
    ]
    return [molecular_trial_system(s.system, s.state, rotor, 0.1) for s in simulations]


def run(name: str) -> dict:
    """Run a case; root mean square changes over lags, changes over the whole run, and seconds."""
    _, scene, overrides, integrator, rotor, step, steps = CASES[name]
    steps = SMOKE_STEPS if SMOKE else steps
    system, in_double = trial_system(scene, overrides, rotor)
    method = system.methods[integrator]
    scheme, engine, judge = (
        SCHEMES[integrator].with_rotor(rotor),
        method.engine(step),
        in_double.methods[integrator].engine(step),
    )
    state, mass = engine.begin(system.state, scheme), None
    if "top" not in scene:
        model = Simulation(Scene.read(ROOT / "systems" / f"{scene}.toml", overrides)).system.model
        mass = model.mass[model.species]

    def momenta() -> np.ndarray:
        found = np.einsum("nij,nj->ni", state.rotation, state.angular_momentum_body)
        return (
            found
            if mass is None
            else found + np.cross(state.position, mass[:, None] * state.velocity)
        )

    size = np.linalg.norm(momenta(), axis=1).sum()

    def sample() -> np.ndarray:
        total = momenta().sum(axis=0) / size
        if scene.startswith("heavy"):
            total[:2] = 0.0  # gravity changes them
        # Q Q' has the size of the error of Q'Q, and does not change when a rotation multiplies Q
        # from the right
        gram = np.einsum("nij,nkj->nik", state.rotation, state.rotation) - np.eye(3)
        return np.concatenate(
            [total, [in_double.energy(judge, state) / system.kinetic], gram.ravel()]
        )

    began, rows = time.perf_counter(), [sample()]
    spacing = steps // COARSE
    wanted = [*range(10, 10 * FINE, 10), *range(10 * FINE, steps + 1, spacing)]
    for n in wanted:
        engine.advance(state, scheme, step * system.time_size, n)
        rows.append(sample())
    seconds = time.perf_counter() - began
    fine, coarse = np.array(rows[: FINE + 1]), np.array(rows[FINE:])
    columns = {"L": slice(0, 3), "energy": slice(3, 4), "QTQ": slice(4, None)}
    print(f"{name}: {seconds:.0f} s", flush=True)
    found = {
        "steps": steps,
        "timestep": step,
        "seconds": round(seconds, 1),
        "changes": {},
        "whole": {},
    }
    for quantity, part in columns.items():
        changes = {}
        for values, apart in ((fine[:, part], 10), (coarse[:, part], spacing)):
            for lag in np.unique(np.geomspace(1, len(values) // 4, 30).astype(int)):
                moved = values[lag:] - values[:-lag]
                entries = values.shape[1] if quantity == "QTQ" else 1
                changes[int(lag) * apart] = float(np.sqrt((moved**2).sum(axis=1).mean() / entries))
        found["changes"][quantity] = [[n, float(f"{changes[n]:.3g}")] for n in sorted(changes)]
        whole = (coarse[-1] - fine[0])[part]
        found["whole"][quantity] = float(f"{np.abs(whole).max():.3g}")
    return found


def fitted_slope(changes: list) -> float:
    """Exponent of the growth with the number of steps."""
    n, change = np.array(changes or [[1, 0]]).T
    kept = (n >= FITTED[0]) & (n <= FITTED[1]) & (change > 0)
    return (
        float(np.polyfit(np.log(n[kept]), np.log(change[kept]), 1)[0]) if kept.sum() > 2 else np.nan
    )


#: Power of the number of steps, dashes and label of the lines of comparison.
GROWTHS = ((0.5, DASHES[1], "random walk, √n"), (1.0, DASHES[2], "drift, n"))


def draw(cases: dict, images: Path) -> None:
    """Root mean square change over steps, a panel for each quantity."""
    figure = new_figure(7.2, 7.0)
    axes = figure.subplots(3, 1, sharex=True)
    for axis, (quantity, title) in zip(axes, QUANTITIES.items(), strict=True):
        for k, name in enumerate(case for case in CASES if case in cases):
            points = [point for point in cases[name]["changes"].get(quantity, []) if point[1] > 0]
            n, change = np.array(points or [[np.nan] * 2]).T
            axis.loglog(n, change, ms=2.5, lw=1.1, label=CASES[name][0], **curve_style(k))
        axis.set_title(f"change of {title}", loc="left", fontsize=TITLE, color=INK)
        axis.set_xlim(10, 1e8)
        low, high = axis.get_ylim()
        n = np.array([1e1, 1e8])
        for power, dashes, label in GROWTHS if quantity != "QTQ" else ():
            line = 3 * low * (n / 10) ** power
            axis.loglog(n, line, color=FAINT, lw=0.9, ls=(0, dashes), label=label)
        axis.set_ylim(*((1e-16, 1e-14) if quantity == "QTQ" else (low, high)))
        axis.yaxis.set_minor_formatter(NullFormatter())
        open_axis(axis, labelsize=TEXT)
    axes[-1].set_xlabel("steps n", color=INK, fontsize=TITLE)
    style = {"frameon": False, "fontsize": TEXT, "labelcolor": INK, "handlelength": 2.8}
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, **style
    )
    save_files(figure, images / "long_run", ["png"])


def table(cases: dict) -> str:
    """Slopes and changes over the whole run, and the plateau of the orthogonality, in Markdown."""
    lines = [
        "| run | steps | L: slope | in all | energy: slope | in all | QᵀQ: plateau |",
        "|" + "---|" * 7,
    ]
    for name in (case for case in CASES if case in cases):
        found = cases[name]
        cells = [
            f"{fitted_slope(found['changes'].get(q, [])):.2f} | {found['whole'][q]:.1e}"
            for q in ("L", "energy")
        ]
        cells.append(f"{found['changes'].get('QTQ', [[1, 0.0]])[-1][1]:.1e}")
        lines.append(f"| {CASES[name][0]} | {found['steps']:.0e} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Run the cases, draw and print all."""
    parser = new_parser(__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    options = read_options(parser, DOCS, cases=list(CASES))
    data, images = options.to / "evidence" / "data" / FILE, options.to / "images"
    for folder in (data.parent, images):
        folder.mkdir(parents=True, exist_ok=True)
    for name in options.cases:
        found = run(name)
        cases = json.loads(data.read_text()) if data.is_file() else {}
        data.write_text(
            json.dumps(cases | {name: found}, indent=1)
            .replace("\n    ", " ")
            .replace("\n   ]", "]")
            + "\n"
        )
    cases = json.loads((data if data.is_file() else DOCS / "evidence" / "data" / FILE).read_text())
    draw(cases, images)
    print(table(cases))


if __name__ == "__main__":
    main()
