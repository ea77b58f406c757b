"""The collection: error against run time of all integrators in ten scenes, with a section of the
documentation.

    python tests/benchmarks/collection.py            # measures what is missing, half an hour; NAME ... only these
    python tests/benchmarks/collection.py --force    # measures again
    python tests/benchmarks/collection.py --pages    # draws the figures and writes the section, from the data

writes evidence/data/collection/NAME.json (what is fastest, versions, machine; of the scenes in figures
also NAME.csv with all trials), images/collection_water.png, collection_top.png and error_time.png,
and the section *Ten scenes* of evidence/accuracy_cost.md in rigidmd/docs, or the folder of --to.
"""

import csv
import json
import shutil
import sys
from datetime import date
from importlib.metadata import version
from pathlib import Path
from platform import python_version

import numpy as np
from command_line import SMOKE, new_parser, read_options

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd.core.integrators import SCHEMES
from rigidmd.errors import RigidMDError
from rigidmd.features.view.figures.style import (
    DASHES,
    INK,
    TEXT,
    TITLE,
    curve_style,
    label_ticks,
    new_figure,
    open_axis,
    save_files,
)

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "rigidmd" / "docs"
SMOOTH = ("threads=1", "forces.truncation=smooth_switch")
LIQUID = ("stages.equilibration.duration_ps=5", *SMOOTH)
REPEATS = 2 if SMOKE else 3
INTEGRATORS = ["velocity_verlet", "srkn_4"] if SMOKE else None  # all that suit a scene
SMOKE_SETTINGS = ("stages.0.duration_ps=0.1", "stages.1.duration_ps=0.1", "molecules.0.count=150")
TARGETS = (1e-3, 1e-5, 1e-7)  # errors of the energy in the table of all scenes
#: Name -> what it is, file, settings.
SCENES = {
    "water_reaction_field": (
        "216 SPC/E waters, 298 K, with a reaction field",
        "water",
        ("forces.electrostatics=reaction_field", *LIQUID),
    ),
    "water_pme": (
        "216 SPC/E waters, 298 K, with PME",
        "water",
        ("forces.electrostatics=pme", *LIQUID),
    ),
    "nitrogen": (
        "500 nitrogen molecules, liquid at 77 K, without charges",
        "nitrogen",
        ("stages.0.duration_ps=5", *SMOOTH),
    ),
    "carbon_dioxide": ("256 molecules of CO2, a crystal at 150 K, with PME", "dry_ice", SMOOTH),
    "benzene": (
        "64 benzene molecules (OPLS), liquid at 298 K, with PME",
        "water",
        (
            'molecules=[{model="benzene_opls", count=64}]',
            "box.density_g_cm3=0.874",
            "forces.electrostatics=pme",
            "forces.mixing=geometric",
            *LIQUID,
        ),
    ),
    "ions_in_water": (
        "200 SPC/E waters with 4 sodium and 4 chloride ions, 298 K, with PME",
        "water",
        (
            'molecules=[{model="spce", count=200}, {model="na_spce", count=4}, {model="cl_spce", count=4}]',
            "box.density_g_cm3=1.03",
            "forces.electrostatics=pme",
            *LIQUID,
        ),
    ),
    "free_asymmetric_top": (
        "a free body with three different moments of inertia",
        "free_asymmetric_top",
        (),
    ),
    "heavy_top_3": ("a symmetric heavy top, released at rest at 40 degrees", "heavy_top_3", ()),
    "fast_heavy_top": (
        "a fast heavy top, whose axis passes close to straight down",
        "fast_heavy_top",
        (),
    ),
    "body_in_fluid": (
        "a heavy ellipsoid that sinks in water, with resistance",
        "body_in_fluid",
        ("run.duration_s=2",),
    ),
}


#: Figure of the section -> its scene; the scenes, titles and integrators of the figure of README.
FIGURES = {"collection_water": "water_pme", "collection_top": "heavy_top_3"}
README = (
    ("water_pme", "216 SPC/E waters, PME, 0.1 ps", "kT per degree of freedom"),
    ("heavy_top_3", "heavy top, 5 nutations", "/ largest kinetic energy"),
)
SHOWN = ("velocity_verlet", "srkn_4", "srkn_6")
ERRORS = {"energy rms": "rms energy error", "error of Q": "error of Q"}
SCATTER = 20.0  # %: curves are dashed where timings scatter more


def data_of(docs: Path) -> Path:
    """The folder of the data below a folder of the documentation."""
    return docs / "evidence" / "data" / "collection"


