"""Analyses against the conditions of a run: each has a right result or a message on why it has none."""

from dataclasses import replace

import numpy as np
import pytest
from support.common import history, small_scene

from rigidmd.assemble.build import build
from rigidmd.errors import OutputError
from rigidmd.features.analysis.options import check_options, options_of
from rigidmd.features.analysis.registry import known
from rigidmd.features.analysis.runs import Runs
from rigidmd.mechanics.rotation import random_rotations

EDGE, COUNT, FRAMES = 16.0, 12, 60
NVT = {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 6.0}
NPT = NVT | {"ensemble": "npt", "pressure_bar": 1.0}
OF_AVERAGES = ("rdf", "structure_factor", "density_profile", "hydrogen_bonds", "nematic")
IN_TIME = ("msd", "diffusion", "orientation", "spectrum", "viscosity")
OF_EQUILIBRIUM = ("dielectric", "response", "insertion", "viscosity")


def made_up(stages=(NVT,), molecules=None, edge=EDGE, frames=FRAMES, **sections):
    """Frames of molecules that walk and rotate at random, with all samples."""
    molecules = molecules or [{"model": "spce", "count": COUNT}]
    sections = {"forces": {"cutoff_A": 5.0}} | sections
    system = build(small_scene({}, edge, molecules=molecules, stages=[*stages], **sections))
    rng = np.random.default_rng(5)
    time = 0.1 * np.arange(frames)
    walk = np.cumsum(0.1 * rng.standard_normal((frames, *system.state.position.shape)), axis=0)
    moving = system.model.inverse_mass[system.model.species] > 0
    shape = (frames, len(moving))
    rotates = len(system.state.rotation) > 0
    samples = {name: 300 + 9 * rng.standard_normal(frames) for name in ("temperature", "pressure")}
    samples["temperature_translation"] = samples["temperature"]
    samples |= {"time": time, "potential": -400 + 5 * rng.standard_normal(frames)}
    samples |= {"volume": system.state.volume / 1e3 * (1 + 0.01 * rng.standard_normal(frames))}
    samples["stage"] = np.full(frames, len(system.scene.stages) - 1)
    tensor = np.column_stack([time, 300 * rng.standard_normal((frames, 6))])
    momenta = rng.standard_normal((frames, shape[1] if rotates else 0, 3))
    made = history(
        system,
        time,
        system.state.position + walk * moving[:, None],
        system.state.cell,
        random_rotations(rng, frames * shape[1]).reshape(*shape, 3, 3) if rotates else None,
        rng.standard_normal((*shape, 3)),
        momenta,
        tensor,
    )
    return replace(made, columns=samples)


def refused(name, frames, /, **options):
    with pytest.raises(OutputError) as caught:
        known()[name].function(frames, **options)
    return str(caught.value)


@pytest.mark.parametrize(
    ("stage", "words"),
    [
        (NVT | {"name": "cooling", "temperature_K": [300.0, 100.0]}, "cooling the temperature"),
        (NPT | {"name": "pressing", "pressure_bar": [1.0, 1000.0]}, "pressing the pressure"),
    ],
)
def test_values_of_equilibrium_are_refused_on_a_ramp(stage, words):
    frames = made_up([stage])
    for name in {*IN_TIME, *OF_EQUILIBRIUM}:
        found = refused(name, frames)
        assert (
            found.startswith(f"{name} needs constant conditions: in the stage") and words in found
        )
    for name in OF_AVERAGES:
        assert known()[name].function(frames, **({"axis": "z"} if name == "nematic" else {})).curves


def test_frames_of_stages_that_differ_are_refused_with_the_time_to_begin_at():
    frames = made_up([NVT | {"temperature_K": 350.0}, NVT | {"name": "after"}])
    stage = np.where(frames.time < 2.05, 0, 1)
    mixed = replace(frames, columns=frames.columns | {"stage": stage})
    words = "temperature_K differs in the stages nvt and after. Use frames from 2 ps on"
    for name in {*IN_TIME, *OF_EQUILIBRIUM}:
        assert refused(name, mixed) == f"{name} needs constant conditions: {words}"
    # a stage begins with the last sample of the one before it
    first = replace(frames, columns=frames.columns | {"stage": np.minimum(1, np.arange(FRAMES))})
    assert known()["dielectric"].function(first).values
    # averages mix them, with a note
    (note,) = [text for text in known()["rdf"].function(mixed).notes if "together" in text]
    assert note == "of the stages after, nvt together; from 2 ps on frames are of the last one"
    assert not [text for text in known()["rdf"].function(first).notes if "together" in text]


