"""One exact calibration run as files: what people hand to the command line."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import tomopose as tp
from tomopose.geometry.projection import project_ball

T_BALL = np.array([6.0, -4.0, 11.0])


@dataclass(frozen=True)
class Files:
    """Paths of a run without noise, and the truth behind it."""

    folder: Path
    scanner: tp.Scanner
    T_HT: tp.RigidTransform
    poses: tp.PoseSequence
    x_D: np.ndarray

    def calibrate(self, out: str = "cal", **changed: Path) -> list[str]:
        """The words of `tomopose calibrate` for this run, with files exchanged by name."""
        files = {"scanner": "scanner.json", "poses": "poses.csv", "observations": "observations.csv"}
        words = ["calibrate", "--out", str(self.folder / out), "--quiet"]
        for name, file in files.items():
            words += [f"--{name}", str(changed.get(name, self.folder / file))]
        return words

    def table(self, name: str, text: str) -> Path:
        path = self.folder / name
        path.write_text(text, encoding="utf-8")
        return path

    def json(self, name: str) -> dict:
        return json.loads((self.folder / name).read_text(encoding="utf-8"))


@pytest.fixture
def files(tmp_path, scanner, T_HT, rng) -> Files:
    scanner = scanner.exact()
    n = 30
    poses = tp.PoseSequence.from_table(
        rng.uniform(-9, 9, (n, 3)),
        rng.uniform(-6, 6, (n, 3)),
        pose_id=[f"p{k}" for k in range(n)],
        alpha=rng.choice([0.0, np.pi / 2, np.pi], n),
    )
    x_D = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=T_BALL, alpha=poses.alpha)
    order = rng.permutation(n)
    observations = tp.BallObservations.from_sigma(x_D[order], 0.01, pose_id=[poses.pose_id[k] for k in order])
    tp.write_scanner(tmp_path / "scanner.json", scanner)
    tp.write_poses(tmp_path / "poses.csv", poses)
    tp.write_observations(tmp_path / "observations.csv", observations)
    return Files(folder=tmp_path, scanner=scanner, T_HT=T_HT, poses=poses, x_D=x_D)
