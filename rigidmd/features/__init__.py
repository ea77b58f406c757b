"""The list of features, in names and words: importing it loads none of them."""

from collections.abc import Iterator, Mapping

from rigidmd.feature import Feature, Row

FEATURES = (
    Row(
        "bodies",
        "a single rigid body: tops, gyroscopes, bodies in a fluid, satellites",
        needs=("studies", "view"),
        kind="body",
        kind_title="one body",
    ),
    Row(
        "external",
        "export to LAMMPS, OpenMM and GROMACS, and runs with them",
        needs=("crystals", "potentials"),
        commands=("export", "verify"),
        keys=("engine.name=lammps", "engine.name=openmm"),
        programs=("gromacs", "lammps", "openmm"),
    ),
    Row(
        "potentials",
        "interactions of users: formula, table, Python function",
        keys=("forces.custom", "forces.bodies", "forces.added", "from_python"),
        file_keys=r"forces\.(custom|bodies)\.[^.]+\.(module|table)",
        acts=True,
        provides=("shapes", "trust", "unused_files", "check_trusted"),
    ),
    Row(
        "analysis",
        "analyses of runs",
        needs=("view",),
        commands=("analyse",),
        display="display",
        provides=("page_parts",),
    ),
    Row(
        "free_energy",
        "coupling, insertion, mean force, virial coefficients",
        needs=("analysis", "potentials", "studies"),
        keys=("coupling",),
        acts=True,
        sweep_analyses=("windows", "lambda_sweep"),
        commands=("virial",),
        analyses=("insertion",),
        scene_analyses=("insertion",),
    ),
    Row(
        "studies",
        "many runs: sweep, accuracy, comparison, stability, normal modes",
        needs=("analysis", "view"),
        commands=("accuracy", "compare", "modes", "stability", "sweep"),
        analyses=("zero_step",),
        display="sweep.notebook",
        provides=("analyse_sweep", "step_biases"),
    ),
    Row(
        "crystals",
        "CIF and symmetry, and the formats that liquids do not need",
        formats=("cif cif mmcif", "g96 g96", "gsd gsd", "lammps data lmp lammps"),
    ),
    Row(
        "monte_carlo",
        "hybrid Monte Carlo",
        keys=("stages.thermostat=hybrid_monte_carlo",),
        thermostats=("keys",),
    ),
    Row("calculators", "ASE calculators, both ways", needs=("potentials",)),
    Row(
        "view",
        "figures, pages, animations, display in notebooks",
        commands=("film", "report", "view"),
        display="notebook",
        keys=("output.figures",),
        is_optional=True,
        provides=("draw_model",),
    ),
)


def modules(kind: str) -> Iterator[tuple[str, str]]:
    """(name, full name) of the modules of installed features that add "commands", "analyses",
    "sweep_analyses", "scene_analyses", "thermostats" or "barostats"."""
    for row in FEATURES:
        if getattr(row, kind) and row.is_installed:
            folder = f"{row.package}.commands" if kind == "commands" else row.package
            yield from ((name, f"{folder}.{name}") for name in getattr(row, kind))


def used_by(scene: object) -> Iterator[Row]:
    """The features that a scene uses: those with a key that has a value in it."""
    for row in FEATURES:
        if any(_has(scene, *key.partition("=")[::2]) for key in row.keys):
            yield row


def acting_on(scene: object) -> list[Feature]:
    """The features that a scene uses and that change its system. Raises MissingFeatureError."""
    rows = (row for row in used_by(scene) if row.acts)
    return [row.load(f"a scene with {' or '.join(row.keys)}") for row in rows]


def check_installed(tables: Mapping, source: str) -> None:
    """Raise MissingFeatureError if a scene with these tables needs a feature that is absent."""
    rows = {row.name: row for row in FEATURES}
    for row in FEATURES:
        if row.is_optional:
            continue
        absent = [name for name in (row.name, *row.needs) if not rows[name].is_installed]
        keys = [key for key in row.keys if absent and _has(tables, *key.partition("=")[::2])]
        if keys:
            raise rows[absent[0]].missing(f"{source}: {keys[0]}")


def _has(value: object, path: str, wanted: str) -> bool:
    """Whether a value has another value at a dotted path, or the one wanted."""
    if isinstance(value, list | tuple):
        return any(_has(entry, path, wanted) for entry in value)
    if path:
        first, _, rest = path.partition(".")
        inner = value.get(first) if isinstance(value, Mapping) else getattr(value, first, None)
        return _has(inner, rest, wanted)
    return str(value) == wanted if wanted else bool(value)


def providers(method: str) -> Iterator:
    """The `Feature` of all installed features that provide a method."""
    return (row.load() for row in FEATURES if method in row.provides and row.is_installed)


def provider(method: str, needed_by: str):
    """The `Feature` that provides a method. Raises MissingFeatureError."""
    return next(row for row in FEATURES if method in row.provides).load(needed_by)
