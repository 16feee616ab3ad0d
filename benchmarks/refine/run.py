"""The table of docs/validation/refine.md: scans with known pose errors through `tp.refine` as a user calls it.

    python benchmarks/refine/run.py --out table.jsonl              # all rows; rows that are there already are kept
    python benchmarks/refine/run.py --out table.jsonl --only jump  # rows whose name holds a word
    python benchmarks/refine/run.py --out table.jsonl --print      # the table alone
    python benchmarks/refine/run.py --out table.jsonl --seed 10    # other errors and noise: 10 is added to each seed
    python benchmarks/refine/run.py --out table.jsonl --images gvxr --only white   # gVirtualXray casts the rays

Images come from line integrals in closed form (objects.py), which share nothing with the package, or from gVirtualXray
(meshes.py).  Errors are rms
distances, px, at the corners of a box of 16 mm, one rigid pose of the object removed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import meshes
import numpy as np
import objects

import tomopose as tp
import tomopose.refinement.run as refinement_run
from tomopose.engines.cpu import processors
from tomopose.reconstruction.run import line_integrals_of
from tomopose.refinement.estimate import Steps, estimate
from tomopose.refinement.halves import matched_to
from tomopose.refinement.joint_fit.fit import Fit, blank
from tomopose.refinement.joint_fit.measured import measured, with_held_out
from tomopose.refinement.joint_fit.projector import Workers
from tomopose.refinement.joint_fit.pyramid import level_of
from tomopose.refinement.prior import Prior, with_shared_errors
from tomopose.refinement.stated import prior_of

INTEGRALS = {"closed form": objects.line_integrals, "gvxr": meshes.line_integrals}


@dataclass(frozen=True, kw_only=True)
class Case:
    """One scan of 64 views of 109 x 101 px; voxel: mm, of 72^3; goal: px.

    images: who casts the rays, one of INTEGRALS.
    covariance: the prior holds the covariance from which the slow errors were drawn, correlated over the views, as a
    calibration that identified the manipulator states it; otherwise `tp.refine` knows nothing of the errors.
    """

    name: str
    obj: str
    errors: str
    goal: str
    way: str = "seven"
    noise: float = 0.005
    hardening: float = 0.0
    seed: int = 0
    voxel: float = 0.28
    covariance: bool = False
    images: str = "closed form"

    def scan(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, objects.Panel]:
        return objects.scan(
            self.obj,
            self.way,
            self.errors,
            noise=self.noise,
            hardening=self.hardening,
            seed=self.seed,
            integrals=INTEGRALS[self.images],
        )

    def changed(self, images: str, seed: int) -> Case:
        """The same scan with images from another simulator, and `seed` added to its own; its name says both."""
        name = self.name + (f", {images}" if images != self.images else "") + (f", seed + {seed}" if seed else "")
        return replace(self, name=name, images=images, seed=self.seed + seed)


STEP = {"obj": "step cylinder", "noise": 0.01}
CASES = (
    Case(name="balls, white", obj="balls", errors="white", goal="2 x bound"),
    Case(name="step cylinder, white", errors="white", goal="2 x bound", **STEP),
    Case(name="ellipsoids, white", obj="ellipsoids", errors="white", goal="2 x bound"),
    Case(name="balls, jump of one view", obj="balls", errors="jump", goal="0.05"),
    Case(name="balls, right", obj="balls", errors="none", goal="0.01"),
    Case(name="step cylinder, right", errors="none", goal="0.01", **STEP),
    Case(name="balls, right, beam hardening", obj="balls", errors="none", goal="0.01", hardening=0.1),
    Case(name="step cylinder, right, beam hardening", errors="none", goal="0.01", hardening=0.1, **STEP),
    Case(name="rod, both ends out of sight", obj="rod", errors="white", goal="exit 3", voxel=0.32),
    Case(name="object cut by the view", obj="cut", errors="white", goal="exit 3", voxel=0.32),
    Case(name="balls, hexapod", obj="balls", errors="hexapod", goal="0.06"),
    Case(name="step cylinder, hexapod", errors="hexapod", goal="0.06", **STEP),
    Case(name="balls, hexapod, its covariance", obj="balls", errors="hexapod", goal="0.06", covariance=True),
    Case(name="step cylinder, hexapod, its covariance", errors="hexapod", goal="0.06", covariance=True, **STEP),
    Case(name="balls, white, circle", obj="balls", errors="white", goal="2 x bound", way="circle", seed=1),
    Case(name="balls, white, sine", obj="balls", errors="white", goal="2 x bound", way="sine", seed=2),
    Case(name="step cylinder, white, sine", errors="white", goal="2 x bound", way="sine", seed=1, **STEP),
)


def matrices_of(P: np.ndarray, panel: objects.Panel) -> tp.ProjectionMatrices:
    size = {name: getattr(panel, name) for name in ("n_u", "n_v", "p_u", "p_v")}
    return tp.ProjectionMatrices(P=P, pose_id=tuple(f"p{j}" for j in range(len(P))), **size)


def bound(case: Case, P_true: np.ndarray, panel: objects.Panel) -> float:
    """The error, px, that noise alone leaves with the object known: from differences of exact line integrals."""
    solids = objects.OBJECTS[case.obj]()
    steps = np.array([0.05] * 3 + [0.005] * 3)
    p = objects.line_integrals(P_true, solids, panel, fine=1)
    J = []
    for axis, step in enumerate(steps):
        ends = []
        for sign in (1, -1):
            xi = np.zeros((len(P_true), 6))
            xi[:, axis] = sign * step
            ends.append(objects.line_integrals(objects.moved(P_true, xi), solids, panel, fine=1))
        J.append((ends[0] - ends[1]) / (2 * step))
    derivatives = np.stack(J, axis=1).reshape(len(P_true), 6, -1)
    weight = (np.exp(-p) / case.noise**2).reshape(len(P_true), 1, -1)
    covariance = np.linalg.inv((derivatives * weight) @ derivatives.transpose(0, 2, 1))
    corners = 8.0 * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    K = np.stack(
        [
            (objects.pixels(objects.moved(P_true, xi), corners) - objects.pixels(P_true, corners)) / 1e-5
            for xi in 1e-5 * np.eye(6)[:, None, :] * np.ones((1, len(P_true), 1))
        ],
        axis=-1,
    )
    return float(np.sqrt(np.mean(np.einsum("nmic,ncd,nmid->nm", K, covariance, K))))


def coverage(result: tp.Refinement, P_true: np.ndarray, grid: tp.VoxelGrid) -> dict[str, float]:
    """Shares of point coordinates and of views whose error is within 1.96 of the stated standard uncertainty."""
    centre = np.asarray(grid.centre)
    points = np.concatenate([centre[None], centre + 0.8 * (grid.corners - centre) / np.sqrt(2)])
    e = objects.differences(np.asarray(result.matrices), P_true, points)
    sigma = result.matrices.points_sigma
    of_view = np.sqrt((e**2).mean(axis=(1, 2)) / (sigma**2).mean(axis=1))
    return {
        "points within": float(np.mean(np.abs(e) < 1.96 * sigma[..., None])),
        "views within": float(np.mean(of_view < 1.96)),
        "error over sigma": float(np.sqrt(np.mean(e**2) / np.mean(sigma**2))),
    }


@contextmanager
def known_covariance(panel: objects.Panel) -> Iterator[None]:
    """`tp.refine` with the slow errors' covariance in its prior, where a calibration with poses would put it."""

    def prior_with(*arguments: object) -> tuple[Prior, float]:
        prior, px = prior_of(*arguments)  # type: ignore[arg-type]
        L = objects.slow_errors(len(arguments[0]), panel)  # type: ignore[arg-type]
        return with_shared_errors(prior, L, np.eye(L.shape[2])), px

    with patch.object(refinement_run, "prior_of", prior_with):
        yield


