"""`rigidmd stability`: the cases, the verdicts, the files written."""

import csv
from math import inf, nan

import pytest

from rigidmd.commands.cli import main
from rigidmd.errors import SceneError
from rigidmd.features.studies.stability import cases
from rigidmd.features.studies.stability.cases import (
    BUILDERS,
    CASES,
    CRASH,
    REFUSED,
    REPORTED,
    RIGHT,
    UNDETECTED,
    Case,
    Outcome,
    Trial,
)
from rigidmd.features.studies.stability.report import conclusions, table_text
from rigidmd.features.studies.stability.runner import TrialResult, failure, longest_step, run_cases

CASE = Case("made_up", 1, "A case", [])


def check(results: list[TrialResult]) -> None:
    """No undetected error, everything as expected, something measured."""
    sentences = "\n".join(conclusions(results))
    assert [result.failure for result in results if result.failure] == [], sentences
    assert [result.name for result in results if result.is_unexpected] == [], sentences
    assert any(result.verdict for result in results)
    assert all(result.limit.longest > 0 for result in results if result.limit is not None)
    assert all(result.integrator in table_text(results) for result in results)


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
    [pytest.param(name, marks=[pytest.mark.soak] if name in APART else []) for name in CASES],
)
def test_quick(name):
    check(list(run_cases([name], quick=True)))


@pytest.mark.soak
@pytest.mark.parametrize("name", CASES)
def test_whole(name):
    check(list(run_cases([name])))


def test_every_group_of_the_list_has_a_case():
    assert {case.group for case in CASES.values()} == set(range(1, 15))


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
    result = TrialResult(CASE, Trial("once", allowed=1e-6), "pefrl", outcome)
    assert result.verdict == verdict
    assert bool(result.failure) == (verdict in (UNDETECTED, CRASH))
    assert result.is_unexpected == (verdict != RIGHT)


def test_a_scene_that_must_be_refused_has_no_right_answer():
    trial = Trial("once", allowed=1e-6, expected=(REFUSED,))
    assert TrialResult(CASE, trial, "pefrl", Outcome(0.0, 0.0)).verdict == UNDETECTED
    assert not TrialResult(CASE, trial, "pefrl", Outcome(message="no mass")).is_unexpected


def test_an_integrator_has_its_allowed_error():
    trial = Trial("once", allowed=1e-6, allowed_of={"pefrl": 1e-3}, rounding=1e-7)
    assert TrialResult(CASE, trial, "pefrl", Outcome()).allowed == pytest.approx(1.0001e-3)
    assert TrialResult(CASE, trial, "srkn_4", Outcome()).allowed == pytest.approx(1.1e-6)


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
    limit = longest_step(
        lambda step: Outcome(reported_error=1e-4 if step < 1 else 5e-4), 0.1, bound=2e-4
    )
    assert limit.beyond == UNDETECTED
    result = TrialResult(CASE, Trial("once", is_bisected=True), "pefrl", Outcome(), limit)
    assert result.failure.startswith("made_up, once pefrl, steps beyond 0.9")
    assert conclusions([result])[0].startswith("failed: 0 of 0 runs in 1 case")


def test_rows_have_the_keys_of_their_layers():
    case = Case(
        "made_up",
        1,
        "A case",
        common={"setting": "{:.0e} m", "scene": {"a": ["x", "2 + 0.5 x"], "b": 1}, "steps": 5},
        rows=[
            {"values": [1.0, 2.0], "quick": {"values": [4.0], "steps": 3}},
            {"scene": {"b": {"c": "3e2 x"}}, "values": [2.0], "bisect": [False, True]},
        ],
    )
    whole, quick = list(case.trials(False)), list(case.trials(True))
    assert [trial.setting for trial in whole] == ["1e+00 m", "2e+00 m", "2e+00 m", "2e+00 m"]
    assert [trial.is_bisected for trial in whole] == [False, False, False, True]
    assert whole[1].scene == {"a": [2.0, 3.0], "b": 1}
    assert whole[2].scene == {"a": [2.0, 3.0], "b": {"c": 600.0}}
    assert [trial.steps for trial in whole] == [5, 5, 5, 5]
    assert [(trial.setting, trial.steps) for trial in quick[:2]] == [("4e+00 m", 3), ("2e+00 m", 5)]
    assert len(whole[0].integrators) == 5 and len(quick[0].integrators) == 3


def test_molecules_of_the_table_are_sites():
    (water,) = cases.insert([{"molecule": "tip4p", "count": 2}], 1.0)
    assert water["count"] == 2
    assert [site["name"] for site in water["sites"]] == ["OW", "HW1", "HW2", "MW"]
    assert sum(site.get("charge_e", 0.0) for site in water["sites"]) == pytest.approx(0.0)
    assert "sigma_A" in water["sites"][0] and "sigma_A" not in water["sites"][1]
    assert cases.insert({"molecule": "bent_by_x"}, 0.25)["sites"][1]["position_A"][1] == 0.25


def test_the_command_writes_its_files_and_does_not_overwrite(tmp_path, capsys):
    arguments = ["stability", "--quick", "--case", "inertia_scale", "-o", str(tmp_path / "out")]
    assert main(arguments) == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("passed: 6 of 6 runs in 1 case; 6 right")
    assert "warning:" not in printed.err
    assert "\ninertia_scale  velocity_verlet, exact rotor " in printed.out
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


@pytest.fixture
def liar(monkeypatch):
    """A case whose answer is wrong, with a warning of its run."""

    def lie(trial, integrator, warn, step):
        warn("the moon is full")
        return Outcome(1.0, 0.0)

    def build(trial, x):
        yield trial._replace(run=lie)

    monkeypatch.setitem(BUILDERS, "lie", build)
    row = {"setting": "always", "build": "lie", "allowed": 1e-3, "integrators": ["pefrl"]}
    monkeypatch.setitem(CASES, "liar", Case("liar", 1, "Is never right", [row]))


def test_an_undetected_error_is_exit_code_1(tmp_path, capsys, liar):
    assert main(["stability", "--case", "liar", "-o", str(tmp_path / "out")]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("failed: 0 of 1 runs in 1 case; 1 undetected;")
    assert lines[0].endswith("; 1 warnings, which -v lists")
    assert lines[1] == "liar, always pefrl: undetected"


def test_warnings_follow_the_answer_and_only_where_they_are_wanted(tmp_path, capsys, liar):
    arguments = ["stability", "--case", "liar", "-o", str(tmp_path / "out")]
    main(arguments)
    assert "moon" not in "".join(capsys.readouterr())
    main([*arguments, "--force", "-v"])
    printed = capsys.readouterr()
    assert "moon" not in printed.err
    assert printed.out.index("failed: ") < printed.out.index("liar, always pefrl: the moon is full")


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
