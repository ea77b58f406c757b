"""Warnings of time steps that are too long."""

import pytest
from support.common import MOLECULES, small_scene
from support.scenes import GOOD

from rigidmd.assemble.time_step import step_errors, step_warnings
from rigidmd.scene import Scene


@pytest.mark.parametrize(
    ("model", "density", "temperature", "fine", "too_long", "words"),
    [
        ("spce", 1.0, 300, 5, 20, "about its lightest axis by 0.41 rad"),
        ("nitrogen", 0.8, 77, 40, 120, "about its lightest axis by 0.33 rad"),
        ("argon", 1.37, 94, 40, 150, "moves by 0.06"),
    ],
)
def test_check_ends_with_an_error_for_a_step_that_no_liquid_bears(
    model, density, temperature, fine, too_long, words, printed, tmp_path
):
    """Longest stable steps of these liquids, by `stiffest_mode` after 3 ps: 10.7, 63 and 90 fs."""
    text = GOOD.replace("lengths_A = 20.0", f"density_g_cm3 = {density}").replace(
        "= 300", f"= {temperature}"
    )
    text = text.replace("spce", model).replace("count = 20", "count = 400").replace("0.01", "1.0")
    for step, long in ((fine, False), (too_long, True)):
        (tmp_path / "liquid.toml").write_text(
            text.replace("timestep_fs = 1", f"timestep_fs = {step}")
        )
        warned = printed("check", tmp_path / "liquid.toml", code=int(long)).err
        assert bool(warned) == long
        if long:
            for part in (
                f"stages.0: timestep_fs = {step} is unstable for {model} at {temperature} K",
                words,
            ):
                assert part in warned


def test_a_step_is_long_for_what_moves_and_for_its_scheme():
    def warned(**more):
        stage = {"duration_ps": 1.0, "timestep_fs": 15.0} | more.pop("stage", {})
        molecules = [
            {"model": "spce", "count": 5, "frozen": more.pop("frozen", False)},
            {"model": "argon", "count": 5},
        ]
        return step_errors(small_scene({}, 20.0, molecules=molecules, stages=[stage], **more))

    assert len(warned()) == 1
    assert not warned(frozen=True)
    assert len(warned(frozen=[1, 2])) == 1
    assert not warned(
        stage={"integrator": "srkn_4"}
    )  # stable up to 1.6 times as far, and more accurate
    assert not warned(watch={"stable_step": False})
    assert not warned(start={"temperature_K": 30.0})
    assert (
        len(
            warned(
                start={"temperature_K": 100.0}, stage={"temperature_K": 300.0, "ensemble": "nvt"}
            )
        )
        == 1
    )


def test_no_shipped_scene_has_too_long_a_step():
    scenes = {path.stem: Scene.read(path) for path in MOLECULES}
    warned = {name: step_warnings(scene) + step_errors(scene) for name, scene in scenes.items()}
    assert not any(warned.values()), warned
