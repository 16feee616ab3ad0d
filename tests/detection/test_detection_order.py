"""Selection against sorting."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose.detection.order import median, select

RNG = np.random.default_rng(4)
SAMPLES = {
    "normal": RNG.normal(size=501),
    "few levels": RNG.integers(0, 4, 500).astype(np.float64),
    "all equal": np.full(2000, 7.0),
    "sorted": np.arange(300.0),
    "one": np.array([3.0]),
}


@pytest.mark.parametrize("name", list(SAMPLES))
def test_selection_is_the_sorted_one(name: str) -> None:
    values, n = SAMPLES[name], SAMPLES[name].size
    assert median(values.copy(), n) == np.median(values)
    for k in (0, n // 4, n // 2, n - 1):
        scratch = values.copy()
        assert select(scratch, n, k) == np.sort(values)[k]
        assert np.all(scratch[:k] <= scratch[k])
        assert np.all(scratch[k:] >= scratch[k])
        assert np.array_equal(np.sort(scratch), np.sort(values))


def test_only_the_first_values_count() -> None:
    assert median(np.array([1.0, 5.0, 2.0, -9.0, -9.0]), 3) == 2.0


def test_missing_values_end_the_search() -> None:
    values = np.array([1.0, np.nan, 2.0, np.nan, np.nan])
    assert np.isnan(select(values, 5, 4))
