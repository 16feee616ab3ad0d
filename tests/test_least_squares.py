"""The package's least-squares loop: where it ends, and the sentence with which it does."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose.calibration.rigid import kernel
from tomopose.least_squares import CODES, Status, least_squares

X = np.linspace(0.0, 3.0, 25)


def rows(p):
    """Residuals of y = 2 exp(-0.7 x), which p = (a, b) shall follow, and the derivatives of a exp(-b x)."""
    shape = np.exp(-p[1] * X)
    return 2.0 * np.exp(-0.7 * X) - p[0] * shape, np.column_stack([shape, -p[0] * X * shape])


def solve(residuals, start, **options):
    return least_squares(residuals, np.add, np.array(start), **{"steps": 60, "tolerance": 1e-12, **options})


def test_an_optimum_is_reached_from_afar():
    found = solve(rows, [0.3, 3.0])
    assert found.status is Status.CONVERGED
    assert found.state == pytest.approx([2.0, 0.7], abs=1e-12)
    np.testing.assert_array_equal(found.r, rows(found.state)[0])
    assert found.cost == found.r @ found.r


def test_a_residual_that_stays_does_not_keep_it_from_an_optimum():
    def offset(p):
        r, J = rows(p)
        return r + 0.05 * np.sin(9 * X), J

    found = solve(offset, [1.0, 1.0], tolerance=1e-10)
    assert found.status is Status.CONVERGED
    assert found.J.T @ found.r == pytest.approx([0.0, 0.0], abs=1e-9)


def test_too_few_steps_are_said():
    found = solve(rows, [0.3, 3.0], steps=2)
    assert found.status is Status.OUT_OF_STEPS
    assert not found.status.at_rest


def test_a_direction_that_nothing_depends_on_is_singular():
    found = solve(lambda p: (X - p[0], np.column_stack([np.ones(25), np.zeros(25)])), [0.0, 0.0])
    assert found.status is Status.SINGULAR
    assert "open" in found.status.value


def test_derivatives_that_point_uphill_stall():
    found = solve(lambda p: (rows(p)[0], -rows(p)[1]), [1.0, 1.0])
    assert found.status is Status.STALLED
    np.testing.assert_array_equal(found.state, [1.0, 1.0])


def test_a_start_without_finite_residuals_is_no_start():
    found = solve(lambda p: (np.full(25, np.nan), rows(p)[1]), [1.0, 1.0])
    assert found.status is Status.NO_START
    assert found.cost == np.inf


def test_a_step_into_the_impossible_is_not_taken():
    def half(p):
        r, J = rows(p)
        return (r if p[1] < 1.2 else np.full(25, np.nan)), J

    found = solve(half, [0.2, 1.1])
    assert found.status is Status.CONVERGED
    assert found.state == pytest.approx([2.0, 0.7], abs=1e-12)


def test_the_compiled_kernel_ends_in_the_same_words():
    for name in ("CONVERGED", "STALLED", "OUT_OF_STEPS", "SINGULAR", "NO_START"):
        assert CODES[getattr(kernel, name)] is Status[name]
