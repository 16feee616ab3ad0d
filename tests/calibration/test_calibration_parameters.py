"""What is said of many scanners at once agrees with what each scanner says of itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import tomopose as tp
from tomopose.calibration.model.ball_projection import SCANNER_COLUMNS, scanner_vector
from tomopose.calibration.model.parameters import (
    adjusted_scanners,
    free_parameters,
    scanner_vectors_at,
    scanners_can_be,
)

SCANNER = tp.Scanner(
    d_SD=1203.0, d_SR=311.0, p_u=0.2, p_v=0.17, u_0=501.3, v_0=382.9, n_u=1001, n_v=767, eta=0.01, axis_tilt_x=0.02
)


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("d_SR", 0.0),
        ("d_SR", 1203.0),
        ("d_SD", 300.0),
        ("p_u", -0.2),
        ("p_v", 0.0),
        ("u_0", math.inf),
        ("eta", math.nan),
        *((name, sign * 0.8) for name in ("theta", "phi", "axis_tilt_x", "axis_tilt_y") for sign in (1, -1)),
    ],
)
def test_vectors_can_be_where_a_scanner_accepts_their_numbers(name, wrong):
    s = np.tile(scanner_vector(SCANNER), (2, 1, 1))
    s[1, 0, SCANNER_COLUMNS.index(name)] = wrong
    assert scanners_can_be(s).tolist() == [True, False]
    with pytest.raises(tp.TomoposeError):
        replace(SCANNER, **{name: wrong})


def test_vectors_take_deviations_as_scanners_do():
    scanners = (SCANNER, replace(SCANNER, d_SR=402.0, axis_y=0.1))
    free = free_parameters(scanners, free=("d_SR", "u_0", "pitch_ratio", "axis_y"))
    delta = np.linspace(-0.3, 0.4, len(free))
    s = scanner_vectors_at(np.array([scanner_vector(one) for one in scanners]), free, delta[None])[0]
    expected = [scanner_vector(one) for one in adjusted_scanners(scanners, free, delta)]
    np.testing.assert_allclose(s, expected, rtol=1e-14, atol=1e-15)
