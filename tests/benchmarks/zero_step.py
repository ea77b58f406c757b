"""U of water with a step and at a step of zero: 267 SPC/E of NIST's Monte Carlo, by methods and steps.

    python tests/benchmarks/zero_step.py --to runs/zero_step --ns 8
    python tests/benchmarks/zero_step.py --to runs/zero_step --collect

Each run continues where it was stopped. The table has U per molecule (kJ/mol) as measured, what the
step adds to it by `rigidmd analyse RUN zero_step`, and their difference. `zero_step.png` is drawn
next to the runs.
"""

from pathlib import Path
from typing import NamedTuple

from command_line import SMOKE, new_parser, read_options

from rigidmd import Results, Scene, Simulation, read_run
from rigidmd.errors import OutputError
from rigidmd.features.view.figures.style import (
    FAINT,
    INK,
    PALETTE,
    TEXT,
    TITLE,
    new_figure,
    open_axis,
    save_files,
)

#: U of Monte Carlo (kJ/mol) and its error: NIST SRSW, 17 windows about 267 molecules, by a parabola.
MONTE_CARLO = (-46.728, 0.003)
COUNT, EDGE = (27, 11.0) if SMOKE else (267, 20.0)
SITES = [
    {"name": "OW", "element": "O", "mass_u": 15.9994, "position_A": [0.0, 0.0, 0.0]}
    | {"charge_e": -0.8476, "sigma_A": 3.16555789, "epsilon_K": 78.19743111},
    *(
        {"name": name, "element": "H", "mass_u": 1.00794, "charge_e": 0.4238}
        | {"position_A": [x, 0.57735896651553, 0.0]}
        for name, x in (("HW1", 0.816490430920117), ("HW2", -0.816490430920117))
    ),
]


class Method(NamedTuple):
    title: str
    color: str
    steps: tuple[float, ...]  # fs
    keys: dict


METHODS = {
    "baoab": Method("baoab (the default)", PALETTE["cool"], (1.0, 2.0, 4.0), {}),
    "velocity_verlet": Method(
        "velocity_verlet", PALETTE["warm"], (4.0,), {"integrator": "velocity_verlet"}
    ),
    "hybrid_monte_carlo": Method(
        "hybrid Monte Carlo",
        PALETTE["green"],
        (2.0,),
        {"thermostat": "hybrid_monte_carlo", "trajectory_steps": 50},
    ),
}


def scene(keys: dict, step: float, ns: float) -> Scene:
    stage = {"ensemble": "nvt", "temperature_K": 300.0}
    at_step = stage | keys | {"timestep_fs": step, "duration_ps": 1000 * ns}
    forces = {"cutoff_A": EDGE / 2, "truncation": "plain", "electrostatics": "pme"}
    forces |= {"ewald_cutoff_A": EDGE / 2, "ewald_alpha_per_A": 5.6 / EDGE, "tail_correction": True}
    tested = "thermostat" in keys
    return Scene.from_dict(
        {
            "box": {"lengths_A": EDGE},
            "molecules": [{"name": "water", "count": COUNT, "sites": SITES}],
            "forces": forces,
            "stages": [
                {"ensemble": "minimise"},
                stage | {"timestep_fs": 4.0, "duration_ps": 2.0 if SMOKE else 40.0},
                at_step,
            ],
            "output": {"trajectory": False, "log_interval_ps": 0.1 if tested else 0.02},
        }
    )


def run_all(folder: Path, ns: float) -> None:
    for name, method in METHODS.items():
        for step in method.steps:
            made = scene(method.keys, step, ns)
            Simulation(made, folder / f"{name}-{step:g}", resume=True).run()


class Point(NamedTuple):
    method: str
    step: float
    ns: float
    raw: tuple[float, float]
    at_zero: tuple[float, float] | None


def point(method: str, step: float, results: Results) -> Point:
    time = results["time"]
    raw = results.mean("potential_energy")[:2]
    try:
        at_zero = results.mean("potential_energy", zero_step=True)[:2]
    except OutputError as error:
        print(f"{method} at {step:g} fs: {error}")
        at_zero = None
    return Point(method, step, float(time[-1]) / 1000, raw, at_zero)


def draw(points: list[Point], images: Path) -> None:
    """U against the square of the step; lines lead to the value at zero from the same run. On the right
    the part about zero."""
    figure = new_figure(7.2, 3.6)
    value, error = MONTE_CARLO
    for axis, limits in zip(figure.subplots(1, 2), (None, (-46.79, -46.66)), strict=True):
        axis.axhspan(
            value - error, value + error, color=FAINT, alpha=0.3, lw=0, label="Monte Carlo (NIST)"
        )
        for name, method in METHODS.items():
            of = [at for at in points if at.method == name]
            style = {"color": method.color, "ls": "none", "capsize": 2.5, "ms": 5}
            for k, at in enumerate(of):
                label = None if k else method.title
                square = at.step**2 if at.at_zero else 0.0
                axis.errorbar(square, *at.raw, marker="o", label=label, **style)
                if at.at_zero:
                    label = None if k else f"{method.title}, at zero from that run"
                    place = -0.25 * (k + 1) if name == "baoab" else -1.1
                    axis.errorbar(place, *at.at_zero, marker="D", mfc="none", label=label, **style)
                    ends = (square, place), (at.raw[0], at.at_zero[0])
                    axis.plot(*ends, color=method.color, lw=0.7, ls=":")
        axis.set_ylim(limits)
        axis.set_xlabel("Δt² (fs²)", fontsize=TITLE, color=INK)
        open_axis(axis, labelsize=TEXT)
    axis = figure.axes[0]
    axis.set_ylabel("U (kJ/mol per molecule)", fontsize=TITLE, color=INK)
    axis.legend(fontsize=TEXT, frameon=False, loc="upper left", labelcolor=INK)
    save_files(figure, images / "zero_step", ["png"])


def main() -> None:
    parser = new_parser(__doc__)
    parser.add_argument("--ns", type=float, default=8.0, help="length of each run, ns")
    parser.add_argument("--collect", action="store_true", help="run nothing")
    options = read_options(parser, Path("runs/zero_step"), ns=0.02)
    if not options.collect:
        run_all(options.to, options.ns)
    folders = {
        (name, step): options.to / f"{name}-{step:g}"
        for name, method in METHODS.items()
        for step in method.steps
    }
    points = [
        point(name, step, read_run(folder))
        for (name, step), folder in folders.items()
        if folder.is_dir()
    ]
    print(f"{'method':20}  fs     ns   U                   what the step adds   U at zero")
    for at in points:
        text = f"{at.method:20} {at.step:3g} {at.ns:6.2f}   {at.raw[0]:.4f} ± {at.raw[1]:.4f}"
        if at.at_zero:
            added = at.raw[0] - at.at_zero[0]
            text += f"   {added:+.4f}              {at.at_zero[0]:.4f} ± {at.at_zero[1]:.4f}"
        print(text)
    draw(points, options.to)


if __name__ == "__main__":
    main()
