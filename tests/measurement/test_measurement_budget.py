"""Shares of the uncertainty, apart and together."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import t

from tomopose.measurement.budget import budget
from tomopose.measurement.results import MeasurementResult, Repeat
from tomopose.measurement.uncertainty import Simulated


def result(u=0.002, dof=40.0, kind="distance"):
    return MeasurementResult(
        name="L", kind=kind, value=10.0, u=u, dof=dof, unit="mm", method="", direction="", volume="a"
    )


def repeat(s, n=5):
    return Repeat(group="g", name="L", n=n, mean=10.0, s=s, unit="mm", error=None, U=0.0)


def drawn(mean, u, runs=20, **more):
    return Simulated(mean=mean, u=u, low=0.0, high=0.0, runs=runs, stable=False, seed=0, **more)


def test_the_fit_alone_is_the_result_s_own_interval():
    found = budget(result())
    assert (found.repeats, found.calibration, found.simulation, found.mean_error) == (None, None, None, None)
    assert pytest.approx(t.ppf(0.975, 40) * 0.002) == result().U == found.U
    assert (found.value, found.corrected) == (10.0, 10.0)
    assert found.interval == result().interval == "fit alone, without the systematic part"


def test_repeats_that_scatter_more_take_the_fit_s_place():
    assert budget(result(), repeat=repeat(0.001)).u == 0.002
    found = budget(result(), repeat=repeat(0.005))
    assert (found.u, found.dof) == (0.005, 4.0)


def test_the_calibration_adds_in_squares():
    found = budget(result(), calibration=0.0015)
    assert found.u == pytest.approx(0.0025)
    assert found.dof == pytest.approx(40 * (0.0025 / 0.002) ** 4)


def test_a_simulation_stands_for_fit_and_calibration_and_corrects_the_value():
    found = budget(
        result(), calibration=0.0015, simulated=drawn(0.004, 0.001, u_fit=0.002, dof_fit=800.0, with_calibration=True)
    )
    assert found.u == pytest.approx(0.001 * math.sqrt(1 + 1 / 20))
    assert found.dof == 19
    assert (found.value, found.corrected) == (10.0, pytest.approx(9.996))
    assert found.interval == "virtual scans; corrected by simulation"


def test_a_calibration_that_was_not_drawn_is_added():
    found = budget(result(), calibration=0.0015, simulated=drawn(math.nan, 0.001))
    u = 0.001 * math.sqrt(1 + 1 / 20)
    assert found.u == pytest.approx(math.hypot(u, 0.0015))
    assert found.dof == pytest.approx(19 * (found.u / u) ** 4)
    assert found.mean_error is None
    assert found.corrected == 10.0
    assert found.interval == "virtual scans, calibration; mean error not corrected"


def test_a_scan_noisier_than_the_virtual_ones_is_said_to_be_so():
    usual = drawn(0.0, 0.001, u_fit=0.0017, dof_fit=800.0)
    assert budget(result(u=0.002), simulated=usual).u == pytest.approx(0.001 * math.sqrt(1 + 1 / 20))
    found = budget(result(u=0.0034), simulated=usual)
    assert found.u == pytest.approx(math.sqrt(0.001**2 * (1 + 1 / 20) + 0.0034**2 - 0.0017**2))
    assert "2.0 times" in found.interval
    among_repeats = budget(result(u=0.002), repeat=repeat(0.004), simulated=usual)
    assert among_repeats.u == pytest.approx(math.sqrt(0.001**2 * (1 + 1 / 20) + 0.004**2 - 0.001**2))


@pytest.mark.parametrize("runs", [3, 5, 20, 100])
def test_the_interval_of_a_simulation_holds_95_percent_whatever_the_number_of_draws(runs):
    """Errors of scans and draws from one normal law: a bias and a scatter that the fit does not know in full."""
    rng = np.random.default_rng(runs)
    bias, s, n = -0.005, 0.0015, 4000
    draws = bias + s * rng.standard_normal((n, runs))
    scans = bias + s * rng.standard_normal(n)
    held = []
    for d, e in zip(draws, scans, strict=True):
        row = result(u=0.0012)
        found = budget(row, simulated=drawn(float(d.mean()), float(d.std(ddof=1)), runs, u_fit=0.0012, dof_fit=1e4))
        held.append(abs(found.corrected + e - row.value) <= found.U)
    assert np.mean(held) == pytest.approx(0.95, abs=3 * math.sqrt(0.95 * 0.05 / n))


def test_form_is_not_corrected_and_has_an_uncertainty_from_simulation_alone():
    assert math.isnan(budget(result(u=math.nan, kind="form_95")).u)
    found = budget(result(u=math.nan, kind="form_95"), simulated=drawn(0.06, 0.003))
    assert found.u == pytest.approx(0.003 * math.sqrt(1 + 1 / 20))
    assert found.corrected == 10.0
