"""`rigidmd stability`: the cases, the verdicts, the files written."""

import csv
from math import inf, nan

import pytest

from rigidmd.commands.cli import main
from rigidmd.errors import SceneError
from rigidmd.studies.stability.cases import (
    CASES,
    CRASH,
    REFUSED,
    REPORTED,
    RIGHT,
    UNDETECTED,
    CaseResult,
    Outcome,
    failure,
    longest_step,
)
from rigidmd.studies.stability.report import conclusions, run_cases, selected_cases, table_text

NAMES = [case.name for case in selected_cases(None)]


def check(result: CaseResult) -> None:
    """No undetected error, everything as expected, something measured."""
    said = "\n".join(conclusions([result]))
    assert result.failures == [], said
    assert [(t.setting, t.family, t.verdict) for t in result.unexpected] == [], said
    assert result.runs
    assert all(limit.longest > 0 for limit in result.limits)
    assert all(line in table_text([result]) for line in result.families if line)


#: Cases whose scenes nothing else compiles.
APART = (
    "water_steps",
    "head_on",
    "overlaps",
    "bare_charges",
    "near_linear_molecules",
    "tip4p_steps",
    "sleeping_top",
    "densities",
    "no_numbers",
)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(case.name, marks=[pytest.mark.soak] if case.name in APART else [])
        for case in selected_cases(None)
    ],
)
def test_quick(name):
    (result,) = run_cases([name], quick=True)
    check(result)


@pytest.mark.soak
@pytest.mark.parametrize("name", [case.name for case in selected_cases(None)])
def test_whole(name):
    (result,) = run_cases([name])
    check(result)


def test_every_group_of_the_list_has_a_case():
    assert {case.group for case in selected_cases(None)} == set(range(1, 15))


@pytest.mark.parametrize(
    ("outcome", "verdict"),
    [
        (Outcome(1e-9, 0.0), RIGHT),
        (Outcome(1.0, 1e-9), UNDETECTED),
        (Outcome(nan, 1e-9), UNDETECTED),
        (Outcome(inf, 0.5), REPORTED),
        (Outcome(1.0, inf), REPORTED),
        (Outcome(message="too long"), REFUSED),
        (Outcome(crash="IndexError"), CRASH),
    ],
)
def test_verdicts(outcome, verdict):
    result = CaseResult("made_up", 1, "A case")
    result.add("once", outcome, 1e-6)
    assert result.runs[0].verdict == verdict
    assert bool(result.failures) == (verdict in (UNDETECTED, CRASH))
    assert (result.unexpected == []) == (verdict == RIGHT)


@pytest.mark.parametrize(
    ("beyond", "way"),
    [
        (Outcome(reported_error=0.3), "drift"),
        (Outcome(reported_error=1e9), "blow-up"),
        (Outcome(reported_error=inf), "blow-up"),
        (Outcome(message="no number"), "detected"),
        (Outcome(crash="ZeroDivisionError"), CRASH),
    ],
)
@pytest.mark.parametrize("start", [1e-3, 1.0, 50.0])
def test_the_longest_step_is_found_by_bisection(beyond, way, start):
    limit = longest_step(
        lambda step: Outcome(reported_error=1e-4) if step <= 0.73 else beyond, start
    )
    assert 0.73 / 1.11 < limit.longest <= 0.73
    assert limit.beyond == way == failure(beyond)


def test_a_step_that_never_fails_and_one_that_never_holds():
    assert longest_step(lambda step: Outcome(reported_error=0.0), 1.0).longest == inf
    assert longest_step(lambda step: Outcome(reported_error=9.0), 1.0).longest == 0.0


def test_an_undetected_error_beyond_the_step_limit_is_a_failure():
    result = CaseResult("made_up", 1, "A case")
    limit = longest_step(
        lambda step: Outcome(reported_error=1e-4 if step < 1 else 5e-4), 0.1, bound=2e-4
    )
    result.limits.append(limit)
    assert limit.beyond == UNDETECTED
    assert result.failures


def test_the_command_writes_its_files_and_does_not_overwrite(tmp_path, capsys):
    arguments = ["stability", "--quick", "--case", "inertia_scale", "-o", str(tmp_path / "out")]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "inertia_scale" in said and "1 cases, 6 runs: 6 right" in said
    with (tmp_path / "out" / "stability.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert len(lines) == 6
    assert {line["verdict"] for line in lines} == {"right"}
    assert all(float(line["error"]) <= float(line["allowed"]) for line in lines)
    page = (tmp_path / "out" / "stability.html").read_text()
    assert (
        "largest |Q - Q of the body itself|" in page
        and "<script" not in page
        and "src=" not in page
    )
    assert page.count('id="case-inertia_scale"') == 1 and 'href="#case-inertia_scale"' in page
    assert main(arguments) == 2
    assert "--force" in capsys.readouterr().err
    assert main([*arguments, "--force"]) == 0


def test_an_undetected_error_is_exit_code_1(tmp_path, capsys, monkeypatch):
    def lie(find, quick):
        find.add("always", Outcome(1.0, 0.0), 1e-3)

    monkeypatch.setitem(CASES, "liar", CaseResult("liar", 1, "Says nothing", run=lie))
    assert main(["stability", "--case", "liar", "-o", str(tmp_path / "out")]) == 1
    assert "liar, always: undetected" in capsys.readouterr().out


def test_an_unknown_case_gets_a_suggestion(tmp_path, capsys):
    assert main(["stability", "--case", "near_liner", "-o", str(tmp_path / "out")]) == 2
    assert "did you mean near_linear" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(SceneError):
        list(run_cases(["nothing"]))


def test_the_help_has_an_example(capsys):
    with pytest.raises(SystemExit):
        main(["stability", "--help"])
    assert "rigidmd stability --quick --case" in capsys.readouterr().out
