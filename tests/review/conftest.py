"""A run to review: 200 detections of which 12 were spoilt, with radiographs, as files of a project."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr

import tomopose as tp
from tomopose.cli.main import run
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project_ball
from tomopose.geometry.silhouette import silhouette_ellipse

T_BALL = np.array([3.0, -2.0, 21.0])
NOISE_PX, N, SPOILT, DIAMETER = 0.02, 200, 12, 8.0


@dataclass(frozen=True, kw_only=True)
class Project:
    """folder: scanner.json, poses.csv, observations.csv, radiographs/, cal/;  spoilt: ids of the bad detections."""

    folder: Path
    spoilt: tuple[str, ...]

    @property
    def cal(self) -> Path:
        return self.folder / "cal"

    def words(self, out: str, *more: str) -> list[str]:
        f = self.folder
        files = ["--scanner", f / "scanner.json", "--poses", f / "poses.csv", "--observations", f / "observations.csv"]
        return ["calibrate", *map(str, files), "--out", str(f / out), "--ball-diameter-mm", "8", *more]


def radiograph(scanner: tp.Scanner, x: np.ndarray, ellipse: tuple, rng: np.random.Generator) -> np.ndarray:
    """uint16 [v, u] with a dark ball of blurred rim at its silhouette."""
    centre, a, b, angle = ellipse
    v, u = np.mgrid[: scanner.n_v, : scanner.n_u]
    du, dv = u - centre[0], v - centre[1]
    c, s = np.cos(angle), np.sin(angle)
    r = np.hypot((c * du + s * dv) / a, (-s * du + c * dv) / b)
    level = 40_000 - 30_000 * ndtr((1 - r) * a / 0.8)
    return np.clip(rng.normal(level, 200.0), 0, 65_535).astype(np.uint16)


def draw(path: Path, scanner: tp.Scanner, centre: np.ndarray, rng: np.random.Generator) -> None:
    """Write the radiograph of a ball whose projected centre is (u, v)."""
    found = silhouette_ellipse(scanner, centre, float(np.arcsin(DIAMETER / 2 / scanner.d_SR)))
    tp.write_tiff(path, radiograph(scanner, centre, found, rng))


def mount() -> tp.RigidTransform:
    return tp.RigidTransform.from_angles([0.02, -0.03, 3.05], [2.0, -1.5, 4.0], source=Frame.H, target=Frame.T)


def make_project(folder: Path, *, images: int = N) -> Project:
    """Write the project; radiographs of the first `images` poses alone are drawn, the others show the same picture."""
    folder.mkdir(parents=True)
    scanner = tp.Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.8, p_v=0.84, u_0=255.4, v_0=244.8, n_u=512, n_v=489)
    steps = (-10.0, 0.0, 10.0)
    turns = [np.zeros(3)] + [s * 5.0 * np.eye(3)[k] for k in range(3) for s in (1, -1)]
    rows = [((x, y, z), r, a) for a in (0.0, np.pi / 2) for x in steps for y in steps for z in steps for r in turns][:N]
    ids = [f"p{k:03d}" for k in range(N)]
    poses = tp.PoseSequence.from_table(
        [p for p, _, _ in rows], np.array([r for _, r, _ in rows]), alpha=np.array([a for _, _, a in rows]), pose_id=ids
    )
    rng = np.random.default_rng(20260203)
    exact = project_ball(scanner, T_HT=mount(), T_MH=poses.T_MH, t=T_BALL, alpha=poses.alpha)
    x = exact + rng.normal(scale=NOISE_PX, size=exact.shape)
    bad = np.sort(rng.choice(N, SPOILT, replace=False))
    x[bad] += rng.choice([-1, 1], (SPOILT, 2)) * rng.uniform(0.5, 2.0, (SPOILT, 2))
    gamma = float(np.arcsin(DIAMETER / 2 / 283.5))
    ellipses = [silhouette_ellipse(scanner, c, gamma) for c in x]
    observations = tp.BallObservations.from_sigma(
        x, NOISE_PX, pose_id=ids, image=tuple(f"{i}.tif" for i in ids), x_ellipse=np.array([e[0] for e in ellipses]),
        semi_major=np.array([e[1] for e in ellipses]), semi_minor=np.array([e[2] for e in ellipses]),
        angle=np.array([e[3] for e in ellipses]),
    )  # fmt: skip
    tp.write_scanner(folder / "scanner.json", scanner)
    tp.write_poses(folder / "poses.csv", poses)
    tp.write_observations(folder / "observations.csv", replace(observations, ball_diameter=None))
    (folder / "radiographs").mkdir()
    for k, name in enumerate(ids[:images]):
        draw(folder / "radiographs" / f"{name}.tif", scanner, exact[k], rng)
    for name in ids[images:]:
        (folder / "radiographs" / f"{name}.tif").hardlink_to(folder / "radiographs" / f"{ids[0]}.tif")
    project = Project(folder=folder, spoilt=tuple(ids[k] for k in bad))
    assert run([*project.words("cal"), "--quiet"]) in (0, 3)
    return project


@pytest.fixture(scope="session")
def pattern(tmp_path_factory) -> Project:
    """Made once; tests work on copies."""
    return make_project(tmp_path_factory.mktemp("review") / "project", images=1)


@pytest.fixture(scope="module")
def module_project(pattern, tmp_path_factory) -> Project:
    return copy_of(pattern, tmp_path_factory.mktemp("review") / "project")


@pytest.fixture
def project(pattern, tmp_path) -> Project:
    return copy_of(pattern, tmp_path / "project")


def copy_or_link(source: str, target: str) -> None:
    if target.endswith(".tif"):
        os.link(source, target)
    else:
        shutil.copy2(source, target)


def copy_of(project: Project, folder: Path) -> Project:
    """Another folder with the same files; pictures, which nobody changes, are linked."""
    shutil.copytree(project.folder, folder, copy_function=copy_or_link)
    return replace(project, folder=folder)


@pytest.fixture
def drawn(pattern):
    """Writes the radiograph of pose k of the run to a path."""
    scanner, poses = tp.read_scanner(pattern.folder / "scanner.json"), tp.read_poses(pattern.folder / "poses.csv")
    centres = project_ball(scanner, T_HT=mount(), T_MH=poses.T_MH, t=T_BALL, alpha=poses.alpha)
    return lambda path, k: draw(path, scanner, centres[k], np.random.default_rng(k))