def measure(name: str, docs: Path) -> None:
    """Measure a scene and write its table, picture and advice."""
    from rigidmd.features.studies.accuracy import accuracy
    from rigidmd.scene import Scene, parse_override

    sys.path.insert(0, str(ROOT / "tests"))
    from support.common import processor

    _, file, settings = SCENES[name]
    if SMOKE and "top" not in file:
        settings = (*settings, *SMOKE_SETTINGS)
    scene = Scene.read(ROOT / "systems" / f"{file}.toml", dict(map(parse_override, settings)))
    found = accuracy.measure_accuracy(scene, INTEGRATORS, repeats=REPEATS)
    system, reached = found.trial_system, {}
    for target in TARGETS:
        points = {
            n: found.time_for(n, "energy_rms", target)
            for n in dict.fromkeys(t.integrator for t in found.trials)
        }
        reached[f"{target:.0e}"] = {
            n: [p.time, p.step, p.spread] for n, p in points.items() if p is not None
        }
    facts = {
        "date": str(date.today()),
        "processor": processor(),
        "python": python_version(),
        "versions": {
            package: version(package) for package in ("rigidmd", "numba", "numpy", "scipy")
        },
        "unit": system.time_unit,
        "span": system.span,
        "energy_unit": system.energy_unit,
        "order": {
            n: method.order
            for n, method in system.methods.items()
            if any(t.integrator == n for t in found.trials)
        },
        "median_spread": float(np.median([t.spread for t in found.trials if not t.diverged])),
        "reference_error": found.reference_error,
        "reached": reached,
        "advice": accuracy.recommendations(found),
    }
    data = data_of(docs)
    data.mkdir(parents=True, exist_ok=True)
    if name in FIGURES.values():
        accuracy.trial_table(found).write(data / f"{name}.csv")
    (data / f"{name}.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


def table(titles: list[str], rows: list[list[str]]) -> str:
    return "\n".join(
        "| " + " | ".join(row) + " |" for row in [titles, ["---"] * len(titles), *rows]
    )


def summary_row(name: str, facts: dict) -> list[str]:
    """The cheapest integrator at each target and how many times faster than velocity Verlet it
    is."""
    cells = []
    for reached in facts["reached"].values():
        best = min(reached, key=lambda n: reached[n][0], default=None)
        common = reached.get("velocity_verlet")
        if best is None:
            cells.append("none reaches it")
            continue
        (time, step, spread), factor = reached[best], ""
        if common and best != "velocity_verlet":
            clear = common[0] * (1 - common[2] / 2) > time * (1 + spread / 2)
            factor = f", {common[0] / time:.1f} times" if clear else ", within the spread"
        cells.append(f"`{best}` at {step:.2g} {facts['unit']}{factor}")
    return [SCENES[name][0], *cells]


def trials_of(name: str, data: Path) -> dict[str, list[dict[str, float]]]:
    """Integrator -> trials of a scene that have not failed, with the longest step first. A column
    without a number has NaN."""
    with (data / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found: dict[str, list[dict[str, float]]] = {}
    for row in rows:
        integrator = row.pop("integrator")
        if "fails" not in row.values():
            values = {key.partition(" (")[0]: float(text or "nan") for key, text in row.items()}
            found.setdefault(integrator, []).append(values)
    return {name: sorted(of, key=lambda t: -t["step"]) for name, of in found.items()}


def per_span(trial: dict[str, float], what: str) -> float:
    """Force evaluations or seconds per ps or s."""
    return next(value for key, value in trial.items() if key.startswith(f"{what} per "))


def draw_scene(image: str, name: str, data: Path, images: Path) -> None:
    """Errors against force evaluations, a curve for each integrator in the order of the step."""
    figure = new_figure(7.2, 3.6)
    axes = figure.subplots(1, 2)
    unit = "ps" if name == "water_pme" else "s"
    orders = {n: k for k, n in enumerate(SCHEMES)}
    trials = dict(sorted(trials_of(name, data).items(), key=lambda e: orders.get(e[0], 99)))
    for axis, (error, label) in zip(axes, ERRORS.items(), strict=True):
        for k, (integrator, of) in enumerate(trials.items()):
            points = [(per_span(t, "forces"), t[error]) for t in of if t[error] > 0]
            if points:
                axis.loglog(*np.array(points).T, ms=3, lw=1.0, label=integrator, **curve_style(k))
        axis.set_ylabel(label, fontsize=TITLE, color=INK)
        open_axis(axis, labelsize=TEXT)
    figure.supxlabel(f"force evaluations per {unit}", fontsize=TITLE, color=INK)
    style = {"frameon": False, "fontsize": TEXT, "labelcolor": INK, "handlelength": 2.6}
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", **style)
    save_files(figure, images / image, ["png"])


def draw_error_time(data: Path, images: Path) -> None:
    """The figure of README: the error of the energy against run time, of water and of a top."""
    figure = new_figure(6.0, 3.0)
    axes = figure.subplots(1, 2)
    for axis, (name, title, unit) in zip(axes, README, strict=True):
        trials = trials_of(name, data)
        for k, integrator in enumerate(SHOWN):
            of = [t for t in trials.get(integrator, ()) if t["energy rms"] > 0]
            x = np.array([1000 * per_span(t, "seconds") for t in of])
            y = np.array([t["energy rms"] for t in of])
            scatters = np.array([t["spread"] > SCATTER for t in of], bool)
            label = f"{integrator} (default)" if k == 0 else integrator
            axis.loglog(x, y, ms=4, label=label, **curve_style(k) | {"ls": "none"})
            for i in range(len(of) - 1):
                line = (0, DASHES[1]) if scatters[i : i + 2].any() else "-"
                color = curve_style(k)["color"]
                axis.loglog(x[i : i + 2], y[i : i + 2], lw=1.3, color=color, ls=line)
        axis.set_title(title, loc="left", fontsize=TITLE, color=INK)
        per = "ps" if name == "water_pme" else "s"
        axis.set_xlabel(f"run time (ms per {per} of motion)", fontsize=TITLE, color=INK)
        label = f"energy error /\n{unit[2:]}" if unit[0] == "/" else f"energy error\n({unit})"
        axis.set_ylabel(label, fontsize=TITLE, color=INK)
        open_axis(axis, labelsize=TEXT)
        label_ticks(axis.xaxis)
    style = {"frameon": False, "fontsize": TEXT, "labelcolor": INK}
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, **style
    )
    save_files(figure, images / "error_time", ["png"])


def machines_of(found: dict[str, dict]) -> str:
    """Versions, machine and dates of all scenes."""
    dates: dict[str, set[str]] = {}
    for facts in found.values():
        versions = [f"{package} {number}" for package, number in facts["versions"].items()]
        setup = ", ".join([*versions, f"Python {facts['python']}", facts["processor"]])
        dates.setdefault(setup, set()).add(facts["date"])
    lines = [f"{setup}, one thread, {', '.join(sorted(days))}" for setup, days in dates.items()]
    return "Measured with " + "; with ".join(lines) + "."


def page_text(docs: Path = DOCS) -> str:
    """The page with its section between the two comments written from the data."""
    data = data_of(docs)
    found = {
        name: json.loads((data / f"{name}.json").read_text(encoding="utf-8"))
        for name in SCENES
        if (data / f"{name}.json").is_file()
    }
    heads = [f"energy error of {target:.0e}" for target in TARGETS]
    rows = [summary_row(name, facts) for name, facts in found.items()]
    section = SECTION.format(table=table(["scene", *heads], rows), machines=machines_of(found))
    page = (DOCS / PAGE).read_text(encoding="utf-8")
    before, after = page.partition(FIRST)[0], page.partition(LAST)[2]
    return before + FIRST + section + LAST + after


PAGE = Path("evidence", "accuracy_cost.md")
FIRST = (
    "<!-- written by python tests/benchmarks/collection.py from data/collection; do not edit -->\n"
)
LAST = "<!-- end of what collection.py writes -->\n"
SECTION = """
<!-- test: not run, it takes half an hour -->
```sh
python tests/benchmarks/collection.py
```

Each row has the fastest integrator for three errors of the energy, and how many times faster than `velocity_verlet` it is at that
error, where `velocity_verlet` is slower and reaches the error. The unit is kT per degree of freedom for molecules, over 0.1 ps, and
the largest kinetic energy for a body, over its run. All molecules have `truncation = "smooth_switch"`. The run time is the median
of three timings on a shared machine.

{table}

Force evaluations do not depend on the machine. Each curve joins the trials of an integrator in the order of the step.

![error of integrators against force evaluations, water with PME](../images/collection_water.png)

![error of integrators against force evaluations, heavy top](../images/collection_top.png)

A curve ends at a floor, where a shorter step does not reduce the error: the rounding error, or with PME the error of the grid and
of the truncated real-space sum. There a method shows no order.

{machines} Longest steps, failures and the fastest integrators for other errors are in `rigidmd/docs/evidence/data/collection`.

"""


def main() -> None:
    """Measure the scenes, and write the section."""
    parser = new_parser(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME")
    parser.add_argument("--force", action="store_true")
    parser.add_argument("--pages", action="store_true")
    options = read_options(parser, DOCS, names=["nitrogen", "heavy_top_3"])
    docs = options.to
    for name in [] if options.pages else options.names or SCENES:
        if options.force or not (data_of(docs) / f"{name}.json").is_file():
            print(name, flush=True)
            try:
                measure(name, docs)
            except RigidMDError as error:  # the other scenes do not depend on it
                if SMOKE:
                    raise
                print(f"{name} failed: {error}")
    data, images = data_of(docs), docs / "images"
    if options.pages and docs != DOCS:
        shutil.copytree(data_of(DOCS), data, dirs_exist_ok=True)
    images.mkdir(exist_ok=True)
    for image, name in FIGURES.items():
        if (data / f"{name}.csv").is_file():
            draw_scene(image, name, data, images)
    if all((data / f"{name}.csv").is_file() for name, *_ in README):
        draw_error_time(data, images)
    (docs / "evidence").mkdir(exist_ok=True)
    (docs / PAGE).write_text(page_text(docs), encoding="utf-8")


if __name__ == "__main__":
    main()
