"""The keys that features add to scenes: each class is a base class of a table. That of a feature
which is absent has no keys."""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, TypedDict

from rigidmd.scene.added_forces import AddedForces
from rigidmd.scene.validation import Section

if TYPE_CHECKING:
    from rigidmd.features.free_energy.keys import CouplingKeys, CouplingSettings
    from rigidmd.features.potentials.keys import PotentialKeys
else:

    def _keys(feature: str, name: str, base: type) -> type:
        package = f"rigidmd.features.{feature}"
        if find_spec(package) is None:
            return type(name, (base,), {"__module__": __name__})
        return getattr(import_module(f"{package}.keys"), name)

    CouplingKeys = _keys("free_energy", "CouplingKeys", Section)
    CouplingSettings = _keys("free_energy", "CouplingSettings", TypedDict("NoSettings", {}))
    PotentialKeys = _keys("potentials", "PotentialKeys", AddedForces)
