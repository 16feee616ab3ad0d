"""The rules over a history: what they find, where they place it, and how seldom they are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose.calibration.records.monitor import FALSE_ALARM, monitor
from tomopose.errors import InputError

NUMBERS = ("t_HT_x", "t_HT_y", "phi_HT_z", "t_x")


def history(seed, n, stated=1.0, change=None, **entry):
    """n runs that scatter by 1; stated: the standard uncertainty that they state;  change: of t_HT_x, a function."""
    rng = np.random.default_rng(seed)
    value = rng.normal(size=(n, len(NUMBERS)))
    value[:, 0] += 0.0 if change is None else change(np.arange(n))
    return [
        {
            "label": f"r{k}",
            "time_utc": f"2026-01-{k + 1:02d}",
            "parameters": {
                name: {"value": x, "u": stated, "unit": "mm"} for name, x in zip(NUMBERS, value[k], strict=True)
            },
            "d_rms_px": 1.0 + 0.05 * abs(rng.normal()),
            "verdict": "trustworthy",
            **entry,
        }
        for k in range(n)
    ]


CHANGES = {
    "single run": (lambda k: 15.0 * (k == 7), "r7"),
    "step": (lambda k: 8.0 * (k >= 12), "r12"),
    "trend": (lambda k: 0.8 * k, "r0"),
}


@pytest.mark.parametrize("stated", [1.0, 0.3])
@pytest.mark.parametrize("rule", CHANGES)
def test_each_change_is_named_by_its_rule_and_place(rule, stated):
    change, label = CHANGES[rule]
    for seed in range(3):
        found = monitor(history(seed, 20, stated, change))
        assert [a.parameter for a in found.alarms] == ["t_HT_x"]
        assert (found.alarms[0].rule, found.alarms[0].label) == (rule, label)
        assert "t_HT_x" in found.words[0]
        assert label in found.words[0]


def test_a_step_has_its_size_within_its_uncertainty():
    errors = []
    for seed in range(10):
        (alarm,) = monitor(history(seed, 20, change=lambda k: 8.0 * (k >= 12))).alarms
        errors.append((alarm.size - 8.0) / alarm.u)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.5)


def test_a_small_lasting_shift_is_found_in_time_by_the_weighted_mean_or_the_step():
    found = [monitor(history(seed, 40, change=lambda k: 2.0 * (k >= 20))).alarms for seed in range(6)]
    assert sum(bool(alarms) for alarms in found) >= 5
    assert all(a.parameter == "t_HT_x" for alarms in found for a in alarms)


@pytest.mark.slow
@pytest.mark.parametrize("n", [5, 15])
@pytest.mark.parametrize("stated", [1.0, 0.6, 0.0])
def test_unchanged_machines_raise_few_alarms_whatever_they_state(n, stated):
    looks = [bool(monitor(history([n, seed], n, stated)).alarms) for seed in range(40)]
    # at most 1 % is promised; 4 of 40 has a probability of 0.0006 at 1 %
    assert sum(looks) <= 40 * FALSE_ALARM + 3


def test_angles_are_continued_over_half_a_turn():
    def entry(k, x):
        angle = {"phi_HT_z": {"value": x, "u": 1e-5, "unit": "rad"}}
        return {"label": f"r{k}", "time_utc": "", "parameters": angle, "d_rms_px": 0.02}

    rng = np.random.default_rng(3)
    x = np.pi + 1e-5 * rng.normal(size=12)
    wrapped = np.where(x > np.pi, x - 2 * np.pi, x)
    assert np.ptp(wrapped) > 6
    assert monitor([entry(k, v) for k, v in enumerate(wrapped)]).alarms == ()


def test_runs_of_another_scanner_pivot_machine_or_verdict_are_left_out_in_words():
    runs = history(1, 12, scanner={"d_SR_mm": 300.0}, pivot_mm=[0.0, 0.0, 0.0], machine="one")
    for k in range(4):
        runs[k] = {**runs[k], "scanner": {"d_SR_mm": 299.0}}
    runs[5] = {**runs[5], "pivot_mm": [0.0, 0.0, 5.0]}
    runs[6] = {**runs[6], "machine": "two"}
    runs[7] = {**runs[7], "verdict": "rejected"}
    for k in (0, 1, 2, 3, 5, 6, 7):
        shifted = {"value": 99.0, "u": 1.0, "unit": "mm"}
        runs[k] = {**runs[k], "parameters": {**runs[k]["parameters"], "t_HT_y": shifted}}
    found = monitor(runs)
    assert found.alarms == ()
    assert found.judged == (4, 8, 9, 10, 11)
    said = " ".join(found.notes)
    assert "d_SR_mm 299 -> 300" in said
    assert "pivot" in said
    assert "another machine (two): r6" in said
    assert "rejected: r7" in said


def test_a_baseline_period_judges_what_came_after_it():
    runs = history(2, 20, change=lambda k: 8.0 * (k >= 8))
    assert monitor(runs, baseline="r8").alarms == ()
    (alarm,) = monitor(runs, baseline="r0:r7").alarms
    assert alarm.parameter == "t_HT_x"
    assert alarm.label == "r8"
    assert monitor(runs, baseline="17").judged[0] == 16
    for wrong in ("r99", "r0:r1", "a:b:c"):
        with pytest.raises(InputError):
            monitor(runs, baseline=wrong)


def test_two_runs_are_no_judgement():
    found = monitor(history(0, 2))
    assert found.alarms == ()
    assert found.words[0].startswith("no judgement yet: 2")