def row_of(case: Case) -> dict[str, object]:
    """One case through `tp.refine` with its default settings."""
    images, P, truth, panel = case.scan()
    matrices, grid = matrices_of(P, panel), tp.VoxelGrid.cube(n=72, spacing=case.voxel)
    begin, used = time.time(), time.process_time()
    with known_covariance(panel) if case.covariance else nullcontext():
        result = tp.refine(images, matrices, grid, images_are="transmission")
    row: dict[str, object] = {
        "name": case.name,
        "goal": case.goal,
        "before": objects.error_px(P, truth),
        "found": objects.error_px(objects.moved(P, result.corrections), truth),
        "after": objects.error_px(np.asarray(result.matrices), truth),
        "verdict": result.verdict,
        "reasons": list(result.reasons),
        "jumps": list(result.outliers),
        "chi": result.chi,
        "halves": result.halves_px,
        "stated": result.stated_px,
        "seconds": time.time() - begin,
        "processor seconds": time.process_time() - used,
    }
    if case.goal == "2 x bound":
        row["bound"] = bound(case, truth, panel)
    if result.verdict == "refined":
        row |= coverage(result, truth, grid)
    return row


def alternation(case: Case, rounds: int = 10) -> dict[str, object]:
    """Reconstruct, match each view to the volume, and again, at images binned by 2; the joint fit beside it."""
    images, P, truth, panel = case.scan()
    matrices, grid, s = matrices_of(P, panel), tp.VoxelGrid.cube(n=72, spacing=case.voxel), tp.RefineSettings()
    data = measured(line_integrals_of(images, matrices, "transmission", None), grid)
    data = with_held_out(data, s.held_out, coarsest=2, seed=0)
    prior, _ = prior_of(matrices, grid, s, None)
    level, workers = level_of(data, 2), Workers(threads=processors())
    state, errors = blank(level), []
    for _ in range(rounds):
        state = Fit(precision=None, steps=1, turns=s.turns, workers=workers)(level, state)
        state = matched_to(level, state, prior.precision, workers)
        errors.append(objects.error_px(objects.moved(P, state.q), truth))
    joint = estimate(data, (2,), prior, s, workers, Steps(2, None))
    return {
        "name": f"{case.name}: alternation beside",
        "before": objects.error_px(P, truth),
        "alternation": errors,
        "joint": objects.error_px(objects.moved(P, joint.state.q), truth),
    }


