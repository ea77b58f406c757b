"""The architecture: packages import in one direction, and each heavy library is used in few of
them."""

import ast
import functools
import importlib.util
import re
import subprocess
import sys
import tomllib

import pytest
from support.common import ROOT

from rigidmd.features import FEATURES
from rigidmd.formats import extensions

PACKAGE = ROOT / "rigidmd"

#: From the bottom up: a package imports from those before it and from itself.
LAYERS = (
    "errors",
    "units",
    "feature",
    "features",  # the list of features
    "core",
    "compile",
    "mechanics",
    "formats",
    "scene",
    "forces",
    "dynamics",
    "engines",
    "io",
    "assemble",
    "run",
    "commands",
)
#: The layer of features. `rigidmd` itself and `python -m rigidmd` are above all packages.
ABOVE_THE_CORE = "a feature"
ABOVE_ALL = ("ase", "__init__", "__main__")
RANK = {name: rank for rank, name in enumerate((*LAYERS, ABOVE_THE_CORE, *ABOVE_ALL))}
NAMES = {row.name: row for row in FEATURES}

#: Library -> the packages and files that import it.
LIBRARIES = {
    "ase": {"formats", "io", "assemble", "run", "features/calculators", "features/crystals"},
    "chemiscope": {"features/view"},
    "distributed": {"features/studies/sweep"},
    "gsd": {"features/crystals"},
    "IPython": {"io/progress.py"},
    "llvmlite": {"compile"},
    "MDAnalysis": {"formats", "io", "run/results.py"},
    "matplotlib": {"features"},
    "numba": {
        "compile",
        "forces",
        "features/potentials",
        "features/free_energy",
        "features/bodies",
    },
    "numba.core": {"compile"},
    "numba.extending": {"compile"},
    "openmm": {"features/external/openmm"},
    "pydantic": {"scene", "io", "run", "features"},
    "rocket_fft": {"forces/ewald/pme.py"},
    "tomli_w": {"io/scene_file.py"},
}

FILES = sorted(PACKAGE.rglob("*.py"))


def name_of(path):
    return path.relative_to(PACKAGE).as_posix()


def layer_of(module):
    """The layer of a module below rigidmd: "" is `rigidmd` itself; one of a feature is above the
    core, but its keys belong to `scene`."""
    first, _, rest = (module or "__init__").partition(".")
    if first != "features" or rest in ("", "__init__"):
        return first
    return "scene" if rest.split(".")[1:2] == ["keys"] else ABOVE_THE_CORE


def feature_of(module):
    """The feature of a module below rigidmd. Empty for the core."""
    name = module.removeprefix("features.").partition(".")[0]
    return name if module.startswith("features.") and name in NAMES else ""


def module_of(path):
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


def package_of(path):
    return layer_of(module_of(path))


def imports_in(source):
    """(line, module) of all imports of a Python text: at the top, inside functions, and for type
    checkers only."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: a relative import"
            for alias in node.names:
                inner = ROOT.joinpath(*node.module.split("."), alias.name)
                is_module = inner.with_suffix(".py").is_file() or inner.is_dir()
                found.append(
                    (node.lineno, f"{node.module}.{alias.name}" if is_module else node.module)
                )
    return found


@functools.cache
def imports(path):
    return imports_in(path.read_text(encoding="utf-8"))


def upward(package, found):
    """'line: imports module, ...' for imports (line, module) from packages above, and from the
    package rigidmd itself."""
    for line, module in found:
        root, _, rest = module.partition(".")
        other = layer_of(rest)
        if root == "rigidmd" and RANK[other] > RANK[package]:
            yield f"{line}: imports {module}: {package} is below {other.replace('__init__', 'rigidmd')}"


def test_imports_point_down():
    """Imports inside functions and for type checkers count. The order of layers excludes circles of
    packages, and imports of a feature by the core."""
    assert not [name_of(path) for path in FILES if package_of(path) not in RANK], "in no layer"
    errors = [
        f"{name_of(path)}:{message}"
        for path in FILES
        for message in upward(package_of(path), imports(path))
    ]
    assert not errors, "\n".join(errors)


def test_a_feature_imports_those_that_it_needs():
    errors = [
        f"{name_of(path)}:{line}: {name} does not need {other}"
        for path in FILES
        if (name := feature_of(module_of(path)))
        for line, module in imports(path)
        if (other := feature_of(module.removeprefix("rigidmd."))) not in ("", name)
        and other not in NAMES[name].needs
    ]
    assert not errors, "\n".join(errors)
    needed = {
        (feature_of(module_of(path)), feature_of(module.removeprefix("rigidmd.")))
        for path in FILES
        for _, module in imports(path)
    }
    assert {(name, other) for name, row in NAMES.items() for other in row.needs} <= needed


def test_every_kind_of_upward_import_is_found():
    source = """
from typing import TYPE_CHECKING
import numpy
from rigidmd.core.state import State
if TYPE_CHECKING:
    from rigidmd.features.view.plots import plot
def build():
    from rigidmd import run
    import rigidmd.assemble.build
    from rigidmd import Scene
