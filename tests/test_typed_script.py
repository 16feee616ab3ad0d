"""A user's typed script: every public function has types that say something, and a misspelt name fails."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import tomopose as tp

ROOT = Path(__file__).resolve().parents[1]
FUNCTIONS = [name for name in tp.__all__ if inspect.isfunction(getattr(tp, name))]

FOREIGN = {"to_astra", "to_cil", "to_leap", "to_rtk", "to_tigre"}
"""They give objects of packages that have no types of their own."""

SCRIPT = """
import tomopose as tp

scanner = tp.read_scanner("scanner.json")
poses = tp.read_poses("poses.csv")
observations = tp.detect(tp.open_images("radiographs/"), scanner, ball_diameter=8.0)
calibration = tp.calibrate(scanner, poses, observations)
matrices = tp.projection_matrices(calibration, poses, scanner=scanner)
volume = tp.reconstruct(tp.open_images("scan/"), matrices, tp.VoxelGrid(shape=(64, 64, 64), spacing=0.1))
tp.write_volume("volume.tif", volume)
for value in (scanner, poses, observations, calibration, matrices, volume):
    pass
reveal_type(scanner)
reveal_type(poses)
reveal_type(observations)
reveal_type(calibration)
reveal_type(matrices)
reveal_type(volume)
reveal_type(poses[0])
reveal_type(calibration.T_HT)
"""

MISTAKES = """
import tomopose as tp

tp.calibrat
tp.read_scanner("scanner.json").d_SDD
tp.calibrate("scanner.json", "poses.csv", "observations.csv")
tp.detect([], tp.read_scanner("scanner.json"))
"""


@pytest.fixture(scope="module")
def checked(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """name of a script -> what mypy says of it, with this package's own settings and cache."""
    folder = tmp_path_factory.mktemp("scripts")
    (folder / "script.py").write_text(SCRIPT, encoding="utf-8")
    (folder / "mistakes.py").write_text(MISTAKES, encoding="utf-8")
    every = "\n".join(["import tomopose as tp", "", *(f"reveal_type(tp.{name})" for name in FUNCTIONS)])
    (folder / "every.py").write_text(every, encoding="utf-8")
    files = [str(folder / f"{name}.py") for name in ("script", "mistakes", "every")]
    command = [sys.executable, "-m", "mypy", "--no-error-summary", "--no-pretty", *files]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert "error" not in done.stderr, done.stderr
    said: dict[str, str] = dict.fromkeys(("script", "mistakes", "every"), "")
    for line in done.stdout.splitlines():
        said[Path(line.split(":", 1)[0]).stem] += line + "\n"
    return said


@pytest.mark.slow
def test_a_script_of_the_public_names_passes_and_its_values_have_types(checked: dict[str, str]) -> None:
    assert "error" not in checked["script"]
    found = re.findall(r'Revealed type is "(?:tomopose\.[\w.]+\.)?(\w+)', checked["script"])
    values = ["Scanner", "PoseSequence", "BallObservations", "Calibration", "ProjectionMatrices", "Volume"]
    assert found == [*values, "PoseSequence", "RigidTransform"]


@pytest.mark.slow
def test_no_public_function_takes_or_gives_any(checked: dict[str, str]) -> None:
    """Arrays apart, whose shape NumPy types as Any."""
    said = re.findall(r'Revealed type is "(.*)"', checked["every"])
    assert len(said) == len(FUNCTIONS)
    unclear = {}
    for name, kind in zip(FUNCTIONS, said, strict=True):
        rest = re.sub(
            r"numpy\.ndarray\[[^\[\]]*(\[[^\[\]]*(\[[^\[\]]*\])?[^\[\]]*\][^\[\]]*)*\]|dtype\[Any\]", "", kind
        )
        if re.search(r"\bAny\b", rest) and name not in FOREIGN:
            unclear[name] = kind
    assert unclear == {}


@pytest.mark.slow
def test_misspelt_names_wrong_types_and_a_missing_diameter_are_errors(checked: dict[str, str]) -> None:
    lines = {int(m[1]): m[2] for m in re.finditer(r"mistakes\.py:(\d+): error: (.*)", checked["mistakes"])}
    assert sorted(lines) == [4, 5, 6, 7]
    assert "calibrat" in lines[4]
    assert "d_SDD" in lines[5]
    assert "ball_diameter" in lines[7]
