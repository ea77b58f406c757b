"""The vocabulary: docstrings, messages, help texts and documents use the field's terms."""

import ast
import functools
import json
import re
import sys
from pathlib import Path

import pytest
from support.common import ROOT

PACKAGE = ROOT / "rigidmd"

#: Pattern of a word that is not used -> what to write instead. All are matched in lower case.
REFUSED = {
    r"waves?(?!\s+(?:vectors?|numbers?)\b)": "k-vectors, reciprocal space",
    r"endings?": "truncation, cutoff scheme; of a file name: extension",
    r"baths?": "thermostat",
    r"books?|booked|pays?|paid": "energy ledger: heat, work; accounted for",
    r"looks?|looked|looking(?! up)": "observation; observed",
    r"told|tells?|telling|says?|said|saying": "given, passed, set; report, print, name",
    r"own|one's own": "user, custom; or leave it out",
    r"shares": "fractions, work ranges",
    r"share (?:of|that|in)": "fraction, work range",
    r"crews?|leaders?|parcels?": "thread pool, main thread, task arguments",
    r"stretch(?:es|ed|ing)?": "segment of a run; scaling of a box",
    r"places?|placed|placing": "position",
    r"turn(?:s|ed|ing)?": "rotate; become",
    r"leans?|leaning": "tilt",
    r"laws?": "pair potential",
    r"go(?:es|ing)? on|went on": "resume, continue",
    r"held against|stands? against": "compared with",
    r"beside": "next to",
    r"apart(?! from)": "separate, differ",
    r"faults?|mistakes?": "error",
    r"so many|is no [a-z]+|that of the|those of the": "name the thing",
    r"rooms?|doors?|houses?|whoever": "package, interface, architecture; memory, space",
    r"reliefs?|relieves?|relieved|relieving": "overlap removal",
}
#: Further ones, which the sources of kernels still have: their next change, which compiles all
#: anew, mends them.
REFUSED_OUTSIDE_KERNELS = {
    r"asks|asked": "request, require, call",
    r"in words|in a sentence": "with a message",
    r"films?": "animation",
    r"cut-offs?": "cutoff",
    r"(?-i:Of) (?!(?:course|two|the|these|those|each|all)\b)[a-z]+": "For ...; With ...; an adjective",
    r"in which time passes": "that is not a minimisation",
    r"known here|at hand|is not here": "there are; available; not installed",
    r"lets? go|letting go": "release",
    r"(?<!there\s)are no (?!longer|more|less)[a-z]+": "are not",
    r"(?:steps|frames|sites|times|values|once|twice) an? (?:second|step|molecule|day|frame|rotation)": "per",
    r"strangers?|battery|whimsical": "untrusted input; test suite",
    r"barely (?:feels?|sees?)": "is barely disturbed",
    r"hardly": "barely",
    r"flatter than|longer than thick": "oblate, prolate",
    r"rms about the line": "rms deviation from the linear fit",
    r"(?:must be|is|are|be) (?:a )?whole numbers?(?! of| from)": "integer",
    r"anew|hence|seldom": "again; so, therefore; rarely",
    r"(?:would do|does|do) nothing": "has no effect",
    r"rows? of coefficients": "scheme, coefficients",
    r"errors? of the (?:time )?steps?|corrected for the step": "time-step error",
}
KERNELS = re.compile(
    r"rigidmd/(?:compile|mechanics|forces|dynamics|engines/(?:cpu|ode|protocol)|core/(?:integrators|state))\b"
)
EVERY = REFUSED | REFUSED_OUTSIDE_KERNELS
WORDS = re.compile(
    rf"(?<![\w`./-])(?:{'|'.join(f'({pattern})' for pattern in EVERY)})(?![\w`/-])", re.IGNORECASE
)

#: Uses that stay: they are names of the field or of keys.
ALLOWED = re.compile(
    r"""
      Newton's\ laws?|law\ of\ \w+|Coulomb's\ law|Fick's\ law|second\ law      # physics
    | (?:plane|sound|sine|square)\ waves?
    | turns?\ (?:on|off|out)|in\ turns?|turned\ (?:on|off)
    | takes?\ place|took\ place|taking\ place|in\ place(?:\ of)?|decimal\ places?|first\ place
    | (?:its|their|your|his|our)\ own                                         # but not "one's own"
    | rigidmd\ film|film\.\w+|are\ no\ exception|say\ :\ callable
    | no\ longer|(?:is\ )?no\ such|no\ more|no\ less|books?\ of\ \w+
    | look(?:s|ed|ing)?\ (?:up|for|at|like)|what\ to\ look\ at              # of people
    """,
    re.IGNORECASE | re.VERBOSE,
)


