"""`rigidmd stability`: the battery, the verdicts, what it writes."""

import csv
from math import inf, nan

import pytest
from support import CRASH, REFUSED, RIGHT, SILENT, TOLD, Outcome, battery, failure, longest_step
from support import StabilityFinding as Finding
from support import chosen_cases as chosen
from support import stability_failed as failed
from support import stability_picture as picture
from support import stability_table as table_text
from support import stability_words as words

from rigidmd.commands.cli import main
from rigidmd.errors import SceneError

NAMES = [case.name for case in chosen(None)]


def check(finding: Finding) -> None:
    """Nothing silent, everything as expected, something measured."""
    said = "\n".join(words([finding]))
    assert finding.silent == [], said
    assert [(t.setting, t.family, t.verdict) for t in finding.unexpected] == [], said
    assert finding.trials
    assert all(limit.longest > 0 for limit in finding.limits)
    assert all(line in table_text([finding]) for line in finding.families if line)


#: Cases whose scenes nothing else compiles.
APART = ("water_steps", "head_on", "overlaps")


@pytest.mark.parametrize(
    "name",
    [pytest.param(case.name, marks=[pytest.mark.soak] if case.name in APART else []) for case in chosen(None)],
)
def test_quick(name):
    (finding,) = battery([name], quick=True)
    check(finding)


@pytest.mark.soak
@pytest.mark.parametrize("name", [case.name for case in chosen(None)])
def test_whole(name):
    (finding,) = battery([name])
    check(finding)


def test_every_group_of_the_list_has_a_case():
    assert {case.group for case in chosen(None)} == set(range(1, 15))


@pytest.mark.parametrize(
    ("outcome", "verdict"),
    [
        (Outcome(1e-9, 0.0), RIGHT),
        (Outcome(1.0, 1e-9), SILENT),
        (Outcome(nan, 1e-9), SILENT),
        (Outcome(inf, 0.5), TOLD),
        (Outcome(1.0, inf), TOLD),
        (Outcome(message="too long"), REFUSED),
        (Outcome(crash="IndexError"), CRASH),
    ],
)
def test_verdicts(outcome, verdict):
    finding = Finding("made_up", 1, "A case")
    finding.add("once", outcome, 1e-6)
    assert finding.trials[0].verdict == verdict
    assert failed([finding]) == (verdict in (SILENT, CRASH))
    assert bool(finding.silent) == failed([finding])
    assert (finding.unexpected == []) == (verdict == RIGHT)


@pytest.mark.parametrize(
    ("beyond", "way"),
    [
        (Outcome(told=0.3), "drift"),
        (Outcome(told=1e9), "blow-up"),
        (Outcome(told=inf), "blow-up"),
        (Outcome(message="no number"), "detected"),
        (Outcome(crash="ZeroDivisionError"), CRASH),
    ],
)
@pytest.mark.parametrize("start", [1e-3, 1.0, 50.0])
def test_the_longest_step_is_found_by_bisection(beyond, way, start):
    limit = longest_step(lambda step: Outcome(told=1e-4) if step <= 0.73 else beyond, start)
    assert 0.73 / 1.11 < limit.longest <= 0.73
    assert limit.beyond == way == failure(beyond)
    assert list(limit.curve) == sorted(limit.curve)


def test_a_step_that_never_fails_and_one_that_never_holds():
    assert longest_step(lambda step: Outcome(told=0.0), 1.0).longest == inf
    assert longest_step(lambda step: Outcome(told=9.0), 1.0).longest == 0.0


def test_a_wrong_answer_beyond_the_limit_that_looks_quiet_fails_the_battery():
    finding = Finding("made_up", 1, "A case")
    limit = longest_step(lambda step: Outcome(told=1e-4 if step < 1 else 5e-4), 0.1, bound=2e-4)
    finding.limits.append(limit)
    assert limit.beyond == SILENT
    assert failed([finding])


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
    assert "<svg" in page and "<script" not in page and "src=" not in page
    assert page.count('id="case-inertia_scale"') == 1 and 'href="#case-inertia_scale"' in page
    assert "| inertia_scale |" in (tmp_path / "out" / "stability.md").read_text()
    assert main(arguments) == 2
    assert "--force" in capsys.readouterr().err
    assert main([*arguments, "--force"]) == 0


def test_a_silent_case_is_exit_code_1(tmp_path, capsys, monkeypatch):
    from support import CASES, Case

    def lie(find, quick):
        find.add("always", Outcome(1.0, 0.0), 1e-3)

    monkeypatch.setitem(CASES, "liar", Case("liar", 1, "Says nothing", lie, ("", "", "s")))
    assert main(["stability", "--case", "liar", "-o", str(tmp_path / "out")]) == 1
    assert "liar, always: SILENT" in capsys.readouterr().out


def test_an_unknown_case_gets_a_suggestion(tmp_path, capsys):
    assert main(["stability", "--case", "near_liner", "-o", str(tmp_path / "out")]) == 2
    assert "did you mean near_linear" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(SceneError):
        list(battery(["nothing"]))


def test_the_help_has_an_example(capsys):
    with pytest.raises(SystemExit):
        main(["stability", "--help"])
    assert "rigidmd stability --quick --case" in capsys.readouterr().out


def test_what_was_refused_far_away_does_not_stretch_a_figure():
    finding = Finding("made_up", 1, "A case", "x", "error")
    for x in (1.0, 10.0, 1e300):
        finding.add("once", Outcome(1e-9, 0.0) if x < 1e9 else Outcome(message="too far"), x, "a family", x)
    assert picture(finding).axes[0].get_xlim()[1] < 1e9


def test_a_case_without_numbers_has_no_figure():
    finding = Finding("made_up", 1, "A case")
    finding.add("once", Outcome(message="no"), 0.0, expected=(REFUSED,))
    assert picture(finding) is None
