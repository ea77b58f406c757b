"""Error against run time of a heavy top, every integrator of the engine and SciPy's DOP853,
alternating in one run.

    python tests/benchmarks/single_body.py
    python tests/benchmarks/single_body.py --draw      # only the figure and the table, from data of the documentation

writes evidence/data/single_body.csv and images/single_body.png in rigidmd/docs, or the folder of
--to, and prints the table of the benchmarks. The top is that of systems/heavy_top_3.toml for 20 nutations; the error is that of Q at
the end against the elliptic solution. SciPy solves the 12-variable system (direction cosines and
angular velocity) once with a right-hand side in plain Python as a user would write it, once through
this engine (integrator = "dop853"). Medians of five; one thread.
"""

import csv
import sys
import time
from pathlib import Path
from statistics import median

import numpy as np
from command_line import SMOKE, new_parser, read_options, shown
from scipy.integrate import solve_ivp

sys.path.insert(0, str(Path(__file__).parents[1]))

from support import known

from rigidmd.core.integrators import SCHEMES, Solver
from rigidmd.features.bodies.ode.engine import OdeEngine
from rigidmd.features.view.figures.style import (
    INK,
    TEXT,
    TITLE,
    curve_style,
    new_figure,
    open_axis,
    save_files,
)
from rigidmd.run import Simulation
from rigidmd.scene import Scene

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "rigidmd" / "docs"
DATA, FILE = DOCS / "evidence" / "data", "single_body.csv"
NUTATIONS, REPEATS = (2, 1) if SMOKE else (20, 5)
SPEED_STEPS = 1000 if SMOKE else 1_000_000
STEPS = {  # per nutation
    "velocity_verlet": (60, 100, 300, 1000, 3000, 10000, 30000, 100000),
    "suzuki_4": (10, 15, 30, 60, 120, 250, 500, 1000),
    "kahan_li_6": (6, 8, 11, 16, 25, 40, 60, 100, 160),
    "kahan_li_8": (4, 6, 9, 12, 16, 22, 32, 45),
    "srkn_4": (6, 10, 16, 25, 40, 70, 120, 200, 350),
    "srkn_6": (4, 6, 8, 11, 16, 22, 32, 45, 64),
}
TOLERANCES = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13)
PYTHON, COMPILED = "DOP853 of SciPy", "dop853 of rigidmd"


def main():
    parser = new_parser(__doc__)
    parser.add_argument("--draw", action="store_true", help=f"only draw {shown(DATA / FILE)}")
    options = read_options(parser, DOCS)
    data, images = options.to / "evidence" / "data", options.to / "images"
    for one in (data, images):
        one.mkdir(parents=True, exist_ok=True)
    if options.draw:
        with (DATA / FILE).open(newline="") as file:
            _, *lines = csv.reader(file)
        rows = [
            (name, setting, float(spent), float(error)) for name, setting, spent, error in lines
        ]
        table(rows)
        draw(rows, images)
        return
    scene = Scene.read(ROOT / "systems" / "heavy_top_3.toml", {"output.trajectory": False})
    system = Simulation(scene).system
    i1, _, i3 = (float(x) for x in system.inertia)
    mgl = system.mass * 9.81 * float(system.centre[2])
    top = known.LagrangeTop(i1, i3, mgl, np.radians(40), 0.0, 0.0, 60.0)
    end = NUTATIONS * top.period
    exact = top.rotation(np.array([end]))[0]
    start = system.state
    y0 = np.concatenate([start.rotation.ravel(), start.angular_momentum_body[0] / system.inertia])

    def slopes(t, y):
        q11, q12, q13, q21, q22, q23, q31, q32, q33, p, q, r = y
        return [
            q12 * r - q13 * q,
            q13 * p - q11 * r,
            q11 * q - q12 * p,
            q22 * r - q23 * q,
            q23 * p - q21 * r,
            q21 * q - q22 * p,
            q32 * r - q33 * q,
            q33 * p - q31 * r,
            q31 * q - q32 * p,
            ((i1 - i3) * q * r + mgl * q32) / i1,
            ((i3 - i1) * p * r - mgl * q31) / i1,
            0.0,
        ]

    def flows(name, n):
        engine, state = system.engine(), start.copy()
        began = time.perf_counter()
        engine.advance(state, SCHEMES[name], top.period / n, NUTATIONS * n)
        return time.perf_counter() - began, state.rotation[0]

    def python(tolerance):
        began = time.perf_counter()
        y = solve_ivp(slopes, (0, end), y0, method="DOP853", rtol=tolerance, atol=tolerance).y[
            :, -1
        ]
        return time.perf_counter() - began, y[:9].reshape(3, 3)

    def compiled(tolerance):
        engine, solver = (
            OdeEngine(system.body, system.terms),
            Solver("dop853", "matrix", end, tolerance, tolerance),
        )
        state = engine.begin(start, solver)
        began = time.perf_counter()
        engine.advance(state, solver, end, 1)
        return time.perf_counter() - began, state.rotation[0]

    cases = [
        (name, n, lambda name=name, n=n: flows(name, n)) for name, ns in STEPS.items() for n in ns
    ]
    cases += [(PYTHON, tolerance, lambda t=tolerance: python(t)) for tolerance in TOLERANCES]
    cases += [(COMPILED, tolerance, lambda t=tolerance: compiled(t)) for tolerance in TOLERANCES]
    seconds = {key[:2]: [] for key in cases}
    errors = {}
    for repeat in range(REPEATS + 1):
        for name, setting, run in cases:
            spent, rotation = run()
            if repeat:  # the first one compiles
                seconds[name, setting].append(spent)
            errors[name, setting] = float(np.abs(rotation - exact).max())
    rows = [
        (name, setting, median(seconds[name, setting]), errors[name, setting])
        for name, setting, _ in cases
    ]
    with (data / FILE).open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(
            ["method", "steps per nutation or tolerance", "seconds", "error of Q at the end"]
        )
        writer.writerows(rows)
    speed(system, start, top)
    table(rows)
    draw(rows, images)


