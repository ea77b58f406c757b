"""Samples of a run in columns."""

import tracemalloc

import numpy as np
import pytest

from rigidmd.engines.samples import COLUMNS, Sample, Samples, energy_column


def a_sample(k: int, own: tuple[float, ...] = ()) -> Sample:
    values = {name: k + column / 64 for column, name in enumerate(COLUMNS)}
    return Sample(
        **values | {"step": k, "time": k / 4, "stage": k // 5, "stage_name": "ab"[k // 5]},
        user_energies=own,
    )


def test_samples_give_back_what_was_added():
    samples = Samples(["a", "b"], {name: energy_column(name) for name in ("spring", "field")})
    assert len(samples["time"]) == 0
    added = [a_sample(k, (k / 3, -k)) for k in range(10)]
    for sample in added:
        samples.append(sample)
    assert samples.rows == list(Samples(["a", "b"], samples.more, samples.table())) == added
    assert samples.row(-1) == added[-1]
    for name in COLUMNS:
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
    samples.append(a_sample(9, (0.0, 0.0)))  # columns are copies
    assert len(column) == 10


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda table: table[:, 1:], "shape"),
        (lambda table: table.ravel(), "shape"),
        (lambda table: np.where(table == 1.0, 7.0, table), "have stages that are not in the scene"),
        (
            lambda table: np.where(table == 1.0, np.nan, table),
            "have stages that are not in the scene",
        ),
        (lambda table: np.where(table == 6.0, 6.5, table), "steps that are not whole numbers"),
        (lambda table: np.where(table == 6.0, 1e300, table), "steps that are not whole numbers"),
        (lambda table: np.where(table == 6.0, np.inf, table), "steps that are not whole numbers"),
    ],
)
def test_rows_that_are_not_samples_are_refused(change, expected):
    samples = Samples(["a", "b"])
    samples.append(a_sample(6))
    with pytest.raises(ValueError, match=expected):
        Samples(["a", "b"], {}, change(samples.table()))


def test_a_sample_takes_no_more_than_its_numbers():
    samples = Samples(["a", "b"], {"spring": energy_column("spring")})
    tracemalloc.start()
    for k in range(5000):
        samples.append(a_sample(k % 10, (0.0,)))
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert size < 5000 * 1.2 * 8 * len(COLUMNS)
