"""What this feature does for scenes that name another program as their engine."""

from rigidmd.core.state import State
from rigidmd.engines.protocol import Engine
from rigidmd.engines.system import System
from rigidmd.errors import EngineError
from rigidmd.feature import Feature
from rigidmd.features.external.engines import (
    compare_at,
    describe_comparison,
    external_engine,
    supporting_program,
)


class External(Feature):
    def engine(self, system: System, stage: int) -> Engine:
        return external_engine(system, stage)

    def describe_engine(self, system: System) -> str:
        program = supporting_program(system)
        try:
            return program.load(program.installed)() if program.installed else ""
        except EngineError as error:
            return str(error)

    def compare_start(self, system: System, state: State, other: Engine) -> None:
        engine = system.engine_of(system.terms, "double")
        lines = compare_at(system, state, engine, other)
        if not all(line.agrees for line in lines):
            title = system.scene.engine.name
            table = describe_comparison(lines, title)
            raise EngineError(
                f"{system.scene.source}: {title} and rigidmd do not agree at the start\n{table}"
            )


FEATURE = External()
