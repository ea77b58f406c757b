"""Analyses of runs of molecules, as functions of results: `rigidmd.analysis.rdf(results, "OW", "OW")`.

Each returns an `AnalysisResult`: values with errors, and curves. `start` (ps) is the first time used, by default the
detected end of the equilibration. Other options are described in the module of the analysis. They raise OutputError.
"""

from typing import Any

from rigidmd.analysis import permittivity, rotation, shear_viscosity, structure, translation  # noqa: F401  (register)
from rigidmd.analysis.registry import register, selected
from rigidmd.analysis.result import AnalysisResult
from rigidmd.analysis.source import frames_of_results
from rigidmd.run.results import Results

__all__ = [
    "analyse", "density_profile", "dielectric", "diffusion", "hydrogen_bonds", "msd", "orientation", "rdf", "register",
    "spectrum", "structure_factor", "viscosity",
]  # fmt: skip


def analyse(results: Results, name: str, /, start: float | None = None, **options: Any) -> AnalysisResult:
    """The result of an analysis by its name, built-in or added by `register`."""
    (entry,) = selected([name])
    if start not in results._analysis_frames:
        results._analysis_frames[start] = frames_of_results(results, start)
    return entry.function(results._analysis_frames[start], **options)


def rdf(results: Results, first: str = "", second: str = "", **options: Any) -> AnalysisResult:
    """g(r) of two sites, elements or species; without names, of all pairs of elements or species."""
    return analyse(results, "rdf", first=first, second=second, **options)


def structure_factor(results: Results, name: str = "", **options: Any) -> AnalysisResult:
    """S(k) of sites, elements or species; without a name, of the centres of mass."""
    return analyse(results, "structure_factor", name=name, **options)


def density_profile(results: Results, axis: str = "z", **options: Any) -> AnalysisResult:
    """Mass density (g/cm³) of each species along x, y or z."""
    return analyse(results, "density_profile", axis=axis, **options)


def hydrogen_bonds(results: Results, **options: Any) -> AnalysisResult:
    """Hydrogen bonds per molecule, by distance (Å) and angle (degrees)."""
    return analyse(results, "hydrogen_bonds", **options)


def msd(results: Results, **options: Any) -> AnalysisResult:
    """Mean squared displacement (Å²) of the centres of mass."""
    return analyse(results, "msd", **options)


def diffusion(results: Results, **options: Any) -> AnalysisResult:
    """Diffusion coefficients (1e-9 m²/s); `viscosity_mPa_s` is for the correction of the finite box."""
    return analyse(results, "diffusion", **options)


def orientation(results: Results, **options: Any) -> AnalysisResult:
    """C1 and C2 about each body axis, their times (ps), and rotational diffusion (1/ps)."""
    return analyse(results, "orientation", **options)


def spectrum(results: Results, **options: Any) -> AnalysisResult:
    """Densities of states (cm) of translation and rotation, and correlations of V, omega and L."""
    return analyse(results, "spectrum", **options)


def dielectric(results: Results, **options: Any) -> AnalysisResult:
    """The static dielectric constant, for the boundary condition of the scene."""
    return analyse(results, "dielectric", **options)


def viscosity(results: Results, **options: Any) -> AnalysisResult:
    """Shear viscosity (mPa s) from the pressure tensor (output.pressure_tensor_interval_ps)."""
    return analyse(results, "viscosity", **options)
