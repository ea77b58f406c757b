"""Rewriting of quoted outputs."""

from support.documents import blocks_of, output_of
from support.outputs import Page, renewed

PRINTED = """\
head 12
  temperature  300.1 ± 2 K
  more
  pressure     -20 ± 4 bar
"""


def test_lines_get_the_numbers_of_the_new_output():
    quoted = "head 9\n  temperature  298 ± 12 K\n...\n  pressure     5 ± 3 bar"
    text, missing = renewed(quoted, PRINTED)
    assert text.splitlines() == [
        "head 12",
        "  temperature  300.1 ± 2 K",
        "...",
        "  pressure     -20 ± 4 bar",
    ]
    assert missing == []


def test_lines_that_are_not_in_the_output_or_in_another_order_stay_and_are_reported():
    text, missing = renewed("  pressure     1 ± 1 bar\n  temperature  too short", PRINTED)
    assert text == "  pressure     -20 ± 4 bar\n  temperature  too short"
    assert missing == ["  temperature  too short"]


PAGE = """# Page

<!-- test: file a.toml -->
```toml
[body]
mass_kg = 1.0
inertia_kg_m2 = [1.0, 2.0, 2.5]

[run]
duration_s = 1.0
timestep_s = 0.01
```

<!-- output: rigidmd check a.toml | rigidmd 0.1 at 1234567, somewhere, 2 s -->
```text
a: one body, asymmetric, 3 kg, 6 degrees of freedom
```
"""


def test_a_block_of_a_page_is_rewritten_with_where_it_was_made(tmp_path):
    (path := tmp_path / "page.md").write_text(PAGE, encoding="utf-8")
    page = Page(path, tmp_path / "page")
    block = page.blocks[-1]
    assert page.rewrite(block, output_of(block)) == [f"{path}:{block.line}: changed"]
    block = blocks_of(path)[-1]
    assert block.text == "a: one body, asymmetric, 1 kg, 6 degrees of freedom"
    assert "0.1 at" not in output_of(block).where
    assert Page(path, tmp_path / "again").rewrite(block, output_of(block)) == []


def test_digits_in_names_and_longer_words_are_not_numbers():
    printed = "srkn_4  2.0\n  temperature of a wall  3\n9999 steps of 0.1 s; fast\nsrkn_6  3.5\n"
    quoted = "srkn_6  2.0\n3400 steps of 0.0005 s; ..."
    assert renewed("srkn_6  2.0", printed) == ("srkn_6  3.5", [])
    assert renewed("  temp", printed)[1] == ["  temp"]
    assert renewed(quoted.splitlines()[1], printed)[1] == ["3400 steps of 0.0005 s; ..."]
