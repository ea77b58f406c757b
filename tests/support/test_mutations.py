"""The list of mutations fits the present sources: each applies, and the tests that it names are
there. It runs none."""

import ast
from collections import Counter
from functools import cache

import pytest

from support import mutations
from support.mutations import MUTATIONS, ROOT, applied, chosen, find_once, main, mutated


@cache
def functions_of(name: str) -> set[str]:
    """The functions of a test file."""
    tree = ast.parse((ROOT / "tests" / name).read_text(encoding="utf-8"))
    return {
        node.name
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    }


def test_mutations_apply_once_and_name_tests_that_exist():
    errors = []
    for mutation in MUTATIONS:
        text = (ROOT / "rigidmd" / mutation.file).read_text(encoding="utf-8")
        try:
            compile(mutated(mutation, text), mutation.file, "exec")
        except (ValueError, SyntaxError) as error:
            errors.append(f"{mutation.name}: {error}")
        if mutation.new == mutation.old or not 1 <= len(mutation.tests) <= 3:
            errors.append(f"{mutation.name}: changes nothing, or has not one to three tests")
        for test in mutation.tests:
            name, _, function = test.partition("::")
            if function.partition("[")[0] not in functions_of(name):
                errors.append(f"{mutation.name}: there is no test {test}")
    assert not errors, "\n".join(errors)


def test_code_is_found_whatever_its_line_breaks_and_trailing_commas_are():
    text = "x = f(\n    a,\n    b,\n) + g(a, b)\n"
    assert find_once("f(a, b) + g", text).span() == (4, 26)
    assert find_once("g(a, b)", text).group() == "g(a, b)"
    for code in ("f(a, c)", "a, b"):
        with pytest.raises(ValueError, match=r"occurs [02] times"):
            find_once(code, text)


def test_names_are_given_once():
    assert [name for name, count in Counter(m.name for m in MUTATIONS).items() if count > 1] == []
    assert chosen(["B7"])[0].name == "B7" and chosen([]) == MUTATIONS
    with pytest.raises(SystemExit, match="there is no mutation Z9"):
        chosen(["Z9"])


def test_a_mutated_file_is_given_back_as_it_was(tmp_path):
    mutation = MUTATIONS[0]
    path = tmp_path / "rigidmd" / mutation.file
    path.parent.mkdir(parents=True)
    path.write_text(f"a\n{mutation.old}\nb\n")
    before = path.stat().st_mtime_ns
    with pytest.raises(KeyError), applied(mutation, tmp_path):
        assert mutation.new in path.read_text() and mutation.old not in path.read_text()
        raise KeyError
    assert path.read_text() == f"a\n{mutation.old}\nb\n" and path.stat().st_mtime_ns == before
    for text in ("", 2 * f"{mutation.old}\n"):
        path.write_text(text)
        with pytest.raises(ValueError, match=r"occurs [02] times"), applied(mutation, tmp_path):
            pass


@pytest.mark.parametrize(
    ("ends", "code", "words"),
    [
        (
            (1, "FAILED tests/test_x.py::test_y[a - b] - assert 1\n1 failed"),
            0,
            "killed by test_x.py::test_y[a",
        ),
        ((2, "ERROR tests/test_x.py - ImportError\n1 error"), 0, "killed by test_x.py,"),
        ((0, "1 passed"), 1, "survived"),
        ((5, "no tests ran"), 1, "pytest ended with 5: no tests ran"),
        ((None, ""), 1, "no verdict within 900 s"),
        ((0, "2 skipped"), 1, "its tests were skipped"),
    ],
)
def test_verdicts(ends, code, words, monkeypatch, capsys, tmp_path):
    """Without a mutation all tests pass, then they end as given."""
    results = iter([(0, "1 passed"), ends])
    path = tmp_path / "checkout" / "rigidmd" / MUTATIONS[0].file
    path.parent.mkdir(parents=True)
    path.write_text(MUTATIONS[0].old)
    monkeypatch.setattr(
        mutations, "copy_of_checkout", lambda folder, working_tree: tmp_path / "checkout"
    )
    monkeypatch.setattr(mutations, "run_tests", lambda copy, arguments, limit: next(results))
    monkeypatch.setattr("sys.argv", ["mutations.py", MUTATIONS[0].name])
    assert main() == code
    printed = capsys.readouterr().out
    assert words in printed and f"{1 - code} of 1 killed" in printed
