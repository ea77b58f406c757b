"""The table [engine] of a scene: rigidmd itself or an external engine, with its options."""

from typing import TYPE_CHECKING, Literal

from pydantic import Field, create_model

from rigidmd.core.programs import Program, engine_options, runnable
from rigidmd.core.toml import Json
from rigidmd.scene.validation import Count, Section

RIGIDMD = "rigidmd"
_PROGRAMS = runnable()
_TITLES = " or ".join(program.title for program in _PROGRAMS.values())


class _Engine(Section):
    """The engine that moves the molecules. Start, log, trajectory and analysis are the same for all
    engines."""

    name: Literal[(RIGIDMD, *_PROGRAMS)] = Field(  # type: ignore[valid-type]
        default=RIGIDMD,
        description=(
            f"rigidmd itself, or {_TITLES} if installed (pip install {' or '.join(_PROGRAMS)})"
        ),
    )

    def _errors(self):
        for name, program in _PROGRAMS.items():
            for key in program.options.keys() - self.options.keys():
                if getattr(self, key) is not None:
                    yield (
                        f"{key} would have no effect with engine.name = {self.name!r}. It is for"
                        f" {name}"
                    )
        if self.program and (error := self.program.option_errors(**self.options)):
            yield error

    @property
    def program(self) -> Program | None:
        """The program that computes the run. None for rigidmd itself."""
        return _PROGRAMS.get(self.name)

    @property
    def is_external(self) -> bool:
        """Whether another program computes the run."""
        return self.program is not None

    @property
    def options(self) -> Json:
        """The options of this engine, with defaults."""
        options = self.program.options if self.program else {}
        values = {key: getattr(self, key) for key in options}
        return {
            key: options[key].default if value is None else value for key, value in values.items()
        }

    @property
    def title(self) -> str:
        """The name of the engine with its options."""
        return self.program.describe(**self.options) if self.program else self.name


if TYPE_CHECKING:
    EngineChoice = _Engine
else:
    _FIELDS = {
        key: (
            (Count if option.values is int else Literal[option.values]) | None,
            Field(None, description=option.description),
        )
        for key, option in engine_options().items()
    }
    EngineChoice = create_model(
        "EngineChoice", __base__=_Engine, __module__=__name__, __doc__=_Engine.__doc__, **_FIELDS
    )