@pytest.mark.parametrize("frames", [2, 9, FRAMES])
def test_no_analysis_has_a_value_without_an_error(frames):
    made = made_up(frames=frames)
    for name, entry in known().items():
        if entry.is_user:
            continue
        try:
            values = entry.function(made, **({"axis": "z"} if name == "nematic" else {})).values
        except OutputError:
            continue
        for value in values:
            assert value.value is None or np.isfinite(value.error), value.name


def test_runs_of_different_temperatures_are_refused():
    both = Runs((made_up(), made_up([NVT | {"temperature_K": 310.0}])))
    for name in {*IN_TIME, *OF_EQUILIBRIUM}:
        assert refused(name, both).endswith("temperature_K differs between the runs")


def test_samples_of_hybrid_monte_carlo_have_no_motion():
    frames = made_up([NVT | {"thermostat": "hybrid_monte_carlo"}])
    for name in IN_TIME:
        assert "needs motion in time, and the stage nvt samples by hybrid" in refused(name, frames)
    assert known()["dielectric"].function(frames).values


def test_a_field_that_oscillates_has_no_equilibrium():
    field = {"electric_V_per_nm": [0.0, 0.0, 0.1], "electric_frequency_per_ps": 1.0}
    frames = made_up(fields=field)
    for name in OF_EQUILIBRIUM:
        assert "static forces, and these depend on time: electric_field" in refused(name, frames)
    assert known()["msd"].function(frames).curves


def test_what_is_missing_in_a_run_is_named():
    frames = made_up()
    bare = replace(frames, velocities=None, L=None)
    assert refused("spectrum", bare).startswith("spectrum needs velocities in the frames")
    open_space = replace(frames, cell=np.full_like(frames.cell, np.inf))
    for name in (
        "rdf",
        "structure_factor",
        "density_profile",
        "dielectric",
        "insertion",
        "viscosity",
    ):
        assert refused(name, open_space).startswith(f"{name} needs a box")
    for name in known():
        if name not in ("response", "viscosity", "zero_step") and not known()[name].is_user:
            assert refused(name, frames[:1]).startswith(f"{name} needs the frames of a trajectory")


EXTREMES = {
    float: [-1.0, 0.0, 5e-324, 1e-300, 1e30, 1e300, np.inf, np.nan, "3", None, True, [1.0]],
    int: [-1, 0, 10**6 + 1, 10**30, 2.5, np.nan, "3", None, True],
    str: ["nothing", 3, None, "x" * 300],
    bool: [1, "true", None],
}


def kind_of(option):
    return type(option.default) if option.default is not None else float


@pytest.fixture(scope="module")
def water():
    return made_up()


def test_options_beyond_their_range_are_refused_in_one_sentence(water):
    seeds = (0, 10**6 + 1)
    for name, entry in known().items():
        for key, option in {} if entry.is_user else options_of(entry.function).items():
            for value in EXTREMES[kind_of(option)]:
                if (value is None and option.default is None) or (key == "seed" and value in seeds):
                    continue
                found = refused(name, water, **{key: value})
                assert found.count("\n") == 0 and len(found) < 700, (name, key, value)
                assert isinstance(value, str) or key in found, (name, key, value)


def test_options_at_the_ends_of_their_range_are_right_or_refused(water):
    for entry in known().values():
        for key, option in {} if entry.is_user else options_of(entry.function).items():
            limits = next(iter(getattr(option.annotation, "__metadata__", ())), None)
            for value in limits or ():
                value = kind_of(option)(value)
                try:
                    result = entry.function(water, **{key: value})
                except OutputError:
                    continue
                assert all(v.value is None or np.isfinite(v.value) for v in result.values)


def test_options_are_checked_on_the_command_line_before_frames_are_read():
    with pytest.raises(OutputError, match=r"^trials: 'many' is not like trials=1000$"):
        check_options([known()["insertion"].function], {"trials": "many"})
    with pytest.raises(OutputError, match=r"unknown option 'trial'.* trials"):
        check_options([known()["insertion"].function], {"trial": 3})