def table(rows: list[dict[str, object]]) -> str:
    """Markdown."""
    lines = [
        "| scan | before | after | goal | verdict | stated, halves (px a coordinate) | 95 % intervals hold | CPU s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        if "alternation" in r:
            errors = np.asarray(r["alternation"])
            lines.append(
                f"| {r['name']}, binned by 2 | {r['before']:.3f} px | best {errors.min():.3f} px, last "
                f"{errors[-1]:.3f} px; joint fit {r['joint']:.3f} px | | | | | |"
            )
            continue
        goal = f"{2 * float(r['bound']):.3f} px (2 x {float(r['bound']):.3f})" if "bound" in r else f"{r['goal']}"
        held = ""
        if "points within" in r:
            held = f"{100 * r['points within']:.0f} % points, {100 * r['views within']:.0f} % views"
        lines.append(
            f"| {r['name']} | {r['before']:.3f} px | {r['after']:.3f} px | {goal} | {r['verdict']} | "
            f"{r['stated']:.3f}, {r['halves']:.3f} | {held} | {r['processor seconds']:.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", default="")
    parser.add_argument("--print", action="store_true")
    parser.add_argument("--images", choices=tuple(INTEGRALS), default="closed form")
    parser.add_argument("--seed", type=int, default=0, help="added to each scan's own")
    a = parser.parse_args()
    rows = [json.loads(line) for line in a.out.read_text().splitlines()] if a.out.exists() else []
    known = {r["name"] for r in rows}
    cases = [case.changed(a.images, a.seed) for case in CASES]
    work = [(case.name, row_of, case) for case in cases]
    work.append((f"{cases[0].name}: alternation beside", alternation, cases[0]))
    for name, make, case in work:
        if a.print or name in known or a.only not in name:
            continue
        rows.append(make(case))
        with a.out.open("a") as file:
            file.write(json.dumps(rows[-1], default=float) + "\n")
        print(json.dumps(rows[-1], default=float), flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
