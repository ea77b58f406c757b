"""The memory of a run is compared with the machine before it is used."""

import subprocess
import sys

import numpy as np
import pytest
from support.common import refusal
from support.scenes import GOOD, SATELLITE

from rigidmd.assemble import memory_check as room
from rigidmd.assemble.build import build
from rigidmd.core import process
from rigidmd.errors import SceneError
from rigidmd.forces.ewald import direct_sum as vectors
from rigidmd.scene import MolecularScene, Scene


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            GOOD.replace("count = 20", f"count = {10**12}"),
            "not enough memory: a system of 1000000000000 molecules with",
        ),
        (
            GOOD.replace("count = 20", f"count = {2**63 - 1}"),
            "not enough memory: a system of 9223372036854775807",
        ),
        (
            GOOD + '[forces]\nelectrostatics = "pme"\npme_grid = [4096, 4096, 4096]\n',
            "a single array of it needs 275 GB",
        ),
    ],
)
def test_a_scene_beyond_the_machine_is_refused_with_numbers(
    text, expected, capsys, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    for free in (process, room):
        monkeypatch.setattr(
            free, "free_memory", lambda: 8e9
        )  # between commands what is free changes
    message = refusal(capsys, tmp_path, text, commands=("check", "energy", "run"))
    assert expected in message
    assert "and this machine has 8 GB free" in message
    assert not (tmp_path / "runs").exists()


def test_the_memory_of_a_run_is_compared_before_it_is_used(monkeypatch, tmp_path):
    scene = Scene.from_dict(
        {
            "box": {"lengths_A": 60.0, "periodic": False},
            "molecules": [{"model": "spce", "count": 2000}],
            "start": {"temperature_K": 300.0},
            "stages": [{"duration_ps": 0.01}],
        }
    )
    assert isinstance(scene, MolecularScene)
    needed = room.bytes_of(build(scene))
    assert needed > 5e6
    monkeypatch.setattr(process, "free_memory", lambda: needed / 0.94)
    build(scene)
    monkeypatch.setattr(process, "free_memory", lambda: needed / 0.96)
    with pytest.raises(
        SceneError, match=r"not enough memory: the run needs .* and this machine has .* GB free"
    ):
        build(scene)


def test_a_body_with_more_samples_than_there_is_memory_for(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(process, "free_memory", lambda: 8e9)
    text = SATELLITE.replace("timestep_s = 0.01", "timestep_s = 1e-8").replace(
        "interval_s = 0.1", "interval_s = 1e-8"
    )
    message = refusal(capsys, tmp_path, text)
    assert (
        "not enough memory: a run with 1e+08 samples needs 270 GB of memory, and this machine has 8 GB"
        in message
    )


@pytest.mark.parametrize(
    ("changes", "lines", "gigabytes"),
    [
        ({"stages.0.duration_ps": 2e5, "output.log_interval_ps": 0.002}, "1e+08", "87.1 GB"),
        (
            {"stages.0.duration_ps": 2e5, "output.log_interval_ps": 1e-6},
            "2e+08",
            "174 GB",
        ),  # a line each step
        ({"stages.0.duration_ps": 2e6, "output.trajectory_interval_ps": 0.002}, "2e+07", "167 GB"),
        (
            {
                "stages.0.duration_ps": 2e7,
                "stages.0.timestep_fs": "",
                "stages.0.integrator": "auto",
                "stages.0.energy_error_kT": 1e-3,
            },
            "2e+08",
            "180 GB",
        ),
    ],
)
def test_molecules_with_more_samples_than_there_is_memory_for(
    changes, lines, gigabytes, capsys, monkeypatch, tmp_path
):
    monkeypatch.setattr(process, "free_memory", lambda: 8e9)
    options = [part for key, value in changes.items() for part in ("--set", f"{key}={value}")]
    message = refusal(capsys, tmp_path, GOOD, *options)
    assert (
        f"a run with {lines} lines in its log needs {gigabytes} of memory, and this machine has 8 GB"
        in message
    )
    assert "lengthen output.log_interval_ps" in message


def test_what_is_free_is_at_most_the_limits():
    assert 1e8 < process.free_memory() < 1e14
    code = (
        "import resource; resource.setrlimit(resource.RLIMIT_AS, (3 * 10**9, 3 * 10**9))\n"
        "from rigidmd.core.process import free_memory; print(free_memory())"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert 1e9 < float(found.stdout) < 3e9


@pytest.mark.parametrize(
    ("most", "square"), [((5, 6, 7), None), ((3, 0, 4), 20), ((0, 0, 3), None), ((0, 0, 0), None)]
)
def test_k_vectors_in_columns_are_all_k_vectors(most, square):
    found = vectors.k_vectors_up_to(most, square)
    axes = [np.arange(-m, m + 1) for m in most]
    n = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    n = n[(n**2).sum(axis=1) <= (np.inf if square is None else square)]
    half = {tuple(v) for v in n.tolist() if tuple(v) > (0, 0, 0)}
    listed = [
        (int(x), int(y), int(first) + k)
        for (x, y, first, _), count in zip(found.column, found.count, strict=True)
        for k in range(count)
    ]
    assert (set(listed), len(listed), found.total) == (half, len(half), 2 * len(half))
    assert np.array_equal(found.column[:, 3], np.cumsum(found.count) - found.count)
