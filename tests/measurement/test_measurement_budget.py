"""Shares of the uncertainty, apart and together."""

from __future__ import annotations

import math

import pytest
from scipy.stats import t

from tomopose.measurement.budget import budget
from tomopose.measurement.results import MeasurementResult, Repeat
from tomopose.measurement.uncertainty import Simulated


def result(u=0.002, dof=40.0, kind="distance"):
    return MeasurementResult(name="L", kind=kind, value=10.0, u=u, dof=dof, unit="mm", method="", direction="",
                             volume="a")


def repeat(s, n=5):
    return Repeat(group="g", name="L", n=n, mean=10.0, s=s, unit="mm", error=None, U=0.0)


def drawn(mean, u, runs=20):
    return Simulated(mean=mean, u=u, low=0.0, high=0.0, runs=runs, stable=False, seed=0)


def test_the_fit_alone_is_the_result_s_own_interval():
    found = budget(result())
    assert (found.repeats, found.calibration, found.simulation, found.mean_error) == (None, None, None, None)
    assert pytest.approx(t.ppf(0.975, 40) * 0.002) == result().U == found.U
    assert found.corrected == 10.0


def test_repeats_that_scatter_more_take_the_fit_s_place():
    assert budget(result(), repeat=repeat(0.001)).u == 0.002
    found = budget(result(), repeat=repeat(0.005))
    assert (found.u, found.dof) == (0.005, 4.0)


def test_the_calibration_adds_in_squares():
    found = budget(result(), calibration=0.0015)
    assert found.u == pytest.approx(0.0025)
    assert found.dof == pytest.approx(40 * (0.0025 / 0.002) ** 4)


def test_a_simulation_is_no_further_share_and_corrects_the_value():
    narrow = budget(result(), calibration=0.0015, simulated=drawn(0.004, 0.001))
    assert narrow.u == pytest.approx(0.0025)
    assert narrow.corrected == pytest.approx(9.996)
    wide = budget(result(), calibration=0.0015, simulated=drawn(math.nan, 0.01))
    assert wide.u == pytest.approx(0.01 * math.sqrt(1 + 1 / 20))
    assert wide.dof == 19
    assert wide.mean_error is None
    assert wide.corrected == 10.0


def test_form_is_not_corrected_and_has_an_uncertainty_from_simulation_alone():
    assert math.isnan(budget(result(u=math.nan, kind="form_95")).u)
    found = budget(result(u=math.nan, kind="form_95"), simulated=drawn(0.06, 0.003))
    assert found.u == pytest.approx(0.003 * math.sqrt(1 + 1 / 20))
    assert found.corrected == 10.0
