"""The table of stability cases, cases.toml, as trials: settings, scenes, expected outcomes."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import nan
from pathlib import Path
from typing import NamedTuple, overload

from rigidmd.core.state import State
from rigidmd.core.toml import Json, parse_toml
from rigidmd.run.results import Results

RIGHT = "right"
REFUSED = "refused"
REPORTED = "reported"
UNDETECTED = "undetected"
CRASH = "crash"
#: A run is bounded while the errors of conserved quantities stay below this fraction of the kinetic
#: energy.
BOUND = 0.1
LINEAR = re.compile(r"(?:(\S+) \+ )?(?:(\S+) )?x")

TABLES = parse_toml(Path(__file__).with_name("cases.toml").read_text(encoding="utf-8"))
#: Makes the trials of a value of a row from the one that the table describes. Rows whose values
#: are texts have the builder `run`.
Builder = Callable[["Trial", float], Iterator["Trial"]]
BUILDERS: dict[str, Builder] = {}


def builder(build: Builder) -> Builder:
    """Register a function under its name, for the key `build` of rows."""
    BUILDERS[build.__name__] = build
    return build


class Outcome(NamedTuple):
    error: float = nan  # with respect to the known answer, in the unit of the case
    reported_error: float = nan  # largest error of conserved quantities in the results, relative
    message: str = ""  # of the rigidmd error that refused or stopped it
    crash: str = ""  # any other exception
    remark: str = ""  # what else the results show


class Trial(NamedTuple):
    """A setting of a case and its expected outcome. It runs with several integrators.

    It lasts for its duration or number of steps, whichever is longer. Times are in fs, for other
    kinds of scenes than molecules in s.
    """

    setting: str = ""
    scene: Json = {}  # noqa: RUF012
    build: str = "run"
    stage: Json = {}  # keys of a thermostat  # noqa: RUF012
    integrators: Sequence[str] = ()
    step: float = nan
    steps: int = 1
    duration: float = 0.0
    samples: int = 50
    allowed: float = 0.0  # largest error
    allowed_of: Mapping[str, float] = {}  # the same for some integrators
    rounding: float = 0.0  # error that is allowed in addition
    expected: Sequence[str] = (RIGHT,)
    is_bisected: bool = False  # the longest bounded step is wanted
    bound: float = BOUND
    scale: float = 0.0  # of the energy error, kJ/mol; default: start of the column
    scale_column: str = "kinetic"
    state: State | None = None  # to start from, by a file if the scene has a structure
    error: Callable[[Results], float] | None = None  # default: that of conserved quantities
    remark: Callable[[Results], str] | None = None
    run: Callable[..., Outcome] | None = None  # default: the scene is run

    @property
    def span(self) -> float:
        return max(self.duration, self.steps * self.step)


class Case(NamedTuple):
    """A stress test of the engine."""

    name: str
    group: int  # number of its kind of difficulty, from 1 to 14
    sentence: str
    rows: list[Json]
    common: Json = {}  # keys of all rows  # noqa: RUF012
    error_title: str = ""  # what its error is
    step_unit: str = "s"

    def trials(self, quick: bool) -> Iterator[Trial]:
        for row in self.rows:
            keys = _layered(self.common, row, quick=quick)
            setting = keys.pop("setting", "")
            values = keys.pop("values", [nan])
            bisect = keys.pop("bisect", [False])
            for x in values:
                trial = Trial(setting.format(x), **insert(keys, x))
                for built in BUILDERS[trial.build](trial, x):
                    for is_bisected in bisect:
                        yield built._replace(is_bisected=is_bisected)


def _layered(common: Json, row: Json, *, quick: bool) -> Json:
    """The keys of a row, after the keys of the layers above it."""
    like = (common | row).get("like")
    keys: Json = {"scene": {}}
    for layer in (TABLES["defaults"], TABLES["shared"].get(like, {}), common, row):
        changes = layer | (layer.get("quick", {}) if quick else {})
        keys |= changes | {"scene": keys["scene"] | changes.get("scene", {})}
    return {name: value for name, value in keys.items() if name not in ("quick", "like")}


@overload
def insert(data: Json, x: float | str) -> Json: ...
@overload
def insert(data: object, x: float | str) -> object: ...
def insert(data: object, x: float | str) -> object:
    """Data of the table with a value of x in linear functions such as "1 + 0.3 x", and with the
    sites of molecules."""
    if isinstance(data, list):
        return [insert(part, x) for part in data]
    if isinstance(data, dict):
        inserted = {key: insert(part, x) for key, part in data.items()}
        molecule = inserted.pop("molecule", None)
        return insert(_sites(molecule), x) | inserted if isinstance(molecule, str) else inserted
    if data == "x":
        return x
    if isinstance(data, str) and not isinstance(x, str) and (match := LINEAR.fullmatch(data)):
        return float(match[1] or 0) + float(match[2] or 1) * x
    return data


def _sites(molecule: str) -> Json:
    columns = TABLES["site"] | TABLES["molecules"][molecule]
    count = len(columns["position_A"])
    lists = [value if isinstance(value, list) else [value] * count for value in columns.values()]
    sites = [dict(zip(columns, values, strict=True)) for values in zip(*lists, strict=True)]
    return {
        "name": "bent",
        "sites": [{key: value for key, value in site.items() if value != ""} for site in sites],
    }


CASES = {name: Case(name, **table) for name, table in TABLES["cases"].items()}


def add_cases(path: Path) -> None:
    """Add the cases of a feature, with its [methods] and [shared]. Cases stay in the order of their
    groups."""
    tables = parse_toml(path.read_text(encoding="utf-8"))
    for key in ("methods", "shared"):
        TABLES[key] |= tables[key]
    added = {name: Case(name, **table) for name, table in tables["cases"].items()}
    in_order = sorted((added | CASES).values(), key=lambda case: case.group)
    CASES.clear()
    CASES.update({case.name: case for case in in_order})
