"""Forces and a thermostat that Python adds to a scene of molecules and that a scene file cannot hold."""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple


class UserCode(NamedTuple):
    """Forces and a thermostat, from which `rigidmd.assemble.user_code` makes terms."""

    forces: tuple[Any, ...] = ()
    thermostat: Any = None

    @property
    def names(self) -> tuple[str, ...]:
        """Unique names of all objects."""
        thermostat = () if self.thermostat is None else (f"thermostat {name_of(self.thermostat)}",)
        return (*self.force_names(), *thermostat)

    def force_names(self, taken: Sequence[str] = ()) -> list[str]:
        """A name for each force, with a number where it would not be unique."""
        found = list(taken)
        for force in self.forces:
            name, k = name_of(force), 1
            while (unique := name if k == 1 else f"{name}_{k}") in found:
                k += 1
            found.append(unique)
        return found[len(taken) :]


def name_of(thing: Any) -> str:
    """The attribute `name` of an object, else the name of its class in snake_case."""
    named = getattr(thing, "name", None)
    if isinstance(named, str) and named:
        return re.sub(r"\W+", "_", named)
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", type(thing).__qualname__.rpartition(".")[2]).lower().strip("_")


def missing_user_code(wanted: Sequence[str], given: Sequence[str]) -> str:
    """The error message of a scene without the user code that its `from_python` lists."""
    there = f"; this has {', '.join(given)}" if given else ""
    return (
        f"from_python: this run had {', '.join(wanted)} from Python, which no file holds{there}. Run it from Python "
        "with the same: Simulation(scene, forces=[...], thermostat=...)"
    )
