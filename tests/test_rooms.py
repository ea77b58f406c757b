"""The rooms of the house: imports point one way, and each heavy library has one room."""

import ast
import functools

import pytest
from support import ROOT

PACKAGE = ROOT / "rigidmd"

# In this order: a room may import from those above it and from itself.
ROOMS = [
    ("errors", "units", "core", "compile", "validation", "arguments", "shipped"),
    ("mechanics",),
    ("forces",),
    ("dynamics",),
    ("engines",),
    ("molecules",),
    ("scene",),
    ("own",),
    ("assemble",),
    ("measure",),
    ("output",),
    ("analyse",),
    ("peers",),
    ("run",),
    ("study",),
    ("looking",),
    ("ase",),
    ("cli", "__main__"),
]
RANK = {name: rank for rank, names in enumerate(ROOMS) for name in names}

LIBRARIES = {
    "ase": {
        "io/atoms.py", "io/formats/through_ase.py", "io/formats/lammps.py", "io/formats/text.py", "io/structure_file.py",
        "assemble/matching.py", "io/cells.py", "assemble/model_from_geometry.py", "assemble/from_atoms.py", "io/ase_atoms.py", "io/formats/traj.py",
        "io/formats/traj_writer.py", "run/ase_frames.py", "ase.py",
    },
    "MDAnalysis": {
        "io/formats/frame_reader.py", "io/mdanalysis_readers.py", "io/trajectory.py", "io/trajectory_writer.py",
    },
    "distributed": {"studies/sweep/cluster.py"},
    "gsd": {"io/formats/gsd.py", "io/formats/gsd_writer.py"},
    "tomli_w": {"io/scene_file.py"},
    "rocket_fft": {"forces/ewald/pme.py"},
    "sympy": {"forces/potentials/formulas.py", "engines/expressions.py"},
    "openmm": {"engines/openmm/system.py", "engines/openmm/files.py"},
    "matplotlib": {
        "figures/style.py", "view/page.py", "figures/picture.py", "figures/body.py", "studies/accuracy/report.py",
        "studies/stability/report.py", "view/molecule_figure.py", "studies/accuracy/averages_report.py", "view/plots.py",
        "view/film.py", "analysis/files.py", "studies/sweep/figure.py", "view/draw_body.py", "view/draw_molecules.py", "view/gallery.py",
    },
    "pydantic": {
        "analysis/files.py", "scene/models.py", "io/run_files.py", "studies/sweep/folder.py", "run/body.py",
        "run/molecular.py", "run/provenance.py", "run/resume.py", "run/segments.py", "scene/__init__.py",
        "scene/body_forces.py", "scene/base.py", "scene/body.py", "scene/engine.py", "scene/fields.py",
        "scene/forces.py", "scene/molecules.py", "scene/start.py", "scene/species.py", "scene/stage.py",
        "scene/validation.py",
    },
    "IPython": {"io/progress.py"},
    "chemiscope": {"view/inline.py"},
    "numba": {
        "compile/settings.py", "compile/cache.py", "compile/code.py", "compile/thread_pool.py", "compile/kernels.py", "compile/simd_math.py",
        "compile/layout.py",
        "compile/simd_types.py", "compile/simd.py", "compile/machine.py", "compile/numba_private.py",
        "compile/own.py", "compile/simd_records.py", "forces/neighbors/pair_loop.py", "forces/neighbors/sites.py", "forces/terms.py",
    },
}  # fmt: skip

# Inside of a function: a value tells what would be made of it, and shows itself in a notebook.
LAZY = {
    ("scene/molecules.py", "rigidmd.assemble.build"), ("scene/molecules.py", "rigidmd.io.ase_atoms"),
    ("scene/body.py", "rigidmd.assemble.body"), ("scene/base.py", "rigidmd.assemble.from_atoms"),
    ("scene/base.py", "rigidmd.view.notebook"), ("run/simulation.py", "rigidmd.view.notebook"),
    ("run/results.py", "rigidmd.view.notebook"), ("run/results.py", "rigidmd.view.columns"),
    ("run/results.py", "rigidmd.view.inline"),
}  # fmt: skip

FILES = sorted(PACKAGE.rglob("*.py"))


@functools.cache
def imports(path):
    """Modules that a file imports, those only for type checkers left out."""
    return list(_imports(path))


def _imports(path):
    tree = ast.parse(path.read_text())
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_imports_point_up_the_list_of_rooms(path):
    room = path.relative_to(PACKAGE).with_suffix("").parts[0]
    if room == "__init__":
        return
    for module in imports(path):
        parts = module.split(".")
        lazy = (path.relative_to(PACKAGE).as_posix(), module) in LAZY
        if parts[0] == "rigidmd" and len(parts) > 1 and not lazy:
            assert RANK[parts[1]] <= RANK[room], f"{path.name} imports {module}, which is further down"


@pytest.mark.parametrize("library", LIBRARIES)
def test_each_library_has_its_room(library):
    users = {
        path.relative_to(PACKAGE).as_posix()
        for path in FILES
        for module in imports(path)
        if module.split(".")[0] == library
    }
    assert users <= LIBRARIES[library]


def test_what_is_compiled_counts_in_the_digest_that_names_the_cache():
    """A kernel outside of `cache.COMPILED`, or one that takes a number from outside, would run on when it changes."""
    from support import COMPILED

    for path in FILES:
        name = path.relative_to(PACKAGE).parts[0]
        ours = {module for module in imports(path) if module.split(".")[0] == "rigidmd"}
        if name in COMPILED:
            strange = {
                m
                for m in ours
                if m != "rigidmd" and m.split(".")[1] not in COMPILED and f"{m.split('.')[1]}.py" not in COMPILED
            }
            assert not strange, f"{path} is compiled and imports {strange}"
        else:
            ours -= {"rigidmd.compile.machine", "rigidmd.compile.cache"}  # what the processor is, what is kept
            assert not any(m.startswith("rigidmd.compile") for m in ours), f"{path} compiles"


def test_core_compiles_nothing():
    for path in (PACKAGE / "core").rglob("*.py"):
        assert not {"numba", "rigidmd.compile"} & set(imports(path)), path


def test_no_room_is_unknown():
    found = {
        p.stem if p.is_file() else p.name
        for p in PACKAGE.iterdir()
        if p.suffix == ".py" or (p / "__init__.py").exists()
    }
    assert found - {"__init__"} == set(RANK)


def test_the_top_level_holds_what_it_should():
    allowed = {"pyproject.toml", "rigidmd", "tests", "systems", "README.md", "LICENSE"}
    import subprocess

    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    found = {line.split("/")[0] for line in listed.stdout.splitlines()}
    assert {name for name in found if not name.startswith(".")} <= allowed
