"""Means over the production of a run of molecules, for `Results.mean`."""

from math import isnan, nan
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from rigidmd.core.plain_text import did_you_mean_first
from rigidmd.core.quantities import Quantity, current_name
from rigidmd.core.statistics import format_with_error, mean_and_error
from rigidmd.engines.samples import Samples, equilibrated
from rigidmd.errors import OutputError
from rigidmd.features import provider

if TYPE_CHECKING:
    from rigidmd.engines.system import System
    from rigidmd.run.results import Results


#: Why a quantity has none.
NOT_KNOWN = (
    "there is an estimate for what varies, and for pressure, distances and energies of forces with"
    " the column v U'' v of the log. Temperatures follow the thermostat"
)


class Estimate(NamedTuple):
    """A mean with its error.

    Attributes
    ----------
    value : float
        The mean
    error : float
        Standard error. NaN if the run is too short for one
    unit : str
        Unit of both
    """

    value: float
    error: float
    unit: str

    def __str__(self) -> str:
        if isnan(self.error):
            return f"{self.value:.6g} {self.unit} (too short for an error)"
        return f"{format_with_error(self.value, self.error)} {self.unit}"


def mean_of_production(results: "Results", name: str, *, zero_step: bool) -> Estimate:
    """See `Results.mean`."""
    samples, system = results.samples, cast("System", results.system)
    if not isinstance(samples, Samples):
        raise OutputError(
            "mean() is for runs of molecules, and this is one of a single body: results[column] has"
            " all samples"
        )
    known = {alias: row for row in system.quantities.values() for alias in _names(row)}
    name = current_name(name, system.quantities)
    if name not in known:
        raise KeyError(f"no mean of {name!r}{did_you_mean_first(name, known)}")
    quantity = known[name]
    moving = [k for k, stage in enumerate(system.scene.stages) if not stage.is_minimisation]
    k = max(set(samples["stage"].tolist()) & set(moving), default=None)
    if k is None:
        raise OutputError("no stage of motion has samples, and there is nothing to average")
    stage = system.scene.stages[k]
    columns = equilibrated(samples.of_stage(k), stage)
    values = columns[quantity.name]
    value, error = mean_and_error(values[np.isfinite(values)])
    if value is None:
        raise OutputError(f"the last stage of motion has no value of {name}")
    error = nan if error is None else error
    if zero_step:
        feature = provider("step_biases", "mean(zero_step=True)")
        table = {name: columns[name] for name, row in columns.described.items() if row.unit}
        found = feature.step_biases(system, stage, table)
        if isinstance(found, str) or quantity.name not in found:
            reason = found if isinstance(found, str) else NOT_KNOWN
            raise OutputError(f"{name} at a step of zero is not known: {reason}")
        bias, _, error = found[quantity.name]
        value -= bias
    mean = quantity.mean
    divisor = len(system.model.species) if mean and mean.per_molecule else 1
    return Estimate(value / divisor, error / divisor, (mean and mean.unit) or quantity.unit)


def _names(quantity: Quantity) -> list[str]:
    """The names of a mean: of the column, and of its row in the summary."""
    if not quantity.is_averaged:
        return []
    row = quantity.mean.short if quantity.mean else ""
    return [quantity.name, *([row.replace(" ", "_")] if row[:1].strip() else [])]