#: What names of tests may have, as they are short.
NOT_IN_NAMES = ("name the thing",)


def squeezed(text):
    """Text with one space for a line break and the margin after it."""
    return re.sub(r"\s+", " ", text)


def refused_in(text):
    """(position, word, better) of each refused word in plain text."""
    for match in WORDS.finditer(text):
        before = squeezed(text[max(0, match.start() - 60) : match.start()])
        around = before + squeezed(text[match.start() : match.end() + 60])
        at = len(before)
        if not any(m.start() <= at < m.end() for m in ALLOWED.finditer(around)):
            yield match.start(), match.group(), list(EVERY.values())[match.lastindex - 1]


CODE = re.compile(r"```.*?```|`[^`\n]*`|<[^>\n]*>|https?://\S+|\]\([^)\s]*\)", re.DOTALL)


def without_code(text):
    """Text in which quoted code and the targets of links are blank, so that positions and lines
    stay."""
    return CODE.sub(lambda m: re.sub(r"[^\n]", " ", m.group()), text)


@functools.cache
def nodes_of(path):
    """All nodes of a Python file."""
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def texts_of(path):
    """(line, text) of docstrings, and of strings of several words, of a Python file; of the whole
    of a document; of comments of a scene; of the text of a notebook."""
    source = path.read_text(encoding="utf-8")
    if path.suffix == ".toml":
        yield from (
            (n, without_code(line.partition("#")[2]))
            for n, line in enumerate(source.splitlines(), 1)
        )
        return
    if path.suffix == ".ipynb":
        yield from (
            (1, without_code("".join(cell["source"]))) for cell in json.loads(source)["cells"]
        )
        return
    if path.suffix == ".md":
        yield 1, without_code(source)
        return
    if path.suffix == ".js":
        quoted = re.compile(r"//(.*)$|\"([^\"]* [^\"]*)\"|'([^']* [^']*)'|`([^`]* [^`]*)`")
        for number, line in enumerate(source.splitlines(), 1):
            yield from (
                (number, without_code(next(filter(None, match.groups()), "")))
                for match in quoted.finditer(line)
            )
        return
    if path.is_relative_to(ROOT / "tests"):  # strings of tests quote code, input and messages
        yield from docstrings_of(path)
        return
    inner = {
        id(part)
        for node in nodes_of(path)
        if isinstance(node, ast.JoinedStr)
        for part in ast.walk(node)
    }
    for node in nodes_of(path):
        if isinstance(node, ast.JoinedStr):
            text = "".join(v.value if isinstance(v, ast.Constant) else "\0" for v in node.values)
        elif (
            isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inner
        ):
            text = node.value
        else:
            continue
        if re.search(r"[A-Za-z]{2,}\S* \S*[A-Za-z]{2,}", text):
            yield node.lineno, without_code(text)


def docstrings_of(path):
    """(line, text) of the docstrings of a Python file."""
    for node in nodes_of(path):
        kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
        if isinstance(node, kinds) and ast.get_docstring(node, clean=False):
            text = node.body[0].value
            yield text.lineno, without_code(text.value)


#: Parts of identifiers that are not used, besides the words above.
REFUSED_NAMES = set(
    [
        "bath",
        "baths",
        "book",
        "books",
        "booked",
        "crew",
        "ending",
        "endings",
        "law",
        "laws",
        "leader",
        "lean",
        "leaning",
        "leans",
        "look",
        "looked",
        "looks",
        "mistake",
        "own",
        "parcel",
        "pays",
        "relief",
        "relieve",
        "relieved",
        "room",
        "share",
        "shares",
        "stretch",
        "stretches",
        "tell",
        "told",
        "wave",
        "waves",
    ]
)


def names_in(path):
    """(line, name) of what a Python file defines: functions, classes, arguments, variables,
    attributes."""
    for node in nodes_of(path):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, (ast.Name, ast.Attribute)) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id if isinstance(node, ast.Name) else node.attr


