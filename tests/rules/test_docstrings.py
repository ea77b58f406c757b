"""Docstrings of the public interface, in NumPy style: all parameters with their types, and what is
returned."""

import inspect
import pydoc
import re
from functools import cached_property

import pytest

import rigidmd
import rigidmd.ase
from rigidmd import analysis, view
from rigidmd.core.state import State
from rigidmd.engines.observables import Observation
from rigidmd.features.analysis.result import AnalysisResult, Curve, Value
from rigidmd.features.bodies.system import Pose
from rigidmd.features.free_energy.virial import SecondVirial
from rigidmd.features.studies.normal_modes import NormalModes
from rigidmd.features.studies.sweep.table import Table
from rigidmd.run.production import Estimate

#: What public functions return.
RETURNED = (
    AnalysisResult,
    Curve,
    Estimate,
    NormalModes,
    Observation,
    Pose,
    SecondVirial,
    State,
    Table,
    Value,
)
PROPERTIES = (property, cached_property)
SECTION = re.compile(r"^(Parameters|Attributes|Returns|Raises|Examples)\n-+\n", re.MULTILINE)


def public_objects():
    modules = {
        "rigidmd": rigidmd,
        "rigidmd.analysis": analysis,
        "rigidmd.view": view,
        "rigidmd.ase": rigidmd.ase,
    }
    pairs = [(f"{m}.{name}", getattr(of, name)) for m, of in modules.items() for name in of.__all__]
    pairs += [(kind.__name__, kind) for kind in RETURNED]
    for name, value in pairs:
        if not inspect.ismodule(value):
            yield name, value
        if inspect.isclass(value):
            for member, function in inspect.getmembers_static(value):
                function_of = getattr(function, "fget", getattr(function, "__func__", function))
                module = getattr(function_of, "__module__", "") or ""
                if member[0] != "_" and member in dir(value) and module.startswith("rigidmd"):
                    yield f"{name}.{member}", function


PUBLIC = dict(public_objects())


def sections(doc):
    text, *parts = SECTION.split(doc)
    return text, dict(zip(parts[::2], parts[1::2], strict=True))


def entries(section):
    """Names -> (type, description) of the entries of a section."""
    found = {}
    for entry in re.split(r"^(?=\S)", section, flags=re.MULTILINE)[1:]:
        head, _, description = entry.partition("\n")
        names, _, kind = head.partition(" : ")
        found |= {name.strip(): (kind, description.strip()) for name in names.split(",")}
    return found


def documented(name, value):
    """Whether a public object has parameters to describe: a function, a method, or a class that
    users call."""
    if inspect.isclass(value):
        own = value.__init__
        return inspect.isfunction(own) and "Attributes" not in sections(inspect.getdoc(value))[1]
    return not isinstance(value, PROPERTIES) and callable(getattr(value, "__func__", value))


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_every_parameter_has_a_type_and_a_description(name):
    value = PUBLIC[name]
    if not (callable(getattr(value, "__func__", value)) or isinstance(value, PROPERTIES)):
        return  # a constant of a class
    doc = inspect.getdoc(value.func if isinstance(value, cached_property) else value)
    assert doc, f"{name} has no docstring"
    text, found = sections(doc)
    assert re.match(r"[^a-z]|g\(r\)", text), text
    for title in {"Parameters", "Attributes"} & set(found):
        for entry, (kind, description) in entries(found[title]).items():
            assert kind, f"{name}: {entry} has no type"
            # a capital, or the name of a value: "switch: ..."
            assert re.match(r"[^a-z]|\w+:", description), f"{name}: {entry}: {description[:40]}"
    if not documented(name, value):
        return
    function = getattr(value, "__func__", value.__init__ if inspect.isclass(value) else value)
    signature = inspect.signature(function)
    stars = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}
    wanted = {
        stars.get(parameter.kind, "") + parameter.name
        for parameter in signature.parameters.values()
        if parameter.name not in ("self", "cls")
    }
    if "pydantic" not in getattr(function, "__module__", ""):
        assert set(entries(found.get("Parameters", ""))) == wanted
    returns = signature.return_annotation not in (None, "None", inspect.Signature.empty)
    if not inspect.isclass(value):
        assert ("Returns" in found) == returns


def test_the_public_interface_is_found():
    for name in (
        "rigidmd.Simulation.run",
        "rigidmd.analysis.rdf",
        "rigidmd.view.plot",
        "Table.error",
    ):
        assert name in PUBLIC
    assert len(PUBLIC) > 120


def test_help_is_of_rigidmd_only():
    """Scenes have no names of pydantic, and no internals of packages."""
    scene = rigidmd.Scene.read("systems/water.toml")
    for section in (scene, scene.stages[0], scene.box, rigidmd.Scene, rigidmd.BodyScene):
        assert not {"model_dump", "json", "parse_obj", "construct", "model_fields"} & set(
            dir(section)
        )
    assert not {"errors_of_steps", "rounded_times", "first_moving", "contradictions"} & set(
        dir(scene)
    )
    assert {"stages", "molecules", "read", "name", "path"} <= set(dir(scene))
    assert {"thermostat", "duration_ps"} <= set(dir(scene.stages[0]))
    text = pydoc.plain(pydoc.render_doc(rigidmd))
    assert len(text.splitlines()) < 2400
    assert "pydantic" not in re.sub(r"pydantic\.main\.BaseModel|_Pydantic\w+", "", text)
