"""The free energy along a coupling parameter, by MBAR of pymbar (Shirts & Chodera 2008, J. Chem.
Phys. 129, 124105)."""

import logging
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.core.statistics import inefficiency
from rigidmd.errors import OutputError
from rigidmd.features.analysis.result import AnalysisResult, Curve, Value
from rigidmd.io.write import columns_text

if TYPE_CHECKING:
    from pymbar import MBAR

NAME = "free_energy"
ABOUT, OVER = "free energy of the molecules in [coupling], by MBAR", "coupling.lambda"
LEAST_SAMPLES = 10  # decorrelated ones at a lambda
#: kT. Energies of states that do not occur; exp(-u) is 0.
MOST = 1e5
#: Overlap of neighbours that is enough (Klimovich, Shirts & Mobley 2015, J. Comput.-Aided Mol. Des.
#: 29, 397).
ENOUGH = 0.03
OF_ALL, LEAST_OVERLAP = "free energy of coupling", "least overlap of neighbours"


class SampledLambda(NamedTuple):
    """A run at one lambda."""

    number: int  # of its lambda among all
    changes: np.ndarray  # (n, lambdas) energy at each lambda less the present one, in order, kT

    @property
    def decorrelated(self) -> np.ndarray:
        """Samples at intervals of the statistical inefficiency of the energies at the neighbours
        (m, lambdas)."""
        k = self.number
        last = self.changes.shape[1] - 1
        changes = np.nan_to_num(self.changes, nan=MOST).clip(-MOST, MOST)
        off = changes - changes.mean(axis=0)
        per_independent = [
            inefficiency(off[:, n]) for n in (k - 1, k + 1) if 0 <= n <= last and off[:, n].any()
        ]
        return changes[:: max(1, round(max(per_independent, default=1.0)))]


def free_energy_of(
    lambdas: Sequence[float],
    runs: Sequence[SampledLambda],
    thermal_energy: float,
    parts: Sequence[tuple[str, float, float]] = (),
) -> AnalysisResult:
    """Free energies of all lambdas and their differences.

    lambdas : ascending, each with a run; thermal_energy : kT, kJ/mol
    parts : names of differences with their first and last lambda

    Raises OutputError, also without pymbar.
    """
    samples = [[run.decorrelated for run in runs if run.number == k] for k in range(len(lambdas))]
    counts = np.array([sum(map(len, each)) for each in samples])
    if counts.min() < LEAST_SAMPLES:
        k = int(counts.argmin())
        raise OutputError(
            f"there are {counts[k]} decorrelated samples at lambda = {lambdas[k]:g}, and"
            f" {LEAST_SAMPLES} are needed: run longer"
        )
    mbar = _mbar(np.concatenate([run for each in samples for run in each]).T, counts)
    found = mbar.compute_free_energy_differences()
    overlap = mbar.compute_overlap()["matrix"]
    free, errors = (thermal_energy * found[key] for key in ("Delta_f", "dDelta_f"))

    def difference(name: str, first: float, last: float) -> Value:
        i, j = lambdas.index(first), lambdas.index(last)
        return Value(name, "kJ/mol", float(free[i, j]), float(errors[i, j]))

    values = [difference(*part) for part in parts]
    least = float(np.diag(overlap, 1).min())
    values.append(Value(LEAST_OVERLAP, "1", least, None, None, _matrix(lambdas, overlap)))
    curve = Curve(NAME, ("lambda", np.array(lambdas)), "free energy (kJ/mol)", {})
    curve.add("free energy (kJ/mol)", free[0], errors[0])
    columns = {f"lambda {x:g}": overlap[:, k] for k, x in enumerate(lambdas)}
    matrix = Curve("overlap", ("lambda", np.array(lambdas)), "overlap", columns)
    total = sum(len(run.changes) for run in runs)
    notes = [f"{counts.sum()} decorrelated of {total} samples of {len(runs)} runs"]
    if least < ENOUGH:
        k = int(np.diag(overlap, 1).argmin())
        notes.append(
            f"lambda = {lambdas[k]:g} and {lambdas[k + 1]:g} barely overlap ({least:.2g},"
            f" {ENOUGH:g} is enough): add a point between them"
        )
    return AnalysisResult(NAME, ABOUT, values, [curve, matrix], notes)


def _mbar(energies: np.ndarray, counts: np.ndarray) -> "MBAR":
    """pymbar's solution for energies (lambdas, n) in kT, of counts (lambdas,) samples each."""
    logging.getLogger("pymbar").setLevel(logging.ERROR)  # it warns of accelerators at its import
    try:
        from pymbar import MBAR
    except ImportError:
        raise OutputError(f"{NAME} needs pymbar: pip install pymbar, or '.[free-energy]'") from None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of SciPy, which no longer knows some options of pymbar
        return MBAR(energies, counts)


def _matrix(lambdas: Sequence[float], overlap: np.ndarray) -> str:
    """The overlap matrix as lines of text."""
    rows = [["lambda", *(f"{x:g}" for x in lambdas)]]
    rows += [
        [f"{x:g}", *(f"{y:.3f}" for y in row)] for x, row in zip(lambdas, overlap, strict=True)
    ]
    return "\n    ".join(["the overlap matrix is", *columns_text(rows, left=()).splitlines()])