"""
    assert [message.split(":")[0] for message in upward("scene", imports_in(source))] == [
        "6",
        "8",
        "9",
        "10",
    ]
    assert not list(upward("__init__", imports_in(source)))
    inner = [
        (1, "rigidmd.formats.gro"),
        (2, "rigidmd.formats"),
        (3, "rigidmd.io.trajectory"),
        (4, "rigidmd.io"),
    ]
    assert [message.split(":")[0] for message in upward("scene", inner)] == ["3", "4"]
    assert [message.split(":")[0] for message in upward("mechanics", inner)] == ["1", "2", "3", "4"]


def test_keys_belong_to_scenes():
    """They import nothing else of the core, and only `scene` imports them, by names."""
    below = LAYERS[: LAYERS.index("scene")]
    errors = []
    for path in FILES:
        module = module_of(path)
        is_keys = feature_of(module) and layer_of(module) == "scene"
        for line, name in imports(path):
            imported = name.removeprefix("rigidmd.")
            if not name.startswith("rigidmd."):
                continue
            if is_keys and layer_of(imported) not in (*below, "scene"):
                errors.append(f"{name_of(path)}:{line}: keys import {name}")
            ours = {feature_of(module), ""}
            to_keys = feature_of(imported) and layer_of(imported) == "scene"
            if to_keys and feature_of(imported) not in ours and module.partition(".")[0] != "scene":
                errors.append(f"{name_of(path)}:{line}: imports keys, {name}")
    assert not errors, "\n".join(errors)


#: Feature -> its words, which do not occur in the core.
WORDS = {
    "bodies": r"gyroscop|fluid|satellite|precession",
    "external": r"rigidmd (export|verify)",
    "free_energy": r"lambda_|soft.core|virial coefficient|mean force",
    "monte_carlo": r"hybrid",
    "potentials": r"gay.berne|formula of two",
    "studies": r"replica|rigidmd sweep",
    "view": r"animation|\bfilm\b",
}
#: Files of the core with such a word -> why.
NAMED = {
    "core/shipped.py": "titles of pages",
    "scene/hints.py": "keys of other kinds of scenes",
}


def test_the_core_does_not_know_the_words_of_features():
    found = {
        f"{name_of(path)}:{number}: {name}: {match[0]}"
        for name, words in WORDS.items()
        for path in FILES
        if not feature_of(module_of(path)) and layer_of(module_of(path)) in LAYERS[4:]
        if name_of(path) not in NAMED
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if (match := re.search(words, line, re.IGNORECASE))
    }
    assert not found, "\n".join(sorted(found))


def running_imports(path):
    """The modules of rigidmd that a file imports when it runs: imports for type checkers are left
    out."""
    source = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(source):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            node.body = [ast.Pass()]
    found = (name for _, name in imports_in(ast.unparse(source)))
    return {name.removeprefix("rigidmd.") for name in found if name.startswith("rigidmd.")}


def test_modules_form_no_circles():
    """Also of different packages, and by imports inside functions."""
    graph = {module_of(path): running_imports(path) for path in FILES}
    graph["scene.base"] -= {"scene.kinds"}  # a method of the base class finds the class of a kind
    done: set[str] = set()

    def circle(module, above):
        if module in above:
            return (*above[above.index(module) :], module)
        if module in done or module not in graph:
            return ()
        done.add(module)
        return next((c for m in sorted(graph[module]) if (c := circle(m, (*above, module)))), ())

    circles = [" -> ".join(found) for module in sorted(graph) if (found := circle(module, ()))]
    assert not circles, "\n".join(circles)


def test_each_library_has_its_packages():
    errors = [
        f"{name_of(path)}:{line}: imports {module}"
        for library, packages in LIBRARIES.items()
        for path in FILES
        for line, module in imports(path)
        if f"{module}.".startswith(f"{library}.")
        and not any(f"{name_of(path)}/".startswith(f"{package}/") for package in packages)
    ]
    assert not errors, "\n".join(errors)


#: Packages and files with kernels, and those that ask for the processor, the cache or its sources.
COMPILED = (
    "compile",
    "mechanics",
    "forces",
    "dynamics",
    "engines/protocol.py",
    "engines/cpu",
    "features/analysis/pair_histogram.py",
    "features/bodies",
    "features/free_energy",
    "features/monte_carlo",
    "features/potentials",
)
ASKED_BY_OTHERS = {"rigidmd.compile.machine", "rigidmd.compile.cache", "rigidmd.compile.sources"}


def test_only_packages_of_kernels_compile():
    for path in FILES:
        name = name_of(path)
        if not any(name == entry or name.startswith(f"{entry}/") for entry in COMPILED):
            used = {m for _, m in imports(path) if m.startswith("rigidmd.compile")}
            assert used <= ASKED_BY_OTHERS, f"{name} compiles"


#: Files that name extensions of structures or trajectories in texts for users -> what for.
NAMED_EXTENSIONS = {
    "commands/models.py": "an example in --help",
    "features/external/gromacs/files.py": "the files of an export and a command of GROMACS",
    "features/external/lammps/files.py": "the files of an export, and commands of LAMMPS",
    "features/external/lammps/program.py": "the command that runs an export",
    "features/external/openmm/files.py": "the files of an export, and its script",
    "io/ase_plugin.py": "names of files that ASE cannot read, which it matches without loading the formats",
}


def test_only_a_format_names_its_extensions():
    """In texts except docstrings; `formats` also has the default names of files."""
    extension = re.compile(rf"[.]({'|'.join(name[1:] for name in extensions(bool))})\b")
    naming = {}
    for path in FILES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        texts = [
            n.value
            for n in ast.walk(tree)
            if isinstance(n, ast.Constant) and id(n) not in docstrings
        ]
        if found := [text for text in texts if isinstance(text, str) and extension.search(text)]:
            naming[name_of(path)] = found
    strange = {
        name: texts
        for name, texts in naming.items()
        if not name.startswith(("formats/", "features/crystals/"))
    }
    assert set(strange) == set(NAMED_EXTENSIONS), strange
    assert len(naming) >= len(strange) + 8  # the registry and seven modules


def test_core_compiles_nothing():
    for path in (PACKAGE / "core").rglob("*.py"):
        assert not [m for _, m in imports(path) if m.split(".")[0] == "numba"], name_of(path)


def loaded_by(script):
    """The modules that a Python process has loaded after a script."""
    script += "\nimport sys\nprint(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(done.stdout.splitlines()[-1].split())


def test_a_scene_needs_neither_scipy_nor_numba():
    assert not {"scipy", "numba", "ase", "MDAnalysis", "matplotlib"} & loaded_by(
        "import rigidmd.scene"
    )


def test_ase_loads_little_of_rigidmd():
    (point,) = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"][
        "ase.ioformats"
    ].items()
    found = loaded_by(
        f"from importlib.metadata import EntryPoint\nEntryPoint(*{point}, 'ase.ioformats').load()"
    )
    assert "rigidmd.io.ase_plugin" in found
    assert not {"numba", "MDAnalysis", "matplotlib", "rigidmd.formats"} & found


def test_the_package_itself_loads_neither_numpy_nor_numba():
    found = loaded_by("import rigidmd")
    assert not {"numpy", "numba", "scipy", "pydantic", "MDAnalysis", "matplotlib"} & found
    assert len(found) < 200


#: Packages and modules of which a run of a single body needs nothing.
MOLECULAR = (
    "assemble.build",
    "assemble.defaults",
    "assemble.species",
    "assemble.structure",
    "dynamics.barostats",
    "dynamics.step_loop",
    "dynamics.thermostats",
    "engines.cpu.engine",
    "engines.system",
    "forces.ewald",
    "forces.fields",
    "forces.neighbors.pair_loop",
    "forces.parts",
    "forces.potentials",
    "run.checks",
    "run.minimise",
    "run.molecular",
    "run.summary",
    "scene.molecules",
    "scene.stage",
)


@pytest.mark.parametrize(
    ("off", "most"),
    [(("trajectory", "figures"), 775), (("figures",), 780), ((), 975)],
    ids=["no output", "trajectory", "default output"],
)
def test_a_run_of_a_top_loads_what_its_output_needs(off, most, tmp_path):
    """With its code in the cache. Numba and pydantic alone are 560 modules, Matplotlib 180."""
    arguments = ["run", "systems/heavy_top_3.toml", "-o", str(tmp_path / "run"), "--force"]
    for setting in ("run.duration_s=0.01", *(f"output.{name}=false" for name in off)):
        arguments += ["--set", setting]
    run = f"from rigidmd.commands.cli import main\nmain({arguments})"
    loaded_by(run)
    found = loaded_by(run)
    assert ("matplotlib" in found) == ("figures" not in off)
    others = "ase", "lammps", "MDAnalysis", "openmm", "rigidmd.analysis", "rigidmd.view"
    heavy = {"rocket_fft", "scipy.linalg", "scipy.sparse", "scipy.spatial", "scipy.special"}
    assert not {*others, *heavy} & found
    molecular = {f"rigidmd.{name}" for name in MOLECULAR}
    assert all(importlib.util.find_spec(name) for name in molecular)
    assert not molecular & found
    assert len(found) <= most, sorted(found)


def test_a_run_of_molecules_loads_no_module_of_bodies(tmp_path):
    found = loaded_by(
        "import rigidmd\nscene = rigidmd.Scene.read('systems/water.toml')\nrigidmd.Simulation(scene)"
    )
    assert "rigidmd.run.molecular" in found
    assert not {"rigidmd.features.bodies.run", "rigidmd.features.bodies.assemble"} & found


def test_every_folder_of_code_is_a_package():
    assert all((path.parent / "__init__.py").is_file() for path in FILES)


def test_the_top_level_holds_what_it_should():
    allowed = {"pyproject.toml", "rigidmd", "tests", "systems", "README.md", "LICENSE"}
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout")
    found = {line.split("/")[0] for line in listed.stdout.splitlines()}
    assert {name for name in found if not name.startswith(".")} <= allowed
