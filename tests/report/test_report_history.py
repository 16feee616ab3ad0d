"""Calibrations over time: the pages say what the comparison and the control charts found."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from every_page import shifted

from tomopose.calibration.records.compare import compare
from tomopose.calibration.records.history import history_entry
from tomopose.errors import InputError
from tomopose.report import calibration_report, comparison_report, history_report
from tomopose.report.pages.history_page import signed


@pytest.fixture(scope="module")
def entries(sample):
    """Twelve calibrations with the scatter that their uncertainties state, the last one moved by 50 um along x."""
    calibration = sample()[0]
    u = np.array([p.u for p in calibration.parameters if p.name.startswith("t_HT")])
    rng = np.random.default_rng(5)
    made = []
    for k in range(12):
        t = rng.normal(size=3) * u + np.array([0.05 if k == 11 else 0.0, 0.0, 0.0])
        entry = history_entry(shifted(calibration, t), label=f"run {k}")
        made.append({**entry, "time_utc": f"2026-01-{k + 1:02d}T08:00"})
    return made


def test_a_change_is_reported_with_its_size(sample):
    calibration = sample()[0]
    html = comparison_report(compare(calibration, shifted(calibration, np.array([0.05, 0, 0]))), labels=("May", "June"))
    assert 'class="verdict care"' in html
    assert ">Changed<" in html
    assert "+50.0 µm" in html
    assert "May → June" in html
    same = comparison_report(compare(calibration, calibration))
    assert ">Unchanged<" in same


def test_a_control_chart_marks_what_lies_beyond_its_limits(entries):
    html = history_report(entries)
    figures = json.loads(re.search(r'id="figures">(.*?)</script>', html, re.S)[1])
    assert len(figures) == 7
    by_title = {f["layout"]["yaxis"]["title"]["text"]: f["data"][-1] for f in figures.values()}
    colours = by_title["t_HT_x / µm"]["marker"]["color"]
    assert len(set(colours[:-1])) == 1
    assert colours[-1] != colours[0]
    assert by_title["t_HT_x / µm"]["y"][-1] == pytest.approx(50.0, abs=8.0)
    assert len(set(by_title["t_HT_y / µm"]["marker"]["color"])) == 1
    assert "run 11" in html


def test_a_calibration_report_shows_its_history(sample, entries):
    calibration, observations, poses = sample()
    html = calibration_report(calibration, observations=observations, poses=poses, history=entries)
    assert "Over time" in html
    assert "Over time" not in calibration_report(
        calibration, observations=observations, poses=poses, history=entries[:2]
    )


def test_two_entries_make_no_chart(entries):
    with pytest.raises(InputError, match="need 3"):
        history_report(entries[:2])


def test_changes_carry_their_sign():
    assert signed(-0.0123, "mm") == "−12.3 µm"
    assert signed(2e-5, "rad") == "+20.0 µrad"
    assert signed(0.5, "px") == "+0.500 px"
