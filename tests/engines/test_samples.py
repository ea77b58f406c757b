"""Samples of a run in columns."""

import tracemalloc

import numpy as np

from rigidmd.core.quantities import QUANTITIES, energy_of_force
from rigidmd.engines.samples import Sample, Samples


def a_sample(k: int, **energies: float) -> Sample:
    values = {name: k + column / 64 for column, name in enumerate(QUANTITIES)}
    values |= {"step": k, "time": k / 4, "stage": k // 5, "stage_name": "ab"[k // 5]}
    return Sample(**values, **energies)


def with_forces(*names: str) -> dict:
    return QUANTITIES | {name: energy_of_force(name) for name in names}


def test_samples_give_back_what_was_added():
    samples = Samples(["a", "b"], with_forces("spring", "field"))
    assert len(samples["time"]) == 0
    added = [a_sample(k, spring=k / 3, field=-k) for k in range(10)]
    for sample in added:
        samples.append(sample)
    assert samples.rows == list(Samples(["a", "b"], samples.described, samples.table())) == added
    assert samples.row(-1) == added[-1]
    for name in QUANTITIES:
        assert samples[name].tolist() == [getattr(sample, name) for sample in added]
    assert samples["field"].tolist() == [0, -1, -2, -3, -4, -5, -6, -7, -8, -9]
    assert samples.of_stage(1).rows == added[5:]
    assert len(samples.of_stage(2)) == 0
    for since in range(10):
        for moment in np.arange(-0.1, 2.6, 0.05):
            assert samples.latest(moment, since) == max(
                [k for k in range(since, 10) if k / 4 <= moment], default=since
            )
    column = samples["time"]
    samples.append(a_sample(9, spring=0.0, field=0.0))  # columns are copies
    assert len(column) == 10


def test_a_sample_takes_no_more_than_its_numbers():
    samples = Samples(["a", "b"], with_forces("spring"))
    tracemalloc.start()
    for k in range(5000):
        samples.append(a_sample(k % 10, spring=0.0))
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size < 5000 * 1.2 * 8 * len(QUANTITIES)
