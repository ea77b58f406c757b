"""TRR, the format of GROMACS with velocities, in single precision."""

from functools import partial

from rigidmd.io.formats import Encode, Format, System, register
from rigidmd.io.formats.through_mdanalysis import FrameFiles, arrays_of_xdr, step_in_32_bits


def encoder(system: System, interval: float, velocities: bool) -> Encode:
    files = FrameFiles(system, velocities, "TRR")
    return lambda frame, k: files.content(frame._replace(step=step_in_32_bits(frame.step)))


register(Format((".trr",), encoder=encoder, read_arrays=partial(arrays_of_xdr, "TRRFile"), velocities=True))
