"""A walk: every command on every shipped scene and model ends well, or refuses for a listed reason.

A command that is tried on one scene only may fail on the next one. The cells are in `walk`.
"""

from collections.abc import Iterator

import pytest
from support.walk import (
    SHIPPED,
    alone,
    commands_of,
    commands_of_model,
    end_of,
    liquid_of,
    models,
    reason_against,
    short_form,
)

SAMPLE = {"t_handle", "water_dimer"}  # the cheapest of each kind


def failures_of(subject: str, cells: Iterator[tuple[str, list[str]]]) -> list[str]:
    """What is wrong with the commands of a scene or model, one after the other."""
    ends = ((cell, *end_of(arguments)) for cell, arguments in cells)
    faults = ((cell, reason_against(cell, subject, code, text)) for cell, code, text in ends)
    return [f"{cell} {fault}" for cell, fault in faults if fault]


@pytest.fixture(autouse=True)
def _working_directory(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)


def test_a_walk_distinguishes_wrong_ends_from_true_reasons():
    assert not reason_against("check", "argon", 0, "500 molecules")
    assert not reason_against("modes", "t_handle", 2, "normal modes need a molecular scene")
    assert "ends with 2" in reason_against("run", "t_handle", 2, "normal modes need")
    assert "ends with 2" in reason_against("modes", "water", 2, "an unknown reason")
    for text in ("B2 nan ± 1", "x.py:79: UserWarning: no", "Traceback (most", "-inf K"):
        assert "prints" in reason_against("check", "argon", 0, text)


@pytest.mark.parametrize("name", sorted(SAMPLE))
def test_a_sample_of_the_walk(name, tmp_path):
    failures = failures_of(name, commands_of(short_form(SHIPPED[name], tmp_path)))
    assert not failures, "\n\n".join(failures)


@pytest.mark.parametrize("name", sorted(SHIPPED.keys() - SAMPLE))
def test_every_command_on_a_shipped_scene(name, tmp_path):
    failures = failures_of(name, commands_of(short_form(SHIPPED[name], tmp_path)))
    assert not failures, "\n\n".join(failures)


@pytest.mark.parametrize("name", models())
def test_every_command_on_a_liquid_of_a_shipped_model(name, tmp_path):
    failures = failures_of("liquid", commands_of(liquid_of(name, tmp_path)))
    assert not failures, "\n\n".join(failures)


@pytest.mark.parametrize("name", models())
def test_every_command_on_one_molecule_of_a_shipped_model(name, tmp_path):
    failures = failures_of("alone", commands_of(alone(name, tmp_path)))
    assert not failures, "\n\n".join(failures)


@pytest.mark.parametrize("name", models())
def test_every_command_on_a_shipped_model(name, tmp_path):
    host = short_form(SHIPPED["argon"], tmp_path)
    run = tmp_path / "host"
    assert end_of(["run", str(host), "-o", str(run)])[0] == 0
    failures = failures_of(name, commands_of_model(name, run, tmp_path))
    assert not failures, "\n\n".join(failures)
