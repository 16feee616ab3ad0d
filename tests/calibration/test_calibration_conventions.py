"""A wrong convention written into the files is named by the command line, with the line that would fix it."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

import tomopose as tp

STUDY = Path(__file__).resolve().parents[2] / "benchmarks" / "trust" / "conventions.py"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("trust_conventions", STUDY)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["trust_conventions"] = module
    spec.loader.exec_module(module)
    return module


def ran(study, folder, name, *, still=False):
    rng = np.random.default_rng(3)
    options = study.write(folder, study.MISTAKES[name](study.files(rng, still=still), rng))
    code, said = study.command(["diagnose", *options])
    code_c, calibrated = study.command(["calibrate", *options, "--out", str(folder / "cal"), "--force"])
    return code, said, code_c, calibrated


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["rows flipped", "order ZYX", "y and z exchanged", "pairing lag +3", "half a pixel low"]
)
def test_the_true_cause_is_named_and_the_calibration_refused(study, tmp_path, name):
    code, said, code_c, calibrated = ran(study, tmp_path, name)
    assert code == 3
    assert said["leading"] == [name]
    cure = next(h["cure"] for h in said["hypotheses"] if h["name"] == name)
    assert cure
    assert cure in said["advice"][0]
    assert code_c == 3
    assert calibrated["verdict"] in ("rejected", "doubtful")


@pytest.mark.slow
def test_half_a_pixel_is_named_and_refused_whether_the_scanner_is_exact_or_not(study, tmp_path):
    """Where nobody vouches for u_0 and v_0 the shift may be theirs: both readings are named."""
    code, said, code_c, calibrated = ran(study, tmp_path, "half a pixel low")
    assert code == 3
    assert said["leading"] == ["half a pixel low"]
    assert code_c == 3
    assert "half a pixel low" in calibrated["reasons"][0]
    assert "u_0" in calibrated["reasons"][0]
    tp.write_scanner(tmp_path / "scanner.json", study.SCANNER.exact(), force=True)
    tables = ["--poses", str(tmp_path / "poses.csv"), "--observations", str(tmp_path / "observations.csv")]
    options = ["--scanner", str(tmp_path / "scanner.json"), *tables]
    code, calibrated = study.command(["calibrate", *options, "--free", "none", "--out", str(tmp_path / "exact")])
    assert code == 3
    assert calibrated["verdict"] in ("rejected", "doubtful")


@pytest.mark.slow
def test_what_cannot_be_distinguished_is_said(study, tmp_path):
    code, said, code_c, _ = ran(study, tmp_path, "order ZYX", still=True)
    assert code == code_c == 0
    assert next(h["outcome"] for h in said["hypotheses"] if h["name"] == "order ZYX") == "same"
    told = next(line for line in said["advice"] if line.startswith("cannot be distinguished"))
    assert "order ZYX" in told


@pytest.mark.slow
def test_an_order_that_the_poses_do_not_show_is_doubted_until_the_user_confirms_it(study, tmp_path):
    rng = np.random.default_rng(0)
    options = study.write(tmp_path, study.MISTAKES["order ZYX"](study.files(rng, still=True), rng))
    table = tmp_path / "poses.csv"
    table.write_text(table.read_text().replace("# units: confirmed\n", ""))
    code, said = study.command(["calibrate", *options, "--out", str(tmp_path / "silent")])
    assert code == 3
    (reason,) = said["reasons"]
    assert "cannot distinguish the convention" in reason
    found = next(f for f in said["findings"] if f["rule"] == "convention not distinguished")
    assert "--confirm-convention" in found["cure"]
    code, said = study.command(["calibrate", *options, "--confirm-convention", "--out", str(tmp_path / "said")])
    assert (code, said["reasons"]) == (0, [])
    table.write_text(table.read_text().replace("pi-hexapod", "pi-hexapod, confirmed"))
    assert study.command(["calibrate", *options, "--out", str(tmp_path / "written")])[0] == 0


@pytest.mark.slow
def test_readings_that_fit_equally_well_are_named_together(study, tmp_path):
    """With the table still and the ball turned by single axes, transposed rotations are angles of the other sign."""
    code, said, _, _ = ran(study, tmp_path, "rotation inverted", still=True)
    assert code == 3
    assert {"rotation inverted", "sign of UVW"} <= set(said["leading"])
    assert any("one another" in line for line in said["advice"])
