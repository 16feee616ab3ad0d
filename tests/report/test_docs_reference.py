"""Each page of the Python reference begins with an example that runs."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).resolve().parents[2] / "examples" / "reference").glob("*.py"))
EXPECTED = {
    "geometry": "magnification 5.291",
    "poses": "378 poses",
    "images": "1 image of (3, 4)",
    "files": "z_mm, rx_deg, ry_deg, rz_deg are missing",
    "detection": "thousandths of a pixel off",
    "calibration": "trustworthy",
    "exports": "px apart",
    "planning": "tilted [1. 1.]",
    "reconstruction": "true 0.05 /mm",
    "measurement": "points;",
    "report": "'Residuals on the detector', 'Correlations'",
    "simulation": "112 radiographs of (183, 211)",
}
"""What the printed text of each example holds."""


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=[p.stem for p in EXAMPLES])
def test_the_reference_s_examples_run(path, capsys):
    runpy.run_path(str(path), run_name="__main__")
    assert EXPECTED[path.stem] in capsys.readouterr().out


def test_every_example_says_what_it_prints():
    assert {p.stem for p in EXAMPLES} == set(EXPECTED)
