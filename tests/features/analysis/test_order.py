"""Nematic order of random and tilted axes."""

import numpy as np
import pytest
from support.common import history, system_of

from rigidmd.errors import OutputError
from rigidmd.features.analysis.built_in.order import nematic
from rigidmd.mechanics.rotation import random_rotations


# nematic order
def axes_of(u, generator):
    """Rotations with the first column u (..., 3), and any about it."""
    other = generator.standard_normal(u.shape)
    v = np.cross(u, other)
    v /= np.linalg.norm(v, axis=-1, keepdims=True)
    return np.stack([u, v, np.cross(u, v)], axis=-1)


def test_nematic_order_of_parallel_and_of_random_axes():
    """Random axes have S = 0.803/sqrt(N), the mean of the largest of three eigenvalues."""
    generator, n, f = np.random.default_rng(4), 100, 400
    system = system_of({"nitrogen": n}, 60.0)
    director = np.array([0.48, -0.6, 0.64])
    sign = generator.choice([-1.0, 1.0], (f, n, 1))
    parallel = axes_of(sign * director, generator)
    found = nematic(history(system, np.arange(float(f)), None, np.eye(3) * 60.0, parallel))
    assert found.value("S of nitrogen").value == pytest.approx(1.0, abs=1e-12)
    assert found.value("S of nitrogen about the mean director").value == pytest.approx(1.0)
    shown = np.stack([found[f"n_{name} nitrogen"] for name in "xyz"], axis=1)
    assert np.abs(shown @ director) == pytest.approx(np.ones(f))
    random = random_rotations(generator, f * n).reshape(f, n, 3, 3)
    found = nematic(history(system, np.arange(float(f)), None, np.eye(3) * 60.0, random))
    S = found.value("S of nitrogen")
    expected = mean_of_largest(n)
    assert S.value == pytest.approx(expected, abs=4 * S.error) and S.error < 0.03 * expected
    assert "0.08 without order" in S.note
    middle = found["-2 x middle nitrogen"]
    assert middle.mean() == pytest.approx(0.0, abs=4 * middle.std() / np.sqrt(f))
    whole = found.value("S of nitrogen about the mean director").value
    axes = random[..., 0].reshape(-1, 3)
    tensor = 1.5 * axes.T @ axes / len(axes) - 0.5 * np.eye(3)
    assert whole == pytest.approx(np.linalg.eigvalsh(tensor)[2], rel=1e-9)


def mean_of_largest(n):
    """sqrt(2/3) 27/32 <r> of a length r with five normal components of the variance 0.3/n."""
    mean_chi = np.sqrt(2.0) * 2.0 / (0.75 * np.sqrt(np.pi))
    return np.sqrt(2 / 3) * 27 / 32 * np.sqrt(0.3 / n) * mean_chi


def test_nematic_order_of_tilted_axes_and_of_a_named_axis():
    """Axes on a cone of 30° about z have S = (3 cos² - 1)/2; waters by the axis z of their file."""
    generator, n, f = np.random.default_rng(5), 60, 40
    azimuth = 2 * np.pi * (np.arange(n) / n + generator.random((f, 1)))
    cone = [np.cos(azimuth) / 2, np.sin(azimuth) / 2, np.full_like(azimuth, np.sqrt(0.75))]
    Q = axes_of(np.stack(cone, axis=-1), generator)
    frames = history(system_of({"nitrogen": n}, 40.0), np.arange(float(f)), None, None, Q)
    assert nematic(frames).value().value == pytest.approx((3 * 0.75 - 1) / 2)
    water = system_of({"spce": n}, 40.0)
    along = water.species[0].axes[2]
    aligned = np.stack([along, *np.linalg.svd(along[None])[2][1:]])[[1, 2, 0]]
    aligned *= np.sign(np.linalg.det(aligned))
    frames = history(water, np.arange(float(f)), None, None, np.broadcast_to(aligned, Q.shape))
    assert nematic(frames, axis="z").value().value == pytest.approx(1.0)
    assert "(0.000, 0.000, 1.000)" in nematic(frames, axis="z").notes[0]
    with pytest.raises(OutputError, match="no molecule of this run is linear"):
        nematic(frames)
