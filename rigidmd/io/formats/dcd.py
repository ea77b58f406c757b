"""DCD, the format of CHARMM and NAMD. It stores one time between all frames."""

from functools import partial

from rigidmd.io.formats import Encode, Format, System, register
from rigidmd.io.formats.through_mdanalysis import FrameFiles, arrays_of_reader


def encoder(system: System, interval: float, velocities: bool) -> Encode:
    files = FrameFiles(system, velocities, "DCD", {"dt": interval})
    size = 80 + 12 * files.sites
    return lambda frame, k: files.content(frame)[0 if k == 0 else -size :]


register(Format(
    (".dcd",), read_arrays=partial(arrays_of_reader, "DCD"), encoder=encoder, counter=(8, "<i"), even=True,
))  # fmt: skip
