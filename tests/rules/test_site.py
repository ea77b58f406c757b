"""The pages of the site that `.ci/site/build.py` writes. `.ci/run` builds the site from them."""

import re
import sys
from importlib import import_module
from pathlib import Path
from xml.etree.ElementTree import fromstring, tostring

import pytest
from support.common import ROOT

from rigidmd.core.shipped import CHAPTERS, DOCS


@pytest.fixture
def site(monkeypatch):
    """Imports a module of the generator."""
    monkeypatch.syspath_prepend(ROOT / ".ci" / "site")
    for name in ("api", "build", "equations"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return import_module


@pytest.fixture
def page(site, monkeypatch):
    """`build.page` with equations as TeX in angle brackets."""
    build = site("build")
    monkeypatch.setattr(build, "mathml", lambda tex, display: f"<{display}: {tex}>")
    return build.page


def test_the_site_needs_no_program_that_shows_it(site):
    site("build")
    assert "mkdocs" not in sys.modules


def test_the_navigation_has_all_pages_but_the_list_of_them(site):
    text = str(site("build").navigation())
    pages = set(re.findall(r"(\w+)\.md", text))
    assert pages == {*CHAPTERS, "index", "api"} - {"contents"}


def test_the_front_page_and_the_search_name_pages_of_the_documentation(site):
    front = (ROOT / ".ci" / "site" / "front.txt").read_text(encoding="utf-8")
    linked = set(re.findall(r"\]\(([\w/]+)\.md\)", front)) - {"reference/api"}
    assert linked <= {
        path.relative_to(DOCS).with_suffix("").as_posix() for path in CHAPTERS.values()
    }
    assert set(site("build").SYNONYMS) <= set(CHAPTERS)


def test_equations_are_converted_outside_code(page):
    text = page(Path("a.md"), "$a_b$ and `$HOME`\n\n$$x$$\n\n```sh\necho $a $b\n```\n")
    assert text == (
        '<span class="math"><inline: a_b></span> and `$HOME`\n\n'
        '<div class="math"><block: x></div>\n\n```sh\necho $a $b\n```\n'
    )


def test_links_out_of_the_documentation_become_text(page):
    text = "[`b`](../b.md#c), [c](../../c.py), [d](https://d.org), [e](#e), `[f](../../f.md)`"
    assert page(Path("guides/a.md"), text) == text.replace("[c](../../c.py)", "c")


def test_comments_are_omitted_and_options_stay_on_one_line(page):
    text = "<!-- test: not run -->\n`--until T` or `run`\n"
    assert page(Path("a.md"), text) == "\n`--until T`{ .option } or `run`\n"


@pytest.mark.parametrize("name", ["scene", "body"])
def test_each_key_of_a_scene_has_one_anchor(site, name):
    text = CHAPTERS[name].read_text(encoding="utf-8")
    anchors = re.findall(r'<a class="key" id="([^"]+)"', site("build").with_key_anchors(text))
    assert len(set(anchors)) == len(anchors)
    assert {anchor.rpartition("-")[2] for anchor in anchors} == set(
        re.findall(r"^\| `(\w+)`", text, re.MULTILINE)
    )
    assert {"scene": "stages-timestep_fs", "body": "body-solids-mass_kg"}[name] in anchors


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (
            "<msup><mi>H</mi><mi>′</mi></msup>",
            '<mrow><mi>H</mi><mo lspace="0" rspace="0">′</mo></mrow>',
        ),
        (
            "<msubsup><mi>U</mi><mi>i</mi><mi>″</mi></msubsup>",
            '<mrow><msub><mi>U</mi><mi>i</mi></msub><mo lspace="0" rspace="0">″</mo></mrow>',
        ),
        ("<msup><mi>x</mi><mn>2</mn></msup>",) * 2,
        ("<mi>Δ</mi><mi>δ</mi>", '<mi mathvariant="normal">Δ</mi><mi>δ</mi>'),
        ("<mi>a</mi><mo>−</mo><mi>b</mi>",) * 2,
        ("<mo>(</mo><mo>−</mo><mi>b</mi>", '<mo>(</mo><mo form="prefix">−</mo><mi>b</mi>'),
        (
            "<mi>d</mi><mi>ln</mi><mo>(</mo>",
            '<mi>d</mi><mspace width=".17em" /><mi>ln</mi><mo>(</mo>',
        ),
    ],
)
def test_equations_have_the_spacing_of_tex(site, before, after):
    equation = site("equations").typeset(fromstring(f"<math>{before}</math>"))
    assert tostring(equation, encoding="unicode") == f"<math>{after}</math>"


def test_the_reference_begins_with_what_a_script_needs(site):
    page = site("api").page()
    names = re.findall(r"^### `(\w+)", page, re.MULTILINE)
    assert names[:6] == ["Scene", "Simulation", "Results", "read_run", "Every", "sweep"]
    assert len(set(names)) == len(names)
    places = [page.index(f"\n## {title}\n") for title in ("rigidmd.analysis", "rigidmd.view")]
    assert page.index("### `sweep") < places[0] < places[1] < page.index("### `Force")


def test_the_reference_has_class_methods_cached_properties_and_code(site):
    page = site("api").page()
    for name in ("Scene.read", "Scene.from_dict", "Moment.observation", "Results.rotation"):
        assert f" {{ #{name} data-toc-label=" in page
    assert "```python\nclass Spring(rigidmd.Force):\n    def on_molecules" in page
    assert page.count("**Examples**") >= 9
    assert not re.search(r" at 0x|Annotated|Optional|_Buffer", page)


def test_the_reference_has_types_but_no_constructor_of_what_functions_return(site):
    page = site("api").page()
    assert "### `Results` {" in page
    assert "#### `Simulation.threads: int` {" in page
    assert "#### `Simulation.step(count: int = 1) -> int` {" in page
    assert ") -> Results`" in page
    assert "### `plot(results: Results, *columns: str, log: bool = False) -> Picture` {" in page
