"""What [[forces.custom]], [[forces.bodies]] and code of users add to a system. Their modules are
loaded where they are needed: a stored run needs few of them."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from rigidmd.core.state import State
from rigidmd.engines.system import System
from rigidmd.feature import Feature
from rigidmd.features.potentials.extra import UserExtra, body_pairs_of, with_extra
from rigidmd.features.potentials.user_code import trust
from rigidmd.forces.parts import SystemParts
from rigidmd.scene import Scene


class Potentials(Feature):
    def extend(self, system: System, parts: SystemParts, *, user_code: bool) -> System:
        scene = system.scene
        if not user_code:
            from rigidmd.features.potentials.user_code.body_pairs import potentials_of_stored_run

            return with_extra(system, UserExtra(body_pairs=potentials_of_stored_run(scene)))
        from rigidmd.features.potentials.user_code.binding import with_user_code

        return with_user_code(system)

    def explained(self, system: System) -> AbstractContextManager[None]:
        from rigidmd.features.potentials.user_code.binding import user_errors_explained

        return user_errors_explained(system)

    def trust(self, path: str | Path) -> None:
        trust.trust_file(path)

    def unused_files(self, scene: Scene, paths: Sequence[str]) -> list[str]:
        return trust.unused_files(scene, paths)

    def check_trusted(self, scene: Scene, paths: Sequence[str]) -> None:
        trust.check_trusted(scene, paths)

    def check_start(self, system: System, state: State) -> list[str]:
        from rigidmd.features.potentials.user_code.compiled import check_compiled_code

        return check_compiled_code(system, state)

    def check_forces(self, system: System, state: State) -> None:
        from rigidmd.features.potentials.user_code.force_checks import check_forces

        check_forces(system, state)

    def notes_on_start(self, system: System, state: State) -> list[str]:
        from rigidmd.features.potentials.user_code.force_checks import velocity_notes

        return velocity_notes(system, state)

    def warning_at(self, system: System, state: State) -> str:
        if not body_pairs_of(system):
            return ""
        from rigidmd.features.potentials.user_code.pose_checks import within_table

        return within_table(system, state)

    def axes(self, system: System) -> Iterator[tuple[str, str]]:
        from rigidmd.features.potentials.poses.bodies import bodies_of_potentials

        for bodies in bodies_of_potentials(system):
            if axis := bodies.potential.axis:
                yield bodies.species.name, axis

    def shapes(self, system: System) -> Iterator[tuple[str, list[tuple]]]:
        from rigidmd.features.potentials.poses.shapes import shapes_of

        return shapes_of(system)


FEATURE = Potentials()