def speed(system, start, top):
    """Steps per second of velocity Verlet, in one call."""
    spent = []
    for _ in range(REPEATS):
        engine, state = system.engine(), start.copy()
        began = time.perf_counter()
        engine.advance(state, SCHEMES["velocity_verlet"], top.period / 1e4, SPEED_STEPS)
        spent.append(time.perf_counter() - began)
    print(
        f"velocity Verlet, one core: {1e-6 * SPEED_STEPS / median(spent):.2f} million steps a second\n"
    )


def curve(rows, names):
    """(errors, seconds) of the fastest of these methods for each error, errors descending."""
    points = sorted(
        ((error, spent) for name, _, spent, error in rows if name in names),
        key=lambda point: point[1],
    )
    front = []
    for error, spent in points:
        if not front or error < front[-1][0]:
            front.append((error, spent))
    return np.array(front).T


def seconds_for(error, front):
    """Seconds to reach an error, along straight lines between the logarithms; NaN outside."""
    errors, spent = front
    if not errors.min() <= error <= errors.max():
        return np.nan
    return float(np.exp(np.interp(np.log(error), np.log(errors[::-1]), np.log(spent[::-1]))))


def table(rows):
    """Times at equal error, and how many times faster the best of the engine's integrators is."""
    own, python, compiled = (curve(rows, names) for names in (tuple(STEPS), (PYTHON,), (COMPILED,)))
    print(
        "| error of Q | best integrator here | DOP853 of SciPy | ratio | dop853 of rigidmd | ratio |\n|---|---|---|---|---|---|"
    )
    for error in (1e-4, 1e-6, 1e-8, 1e-10):
        best = min(
            STEPS,
            key=lambda name: np.nan_to_num(seconds_for(error, curve(rows, (name,))), nan=np.inf),
        )
        a, b, c = (seconds_for(error, front) for front in (own, python, compiled))
        print(
            f"| {error:.0e} | {best}, {a * 1e3:.2f} ms | {b * 1e3:.0f} ms | {b / a:.0f} | {c * 1e3:.0f} ms | {c / a:.0f} |"
        )


def draw(rows, images):
    """Log error against log run time."""
    figure = new_figure(7.2, 4.0)
    axis = figure.subplots()
    for k, name in enumerate([*STEPS, PYTHON, COMPILED]):
        spent, errors = np.array([row[2:] for row in rows if row[0] == name], float).T
        axis.loglog(spent, errors, ms=3.5, lw=1.2, label=name, **curve_style(k))
    axis.set_xlabel("run time (s)", fontsize=TITLE, color=INK)
    axis.set_ylabel("error of Q after 20 nutations", fontsize=TITLE, color=INK)
    style = {"frameon": False, "fontsize": TEXT, "labelcolor": INK, "handlelength": 2.8}
    figure.legend(loc="outside right center", **style)
    open_axis(axis, labelsize=TEXT)
    save_files(figure, images / "single_body", ["png"])


if __name__ == "__main__":
    main()
