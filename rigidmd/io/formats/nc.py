"""NetCDF, the format of AMBER."""

from functools import partial

from rigidmd.io.formats import Encode, Format, System, register
from rigidmd.io.formats.through_mdanalysis import FrameFiles, arrays_of_reader


def encoder(system: System, interval: float, velocities: bool) -> Encode:
    files = FrameFiles(system, velocities, "NCDF", {"velocities": velocities})
    size = 4 + 12 * files.sites * (1 + velocities)
    return lambda frame, k: files.content(frame)[0 if k == 0 else -size - 48 * (frame.cell is not None) :]


register(Format(
    (".nc", ".ncdf"), read_arrays=partial(arrays_of_reader, "NCDF"), mdanalysis="NCDF", encoder=encoder,
    counter=(4, ">i"), velocities=True,
))  # fmt: skip
