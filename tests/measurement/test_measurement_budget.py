"""Shares of the uncertainty, apart and together."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import t

from tomopose.coverage import combined, coverage_factor, expanded, expanded_k2
from tomopose.measurement.budget import budget
from tomopose.measurement.conformity import Decision, decide
from tomopose.measurement.result import MeasurementResult, Repeat
from tomopose.measurement.results import MeasurementResults
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


def test_a_simulation_covers_fit_and_calibration_and_corrects_the_value():
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


@pytest.mark.slow
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


def repeats_of(values, **more):
    """The repeats of one length over volumes with these values, whose fits state nothing."""
    rows = tuple(
        MeasurementResult(
            name="L",
            kind="distance",
            value=float(v),
            u=math.nan,
            unit="mm",
            method="",
            direction="",
            volume=f"scan {k}",
            **more,
        )
        for k, v in enumerate(values)
    )
    volumes = tuple(r.volume for r in rows)
    return MeasurementResults(
        plan_name="", results=rows, features={v: {} for v in volumes}, groups={"group": volumes}
    ).repeats()[0]


RUNS = 3000
SLACK = 3 * math.sqrt(0.95 * 0.05 / RUNS)


@pytest.mark.parametrize("n", [2, 3, 5, 20])
def test_the_intervals_of_repeats_hold_95_percent_whatever_their_number(n):
    """Without a calibrated reference: one further scan, and the mean."""
    rng = np.random.default_rng(n)
    further, mean = [], []
    for scans in 12.0 + 0.002 * rng.standard_normal((RUNS, n + 1)):
        found = repeats_of(scans[1:])
        further.append(abs(scans[0] - 12.0) <= found.U)
        mean.append(abs(found.mean - 12.0) <= found.U_mean)
    assert np.mean(further) == pytest.approx(0.95, abs=SLACK)
    assert np.mean(mean) == pytest.approx(0.95, abs=SLACK)


@pytest.mark.slow
@pytest.mark.parametrize("bias", [0.0, 0.002, 0.02])
@pytest.mark.parametrize("n", [2, 3, 5, 20])
def test_the_interval_with_a_calibrated_reference_holds_at_least_95_percent(n, bias):
    """The mean error is added, not taken off: one side is then never missed, and 97.5 % are held at most."""
    rng = np.random.default_rng([n, round(1e4 * bias)])
    held = []
    for scans in 12.0 + bias + 0.002 * rng.standard_normal((RUNS, n + 1)):
        held.append(abs(scans[0] - 12.0) <= repeats_of(scans[1:], reference=12.0).U)
    assert 0.95 - SLACK < np.mean(held) < 0.975 + SLACK


def test_one_rule_of_coverage():
    assert expanded(0.002, 4) == pytest.approx(t.ppf(0.975, 4) * 0.002)
    assert coverage_factor() == pytest.approx(1.959964, abs=1e-6)
    assert math.isnan(expanded(0.002, 0))
    assert math.isnan(expanded(math.inf))
    assert expanded_k2(0.003) == 0.006
    assert combined([(3.0, 10.0), (4.0, math.inf), (0.0, 1.0)]) == (5.0, pytest.approx(5**4 / (81 / 10)))
    assert combined([]) == (0.0, math.inf)


class TestDecision:
    """ISO 14253-1: the whole interval within the limit, the whole interval beyond it, or neither."""

    @pytest.mark.parametrize(
        ("error", "U", "expected"),
        [
            (3.0, 1.0, Decision.CONFORMING),
            (-4.0, 1.0, Decision.CONFORMING),
            (4.5, 1.0, Decision.NOT_DECIDABLE),
            (5.5, 1.0, Decision.NOT_DECIDABLE),
            (-6.5, 1.0, Decision.NOT_CONFORMING),
            (0.0, math.nan, Decision.NOT_DECIDABLE),
            (math.nan, 1.0, Decision.NOT_DECIDABLE),
            (99.0, math.inf, Decision.NOT_DECIDABLE),
        ],
    )
    def test_each_case(self, error, U, expected):
        assert decide(error, U, 5.0) is expected

    def test_repeats_that_scatter_more_than_the_fit_states_undo_a_conformity(self):
        row = result(u=0.0005)
        row = replace(row, reference=10.0, limit=0.004, limit_rule="tolerance")
        assert row.decision is Decision.CONFORMING
        assert budget(row).decision is Decision.CONFORMING
        assert budget(row, repeat=repeat(0.003)).decision is Decision.NOT_DECIDABLE

    def test_a_simulation_corrects_a_workpiece_and_not_an_instrument(self):
        row = replace(result(u=0.0005), value=10.006, reference=10.0, limit=0.004)
        off = drawn(0.006, 0.0005, u_fit=0.0005, dof_fit=800.0)
        assert budget(replace(row, limit_rule="tolerance"), simulated=off).decision is Decision.CONFORMING
        assert budget(replace(row, limit_rule="MPE"), simulated=off).decision is Decision.NOT_CONFORMING

    def test_the_reference_widens_the_error_and_not_the_value(self):
        row = replace(result(u=0.0005), reference=10.0, u_reference=0.002, limit=0.004)
        found = budget(row)
        assert found.u == 0.0005
        assert found.U_error == pytest.approx(expanded(*combined([(0.0005, 40.0), (0.002, math.inf)])))
        assert found.decision is Decision.NOT_DECIDABLE
