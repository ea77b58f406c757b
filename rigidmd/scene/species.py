"""The tables [[molecules]] of a scene: species and their numbers of molecules."""

import re
from pathlib import Path
from typing import Annotated

from pydantic import Field, Strict, field_validator, model_validator

from rigidmd.scene.models import Site, SiteName, model_error
from rigidmd.scene.validation import Count, Flag, Line, Positive, Section

#: Keys of [[molecules]] that name a file.
SPECIES_FILES = ("file", "parameters")

ResidueNumber = Annotated[int, Strict(), Field(ge=0)]


class Molecules(Section):
    """A species and its number of molecules."""

    model: str | None = None
    """A shipped model; `rigidmd models` lists them"""
    file: Line | None = None
    """A .toml file with a molecule, like those models, or a geometry in a format of ASE, with `sites` for its atoms"""
    name: Line | None = None
    """Name of the species; default: the name of the model or file"""
    sites: tuple[Site, ...] | None = Field(default=None, min_length=1)
    """Sites of a custom molecule; with a geometry `file`, their parameters by atom name or element"""
    parameters: Line | None = None
    """A .toml file with entries like `sites` that several molecules may use. It supplies missing keys by atom name or
    element"""
    masses_u: dict[str, Positive] | None = Field(default=None, min_length=1)
    """Masses of sites by name or element, for other isotopes: { H = 2.014 } for heavy water"""
    residue_names: tuple[SiteName, ...] | None = None
    """Residue names of this species in structure files"""
    count: Count | None = None
    """Number of molecules; required without a structure file"""
    frozen: Flag | tuple[ResidueNumber, ...] | str = False
    """Molecules that do not move. They act on all others but not on each other. True for all, or numbers of some,
    [1, 2, 5] or "1-10, 15": residue numbers of the structure file; or, without a file or if its residues are not the
    molecules, 1, 2, ... within this species"""

    @field_validator("frozen")
    @classmethod
    def _are_numbers(cls, frozen: bool | tuple[int, ...] | str):
        return frozen if isinstance(frozen, bool) else checked_numbers(frozen)

    @property
    def frozen_spans(self) -> list[tuple[int, int]]:
        """Ranges (first, last) of the numbers of frozen molecules; empty if all or none are frozen."""
        return [] if isinstance(self.frozen, bool) else spans(self.frozen)

    @field_validator("model")
    @classmethod
    def _is_known(cls, model: str | None):
        if model is not None and (fault := model_error(model)):
            raise ValueError(fault)
        return model

    @model_validator(mode="after")
    def _one_source(self):
        if self.model is not None and (self.file is not None or self.sites is not None):
            raise ValueError("give a model, or a custom file and sites, not both")
        whole = self.model is not None or (self.file is not None and self.file.endswith(".toml"))
        if self.parameters is not None and whole:
            raise ValueError("parameters would do nothing: a model or a .toml file contains parameters")
        if self.parameters is not None and not self.parameters.endswith(".toml"):
            raise ValueError(f"parameters = {self.parameters!r} must be a .toml file with [[sites]]")
        if self.model is None and self.file is None and self.sites is None:
            raise ValueError("needs one of model, file, sites")
        if self.file is not None and self.file.endswith(".toml") and self.sites is not None:
            raise ValueError("a .toml file has its own sites: leave out one of them")
        if self.file is not None and not whole and self.sites is None and self.parameters is None:
            raise ValueError("a geometry file needs sites, or a file of parameters, for its atoms")
        if self.sites is not None and self.file is None and self.name is None:
            raise ValueError("a custom molecule needs a name")
        return self

    @property
    def label(self) -> str:
        """The name, else the name of the model or file."""
        return self.name or self.model or Path(self.file or "").stem


def checked_numbers(numbers: tuple[int, ...] | str) -> tuple[int, ...] | str:
    """Numbers of molecules, [1, 2, 5] or "1-10, 15", unchanged. Raises ValueError."""
    if numbers == ():
        raise ValueError("is empty: list the numbers of molecules, or omit it")
    if isinstance(numbers, str):
        if not re.fullmatch(r"\s*\d+\s*(-\s*\d+\s*)?(,\s*\d+\s*(-\s*\d+\s*)?)*", numbers):
            raise ValueError(f"is {numbers!r}, must be numbers of molecules such as '1-10' or '1-10, 15'")
        if reversed_ := [f"{first}-{last}" for first, last in spans(numbers) if first > last]:
            raise ValueError(f"is {numbers!r}: {', '.join(reversed_)} ends before it begins")
    return numbers


def spans(numbers: tuple[int, ...] | str) -> list[tuple[int, int]]:
    """Ranges (first, last) of "1-10, 15", or of the single numbers of a list."""
    if not isinstance(numbers, str):
        return [(number, number) for number in numbers]
    ends = [[int(number) for number in part.split("-")] for part in numbers.split(",")]
    return [(of_part[0], of_part[-1]) for of_part in ends]
