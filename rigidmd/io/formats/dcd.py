"""DCD, the format of CHARMM and NAMD. It stores one time between all frames."""

from collections.abc import Callable
from functools import partial

from rigidmd.io.formats import Format, System
from rigidmd.io.formats.atoms import Frame
from rigidmd.io.formats.through_mdanalysis import FrameFiles, arrays_of_reader


def encoder(system: System, interval: float, velocities: bool) -> Callable[[Frame, int], bytes]:
    files = FrameFiles(system, velocities, "DCD", {"dt": interval})
    size = 80 + 12 * files.sites
    return lambda frame, k: files.content(frame)[0 if k == 0 else -size :]


FORMATS = [
    Format(
        (".dcd",), read_arrays=partial(arrays_of_reader, "DCD"), encoder=encoder, counter=(8, "<i"), even=True,
    ),
]  # fmt: skip
