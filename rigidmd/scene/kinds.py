"""The kinds of scenes, molecules and those that features add, by the table that only they have."""

from collections.abc import Mapping

from rigidmd.features import FEATURES
from rigidmd.scene.base import Scene
from rigidmd.scene.hints import KINDS

MOLECULES = "molecules"
#: Kind of scene -> the feature that adds it.
ADDED = {row.kind: row for row in FEATURES if row.kind}


def scene_class(kind: str) -> type[Scene]:
    """The class of scenes of a kind. Raises MissingFeatureError."""
    if kind != MOLECULES:
        return ADDED[kind].module(f"keys.{kind}", f"a scene with [{kind}]").SCENE
    from rigidmd.scene.molecules import MolecularScene  # not for other kinds

    return MolecularScene


def scene_classes() -> list[type[Scene]]:
    """The classes of scenes of all installed kinds."""
    return [
        *(scene_class(kind) for kind, row in ADDED.items() if row.is_installed),
        scene_class(MOLECULES),
    ]


KINDS.append(scene_classes)


def class_for(data: Mapping[str, object]) -> type[Scene] | None:
    """The class of scenes with these tables. None if no table belongs to any kind. Raises
    MissingFeatureError."""
    for kind in (*ADDED, MOLECULES):
        if kind in data:
            return scene_class(kind)
    count = {
        scene: len(set(data) & set(scene.model_fields) - set(Scene.model_fields))
        for scene in scene_classes()
    }
    best = max(count, key=lambda scene: count[scene])
    return best if count[best] > 0 else None


def without_kind() -> str:
    """The message on tables that belong to no kind."""
    *others, _ = scene_classes()
    first = "".join(f"[{scene.kind}], for {scene.subject}, nor " for scene in others)
    return f"has {'neither ' if first else 'no '}{first}[[{MOLECULES}]]"
