"""The collection: error against run time of all integrators in ten scenes, with a page of the
documentation.

    python tests/benchmarks/collection.py            # measures what is missing, half an hour; NAME ... only these
    python tests/benchmarks/collection.py --force    # measures again
    python tests/benchmarks/collection.py --pages    # writes the page again, from the data

writes evidence/data/collection/NAME.csv (all trials) and NAME.json (advice, versions, machine),
images/collection_NAME.png and evidence/collection.md in rigidmd/docs, or the folder of --to.
"""

import json
import shlex
import sys
from datetime import date
from importlib.metadata import version
from pathlib import Path
from platform import python_version

import numpy as np
from command_line import SMOKE, new_parser, read_options

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd.errors import RigidMDError

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


def command_of(name: str) -> str:
    _, file, settings = SCENES[name]
    overrides = "".join(f" \\\n    --set {shlex.quote(setting)}" for setting in settings)
    return f"rigidmd accuracy systems/{file}.toml --repeats {REPEATS}{overrides}"


def data_of(docs: Path) -> Path:
    """The folder of the data below a folder of the documentation."""
    return docs / "evidence" / "data" / "collection"


def measure(name: str, docs: Path) -> None:
    """Measure a scene and write its table, picture and advice."""
    from rigidmd.features.studies.accuracy import accuracy
    from rigidmd.scene import Scene, parse_override

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
            n: [p.seconds, p.step, p.spread] for n, p in points.items() if p is not None
        }
    processor = next(
        line
        for line in Path("/proc/cpuinfo").read_text().splitlines()
        if line.startswith("model name")
    )
    facts = {
        "date": str(date.today()),
        "processor": processor.partition(": ")[2],
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
    accuracy.trial_table(found).write(data / f"{name}.csv")
    figure = accuracy.accuracy_figure(found)
    figure.lay_out(100)
    (docs / "images").mkdir(exist_ok=True)
    figure.savefig(docs / "images" / f"collection_{name}.png", dpi=85)
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
    return [f"[{name}](#{name})", *cells]


def section_of(name: str, facts: dict) -> list[str]:
    spread = f"{facts['median_spread']:.0%}"
    return [
        f"## {name}",
        "",
        f"This scene is {SCENES[name][0]}.",
        "",
        "<!-- test: not run, it takes minutes -->",
        "```sh",
        command_of(name),
        "```",
        "",
        f"![{name}: error against run time](../images/collection_{name}.png)",
        "",
        f"The median spread of the {REPEATS} timings of a trial is {spread}. "
        f"All trials: [{name}.csv](data/collection/{name}.csv). Longest steps, failures and "
        f"what is fastest for other errors: [{name}.json](data/collection/{name}.json).",
        "",
    ]


def machines_of(found: dict[str, dict]) -> str:
    """Versions, machine and dates of all scenes."""
    lines = dict.fromkeys(
        ", ".join(f"{package} {number}" for package, number in facts["versions"].items())
        + f", Python {facts['python']}, {facts['processor']}, one thread, {facts['date']}"
        for facts in found.values()
    )
    return "Measured with " + "; with ".join(lines) + "."


def page_text(docs: Path = DOCS) -> str:
    """The page, from the data."""
    data = data_of(docs)
    found = {
        name: json.loads((data / f"{name}.json").read_text(encoding="utf-8"))
        for name in SCENES
        if (data / f"{name}.json").is_file()
    }
    heads = [f"energy error of {target:.0e}" for target in TARGETS]
    return (
        "\n".join(
            [
                "# Collection",
                "",
                "Error against run time of every integrator in ten scenes: the fastest for three errors, and a figure of each scene.",
                "",
                "<!-- written by python tests/benchmarks/collection.py from data/collection; do not edit -->",
                "",
                "One command measures all scenes, draws the pictures and writes this page:",
                "",
                "<!-- test: not run, it takes half an hour -->",
                "```sh",
                "python tests/benchmarks/collection.py",
                "```",
                "",
                "Each row has the fastest integrator for three errors of the energy, and how many times faster than",
                "`velocity_verlet` it is at that error. The factor is absent where `velocity_verlet` is the fastest or does not reach the",
                "error with its shortest step. The unit of the error is kT per degree of freedom for molecules, over 0.1 ps, and the",
                "largest kinetic energy for a body, over its run. High orders need smooth forces, so all molecules have",
                '`forces.truncation = "smooth_switch"`. The cost is the median of three timings on a shared machine, and the spread of',
                "the timings is given below for each scene; a factor within it is not printed.",
                "",
                table(
                    ["scene", *heads], [summary_row(name, facts) for name, facts in found.items()]
                ),
                "",
                "Curves end at a floor, below which a shorter step does not reduce the error: the rounding error, or with PME the error",
                "of the energy that the grid and the truncated real-space sum leave. A method at its floor shows no order.",
                "",
                machines_of(found),
                "",
                *(line for name, facts in found.items() for line in section_of(name, facts)),
            ]
        ).rstrip()
        + "\n"
    )


def main() -> None:
    """Measure the scenes, and write the page."""
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
    (docs / "evidence").mkdir(exist_ok=True)
    (docs / "evidence" / "collection.md").write_text(page_text(docs), encoding="utf-8")


if __name__ == "__main__":
    main()
