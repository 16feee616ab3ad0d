"""The rules of the verdict hold where a manipulator's errors are identified too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from manipulator_cases import Experiment, hexapod_experiment

from tomopose import BallObservations, Calibration
from tomopose.calibration.solve import calibrate
from tomopose.manipulator.virtual import typical_hexapod

HEXAPOD = typical_hexapod()


def found(e: Experiment, observations: BallObservations) -> Calibration:
    return calibrate(e.scanner, e.poses, observations, manipulator=HEXAPOD, model="kinematic", hypotheses=False)


@pytest.mark.slow
def test_images_that_drift_by_a_pixel_are_doubtful() -> None:
    e = hexapod_experiment(HEXAPOD, "mixed", 0)
    x = e.observations.x_D + np.linspace(0.0, 1.0, len(e.poses))[:, None] * [0.8, -0.6]
    cal = found(e, replace(e.observations, x_D=x))
    assert cal.model == "kinematic"
    assert cal.verdict != "trustworthy"
    assert {"drift", "step", "scatter of the poses", "drift or lag of the manipulator"} & {f.rule for f in cal.checks}


def test_twenty_eight_centres_set_aside_are_doubtful() -> None:
    e = hexapod_experiment(HEXAPOD, "mixed", 0)
    rng = np.random.default_rng(0)
    x = e.observations.x_D.copy()
    bad = rng.choice(len(x), 28, replace=False)
    x[bad] += rng.uniform(5.0, 30.0, (28, 2))
    cal = found(e, replace(e.observations, x_D=x))
    assert len(cal.outliers) >= 28
    assert cal.verdict == "doubtful"
    assert any(f.rule == "outliers" and f.verdict == "doubtful" for f in cal.checks)
