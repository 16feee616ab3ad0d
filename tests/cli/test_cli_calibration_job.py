"""job.json: what a review needs to solve as the run was solved."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tomopose.cli.calibration_job import job_of, options_of
from tomopose.cli.calibration_options import Options
from tomopose.errors import FileError, InputError


def options(folder: Path, **changes) -> Options:
    return Options(out=folder / "cal", scanner=folder / "scanner.json", poses=folder / "poses.csv", **changes)


def test_options_come_back_with_files_relative_to_the_folder(tmp_path):
    made = options(tmp_path, images=str(tmp_path / "radiographs/*.tif"), ball_diameter=8.0, free="d_SR,u_0", workers=2)
    cal = tmp_path / "cal"
    cal.mkdir()
    content = job_of(made, cal)
    assert content["options"]["scanner"] == "../scanner.json"
    assert str(tmp_path) not in json.dumps(content)
    (cal / "job.json").write_text(json.dumps({"schema": "tomopose/job/1", **content}))
    back = options_of(cal, {"scanner": Path("other.json"), "images": None})
    assert back.scanner.resolve() == (tmp_path / "scanner.json").resolve()
    assert back.images == str(tmp_path / "radiographs/*.tif")
    assert (back.ball_diameter, back.free, back.workers) == (8.0, "d_SR,u_0", 1)


def test_a_moved_project_is_found_again(tmp_path):
    made = options(tmp_path / "a", observations=tmp_path / "a" / "observations.csv")
    for name in ("a", "b"):
        (tmp_path / name / "cal").mkdir(parents=True)
    text = json.dumps({"schema": "tomopose/job/1", **job_of(made, tmp_path / "a" / "cal")})
    (tmp_path / "b" / "cal" / "job.json").write_text(text)
    assert options_of(tmp_path / "b" / "cal", {}).poses == tmp_path / "b" / "poses.csv"


def test_without_a_job_the_files_are_asked_for(tmp_path):
    with pytest.raises(FileError, match="give --scanner and --poses"):
        options_of(tmp_path, {})
    given = options_of(tmp_path, {"scanner": Path("s.json"), "poses": Path("p.csv")})
    assert given.observations == tmp_path / "observations.csv"


@pytest.mark.parametrize(
    ("content", "words"),
    [({"options": {"colour": 1}}, "unknown option 'colour'"), ({"options": {"scanner": 3}}, "scanner is 3"),
     ({"options": [1]}, "options is not an object"), ({"options": {"out": "x"}}, "unknown option 'out'")],
)  # fmt: skip
def test_a_bad_job_is_named(tmp_path, content, words):
    (tmp_path / "job.json").write_text(json.dumps({"schema": "tomopose/job/1", **content}))
    with pytest.raises(InputError, match=words):
        options_of(tmp_path, {})
