"""What Python adds to a scene of molecules, which a file cannot hold: forces and a thermostat, and their names."""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple


class UserCode(NamedTuple):
    """Objects of users; `rigidmd.assemble.user_code` knows what they are."""

    forces: tuple[Any, ...] = ()
    thermostat: Any = None

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all, no two the same."""
        thermostat = () if self.thermostat is None else (f"thermostat {name_of(self.thermostat)}",)
        return (*self.force_names(), *thermostat)

    def force_names(self, taken: Sequence[str] = ()) -> list[str]:
        """A name for each force: its own, with a number if that is taken."""
        found = list(taken)
        for force in self.forces:
            name, k = name_of(force), 1
            while (unique := name if k == 1 else f"{name}_{k}") in found:
                k += 1
            found.append(unique)
        return found[len(taken) :]


def name_of(thing: Any) -> str:
    """The name that an object has, or that of its class as words_with_underscores."""
    named = getattr(thing, "name", None)
    if isinstance(named, str) and named:
        return re.sub(r"\W+", "_", named)
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", type(thing).__qualname__.rpartition(".")[2]).lower().strip("_")


def missing_user_code(wanted: Sequence[str], given: Sequence[str]) -> str:
    """The fault of a scene that lacks what Python added."""
    there = f"; this has {', '.join(given)}" if given else ""
    return (
        f"from_python: this run had {', '.join(wanted)} from Python, which no file holds{there}. Run it from Python "
        "with the same: Simulation(scene, forces=[...], thermostat=...)"
    )
