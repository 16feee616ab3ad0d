"""Selection against sorting."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose.detection.order_statistics import arrange, median, select

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
    values = SAMPLES[name]
    assert median(values.copy()) == np.median(values)
    for k in (0, values.size // 4, values.size // 2, values.size - 1):
        scratch = values.copy()
        assert select(scratch, k) == np.sort(values)[k]
        assert np.all(scratch[:k] <= scratch[k])
        assert np.all(scratch[k:] >= scratch[k])
        assert np.array_equal(np.sort(scratch), np.sort(values))


def test_missing_values_end_the_search() -> None:
    values = np.array([1.0, np.nan, 2.0, np.nan, np.nan])
    assert np.isnan(select(values, 4))


@pytest.mark.parametrize("name", list(SAMPLES))
def test_values_are_arranged_upwards(name: str) -> None:
    values = SAMPLES[name].copy()
    arrange(values)
    assert np.array_equal(values, np.sort(SAMPLES[name]))