def refused_names_in(path):
    """(line and name, refused parts) of the names that a file defines."""
    for line, name in names_in(path):
        parts = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().split("_")
        if bad := sorted(REFUSED_NAMES & set(parts)):
            yield f"{line}: the name {name!r}", bad


def refused_names(path):
    return [
        f"{path.relative_to(ROOT)}:{name} has {', '.join(bad)}"
        for name, bad in refused_names_in(path)
    ]


def comments_of(path):
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        if match := re.search(r"(?:^|\s)#:? (.*)$", line):
            yield number, without_code(match.group(1))


def found_in(path, comments=False):
    """Lines 'file:line: word, write ...' of a file."""
    pieces = [*texts_of(path), *(comments_of(path) if comments and path.suffix == ".py" else ())]
    later = (
        REFUSED_OUTSIDE_KERNELS.values() if KERNELS.match(path.relative_to(ROOT).as_posix()) else ()
    )
    for line, text in pieces:
        for at, word, better in refused_in(text):
            if better not in later:
                yield f"{path.relative_to(ROOT)}:{line + text[:at].count(chr(10))}: {word!r}: write {better}"


FILES = sorted(
    [
        *(
            path
            for suffix in (".toml", ".py", ".ipynb")
            for path in (ROOT / "systems").rglob(f"*{suffix}")
        ),
        *PACKAGE.rglob("*.py"),
        *PACKAGE.rglob("*.js"),
        *(PACKAGE / "docs").rglob("*.md"),
        *(path for path in (ROOT / "tests").rglob("*.py") if path != Path(__file__).resolve()),
        ROOT / "README.md",
        ROOT / "pyproject.toml",
    ]
)


def test_words_of_the_field():
    errors = []
    for path in FILES:
        errors += found_in(path, comments=True)
        if path.suffix == ".py" and path.is_relative_to(PACKAGE):
            errors += refused_names(path)
    assert not errors, "\n" + "\n".join(errors)


def test_names_of_tests_have_words_of_the_field():
    errors = []
    for path in (ROOT / "tests").rglob("test_*.py"):
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                words = refused_in(node.name.replace("_", " "))
                errors += [
                    f"{path.name}: {node.name}: {word}: write {better}"
                    for _, word, better in words
                    if better not in NOT_IN_NAMES
                ]
    assert not errors, "\n" + "\n".join(errors)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("As told by the bath", ["told", "bath"]),
        ("A place in the box: see `place`", ["place"]),
        ("Turning on one's own", ["Turning", "one's own"]),
        (
            "is no number, so many, and goes on beside it",
            ["is no number", "so many", "goes on", "beside"],
        ),
        ("With the cut-off of ewald. Of pme: in words", ["cut-off", "Of pme", "in words"]),
        (
            "there are no atoms; sites are no atoms; 4 sites a molecule",
            ["are no atoms", "sites a molecule"],
        ),
        ("This takes place in its own file; there is no such file", []),
        ("Hence it is computed anew and does nothing", ["Hence", "anew", "does nothing"]),
        ("The law of cosines; a plane wave is turned off", []),
        ("[a page](looking.md) of the wave vector `waves`", []),
    ],
)
def test_which_words_are_refused(text, words):
    assert [word for _, word, _ in refused_in(without_code(text))] == words


def test_which_names_are_refused(tmp_path):
    (path := tmp_path / "a.py").write_text(
        "class ToldForce:\n    def leaning(self, room_size, rotation): self.wave = 1\n"
    )
    assert [name for _, name in names_in(path)] == [
        "ToldForce",
        "leaning",
        "self",
        "room_size",
        "rotation",
        "wave",
    ]
    assert [bad for _, bad in refused_names_in(path)] == [["told"], ["leaning"], ["room"], ["wave"]]


def test_where_words_are_sought(tmp_path):
    (page := tmp_path / "a.js").write_text(
        "const a = 'so many of it'; // the own one\nb = 'own';\n"
    )
    assert [list(refused_in(text)) != [] for _, text in texts_of(page)] == [True, True]
    assert ROOT / "pyproject.toml" in FILES
    assert any(path.parent.name == "tests" for path in FILES)


if __name__ == "__main__":
    wanted = [ROOT / name for name in sys.argv[1:]] or [ROOT]
    for path in (path for path in FILES if any(path.is_relative_to(folder) for folder in wanted)):
        print(
            *found_in(path, True), *(refused_names(path) if path.suffix == ".py" else ()), sep="\n"
        )
