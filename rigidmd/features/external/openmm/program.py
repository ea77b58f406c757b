"""OpenMM for scenes and commands, which do not load it."""

from rigidmd.core.programs import Option, Program

#: Platforms with a precision of their own, and that precision. CPU computes forces in single
#: precision, and moves in double. All others are GPUs, which have the property Precision.
FIXED_PRECISIONS = {"CPU": "mixed", "Reference": "double"}
PLATFORMS = (*FIXED_PRECISIONS, "CUDA", "OpenCL", "HIP")
#: Default on a GPU: double precision is 32 to 64 times slower on most of them.
GPU_PRECISION = "mixed"


def precision_of(platform: str, precision: str | None) -> str:
    return precision or FIXED_PRECISIONS.get(platform, GPU_PRECISION)


def _errors(platform: str, precision: str | None) -> str:
    fixed = FIXED_PRECISIONS.get(platform)
    if fixed is None or precision in (None, fixed):
        return ""
    return (
        f"precision = {precision!r} is for GPUs: the platform {platform} has {fixed} precision."
        " Leave it out"
    )


def _describe(platform: str, precision: str | None) -> str:
    fixed = platform in FIXED_PRECISIONS
    return (
        "OpenMM on its platform"
        f" {platform}{'' if fixed else f' in {precision_of(platform, precision)} precision'}"
    )


PROGRAM = Program(
    "OpenMM",
    "pip install openmm installs it, and 'openmm[cuda12]' its platform CUDA too",
    "system:TRANSLATIONS",
    engine="engine:OpenmmEngine",
    installed="engine:installed",
    options={
        "platform": Option(PLATFORMS, "CPU", "Platform of openmm. Default: CPU"),
        "precision": Option(
            ("double", "mixed", "single"),
            None,
            "Arithmetic of openmm on a GPU. Default: mixed, with forces in single "
            "precision and motion in double. CPU has mixed, Reference has double precision",
        ),
    },
    describe=_describe,
    option_errors=_errors,
    precise={"platform": "Reference"},
    thermostat="nose_hoover",
    barostat="monte_carlo",
    writer="files:write_openmm",
    command="python run.py",
)
