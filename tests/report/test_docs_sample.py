"""The data set that the documentation offers for download: the repository's own layout, and what it holds is right."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

import tomopose as tp
from tomopose.cli.main import run

ROOT = Path(__file__).resolve().parents[2]
ARCHIVE = ROOT / "docs" / "downloads" / "tomopose-sample.zip"
POSES = 21


@pytest.fixture(scope="module")
def sample(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("sample")
    with zipfile.ZipFile(ARCHIVE) as archive:
        archive.extractall(folder)
    return folder / "tomopose-sample"


def test_the_archive_is_small_and_laid_out_as_a_project(sample):
    assert ARCHIVE.stat().st_size < 1_500_000
    names = sorted(p.relative_to(sample).as_posix() for p in sample.iterdir())
    assert names == ["README.md", "poses.csv", "radiographs", "scanner.json", "tomopose.toml", "truth.json"]
    poses = tp.read_poses(sample / "poses.csv")
    assert len(poses) == POSES
    assert len(set(poses.alpha)) == 2
    images = tp.open_images(sample / "radiographs", tp.read_scanner(sample / "scanner.json"))
    assert (len(images), images.dtype) == (POSES, np.uint16)


def test_one_command_calibrates_the_sample_and_finds_what_was_simulated(sample, monkeypatch):
    monkeypatch.chdir(sample)
    assert run(["calibrate", "--out", "cal", "--quiet"]) == 0
    found = tp.read_calibration("cal/calibration.json")
    assert found.verdict == "trustworthy"
    assert len(found.pose_id) == POSES
    truth = json.loads((sample / "truth.json").read_text(encoding="utf-8"))
    u = {p.name: p.u for p in found.parameters}
    assert np.abs((found.T_HT.t - truth["T_HT"]["t_mm"]) / [u[f"t_HT_{c}"] for c in "xyz"]).max() < 3.0
    assert np.abs((found.t - truth["t_mm"]) / [u[f"t_{c}"] for c in "xyz"]).max() < 3.0
    assert (sample / "cal" / "report.html").stat().st_size < 1_500_000
    assert (sample / "cal" / "job.json").is_file()


def test_the_front_page_offers_the_archive_and_every_start():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert "{download}`" in index
    assert "downloads/tomopose-sample.zip" in index
    for start in ("metrology-lab", "robot-ct", "imaging-group", "scanner-builder"):
        assert f"notebooks/{start}.md" in index
        assert (ROOT / "docs" / "notebooks" / f"{start}.md").is_file()
    assert "python -m pip install tomopose" in index
    assert "images/report.png" in index
