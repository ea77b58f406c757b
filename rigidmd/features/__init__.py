"""The list of features, in names and words: importing it loads none of them."""

from rigidmd.feature import Row

FEATURES = (
    Row(
        "bodies",
        "a single rigid body: tops, gyroscopes, bodies in a fluid, satellites",
        needs=("potentials", "studies", "view"),
    ),
    Row(
        "external",
        "export to LAMMPS, OpenMM and GROMACS, and runs with them",
        needs=("crystals", "potentials"),
        commands=("export", "verify"),
    ),
    Row("potentials", "interactions of users: formula, table, Python function"),
    Row(
        "analysis",
        "analyses of runs",
        needs=("free_energy", "potentials", "studies", "view"),
        commands=("analyse",),
    ),
    Row(
        "free_energy",
        "coupling, insertion, mean force, virial coefficients",
        needs=("analysis", "potentials", "studies"),
        commands=("virial",),
        analyses=("insertion",),
    ),
    Row(
        "studies",
        "many runs: sweep, accuracy, comparison, stability, normal modes",
        needs=("analysis", "bodies", "free_energy", "potentials", "view"),
        commands=("accuracy", "compare", "modes", "stability", "sweep"),
        display="sweep.notebook",
    ),
    Row(
        "crystals",
        "CIF and symmetry, and the formats that liquids do not need",
        formats=("cif", "g96", "gsd", "lammps"),
    ),
    Row("monte_carlo", "hybrid Monte Carlo"),
    Row("calculators", "ASE calculators, both ways", needs=("potentials",)),
    Row(
        "view",
        "figures, pages, animations, display in notebooks",
        needs=("analysis", "bodies", "potentials"),
        commands=("film", "gallery", "report", "view"),
        display="notebook",
    ),
)
