"""The largest distance between points, against all pairs."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from tomopose.geometry.extent import largest_distance


@pytest.mark.parametrize("n", [2, 3, 50, 700])
@pytest.mark.parametrize("d", [1, 2, 3, 5])
def test_it_is_that_of_all_pairs(rng, n, d):
    for x in (rng.normal(size=(n, d)), np.cumsum(rng.normal(size=(n, d)), axis=0), rng.integers(0, 3, (n, d)) * 1.0):
        assert largest_distance(x) == pytest.approx(pdist(x).max(), rel=1e-12, abs=0)


def test_points_on_a_circle_keep_all_their_pairs():
    a = np.linspace(0, 2 * np.pi, 601)
    x = np.column_stack([np.cos(a), np.sin(a)]) + 1e6
    assert largest_distance(x) == pytest.approx(pdist(x).max(), rel=1e-9)


def test_one_point_or_none_has_no_extent():
    assert largest_distance(np.ones((1, 3))) == largest_distance(np.ones((0, 3))) == 0.0


def test_few_points_of_a_long_course_are_compared_in_pairs(rng, monkeypatch):
    from tomopose.geometry import extent

    tau = np.linspace(-1, 1, 3000)
    course = np.polynomial.legendre.legvander(tau, 3)[:, 1:] @ rng.normal(size=(3, 3))
    compared = []
    einsum = np.einsum
    monkeypatch.setattr(extent.np, "einsum", lambda *a: compared.append(a[1].shape[0] * a[1].shape[1]) or einsum(*a))
    found = largest_distance(course)
    assert sum(compared) < 3000**2 / 10
    assert found == pytest.approx(pdist(course).max(), rel=1e-12)
