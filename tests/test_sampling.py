"""Subsampling against brute force on small data."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from dfsm.errors import DfsmError
from dfsm.numerics.sampling import subsample

METHODS = ("kmeans", "maxmin", "random")


def cloud(seed: int, samples: int = 120, inputs: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(samples, inputs))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_means_are_those_of_each_points_samples(method, seed):
    z, values = cloud(seed), np.random.default_rng(seed + 50).normal(3, 1, (120, 2))
    points = subsample(z, 9, method, seed)
    means = points.means(values)
    assert means.shape == (9, 2)
    for i in range(9):
        np.testing.assert_allclose(means[i], values[points.labels == i].mean(0), rtol=1e-12)


@pytest.mark.parametrize("method", ["maxmin", "random"])
def test_labels_name_the_nearest_point(method):
    z = cloud(3)
    points = subsample(z, 11, method, 4)
    np.testing.assert_array_equal(points.labels, cdist(z, points.points).argmin(axis=1))


def test_kmeans_points_are_cluster_means_and_labels_their_nearest():
    centres = np.array([[0, 0], [10, 0], [0, 10], [10, 10], [20, 5]])
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 5, 400)
    z = centres[truth] + rng.normal(0, 0.3, (400, 2))
    points = subsample(z, 5, "kmeans", 1)
    np.testing.assert_array_equal(points.labels, cdist(z, points.points).argmin(axis=1))
    found = points.points[cdist(centres, points.points).argmin(axis=1)]
    np.testing.assert_allclose(found, [z[truth == k].mean(0) for k in range(5)], rtol=0, atol=1e-12)


def test_kmeans_on_more_samples_than_it_searches_still_means_all_of_them():
    # 4 centres search at most 200 samples; the means must nevertheless be over all 5000.
    z = cloud(8, 5000, 2)
    points = subsample(z, 4, "kmeans", 0)
    assert len(points.labels) == 5000
    for i in range(4):
        np.testing.assert_allclose(points.points[i], z[points.labels == i].mean(0), atol=1e-12)
    spread = np.mean((z - points.points[points.labels]) ** 2)
    at_random = z[np.random.default_rng(0).choice(5000, 4, replace=False)]
    assert spread < np.mean(cdist(z, at_random).min(axis=1) ** 2) / 2


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10_000), size=st.integers(2, 12))
def test_maxmin_adds_the_sample_farthest_from_those_chosen(seed, size):
    z = cloud(seed, 25, 2)
    points = subsample(z, size, "maxmin", seed).points
    distances = cdist(z, z)
    rows = [int(np.flatnonzero((z == p).all(axis=1))[0]) for p in points]
    # The result is a set; rebuild the greedy sequence from each possible first sample.
    sequences = []
    for first in rows:
        chosen = [first]
        while len(chosen) < size:
            chosen.append(int(np.argmax(distances[:, chosen].min(axis=1))))
        sequences.append(set(chosen))
    assert set(rows) in sequences


def test_random_points_are_distinct_samples():
    z = np.arange(60.0)[:, None]
    points = subsample(z, 40, "random", 3).points[:, 0]
    assert len(points) == 40
    assert len(set(points)) == 40
    assert set(points) <= set(z[:, 0])


@pytest.mark.parametrize("method", METHODS)
def test_the_seed_decides(method):
    z = cloud(1)
    first, again = subsample(z, 8, method, 5), subsample(z, 8, method, 5)
    np.testing.assert_array_equal(first.points, again.points)
    np.testing.assert_array_equal(first.labels, again.labels)
    others = [subsample(z, 8, method, s).points for s in (6, 7, 8)]
    assert any(o.shape != first.points.shape or (o != first.points).any() for o in others)


@pytest.mark.parametrize("method", METHODS)
def test_more_points_than_samples_is_refused(method):
    with pytest.raises(DfsmError, match="21 points were asked for but there are only 20 samples"):
        subsample(cloud(0, 20), 21, method)
    assert len(subsample(cloud(0, 20), 20, method).points) == 20


@pytest.mark.parametrize("method", METHODS)
def test_repeated_samples_leave_no_point_without_samples(method):
    z = np.repeat(cloud(2, 6), 10, axis=0)
    points = subsample(z, 12, method, 0)
    assert len(points.points) <= 6
    assert set(points.labels) == set(range(len(points.points)))
    assert np.isfinite(points.means(z)).all()
