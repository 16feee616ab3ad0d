"""Draws docs/images/demo.png from the folder that `tomopose demo` made.

tomopose demo --out demo && python docs/images/make_demo_picture.py demo
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np

import tomopose as tp
from tomopose.report.figures.thumbnails import thumbnail
from tomopose.report.gather import rotation_groups
from tomopose.report.style import ACCENT, ALERT, INK, ROTATION_COLOURS, SOFT

matplotlib.use("Agg")
import matplotlib.pyplot as plt

FOLDER = Path(__file__).parent
PICTURED = 9


def radiograph(axes, folder: Path, observations: tp.BallObservations) -> None:
    """One radiograph with the silhouette found and the projection of the ball's centre."""
    images = tp.open_images(folder / "radiographs", tp.read_scanner(folder / "scanner.json"))
    picture = thumbnail(observations, PICTURED, images[PICTURED])
    u, v = picture.origin
    height, width = picture.crop.shape
    axes.imshow(picture.crop, cmap="gray", origin="lower", extent=(u - 0.5, u + width - 0.5, v - 0.5, v + height - 0.5))
    axes.plot(*picture.outline.T, color="#ff9d2e", lw=1.6)
    axes.plot(*picture.centre, "+", color="#39c0ff", ms=13, mew=1.6)
    sigma = observations.sigma[PICTURED].mean()
    axes.set(xlabel="u / px", ylabel="v / px", title=f"The ball's centre, found to {sigma:.5f} px")


def residuals(axes, calibration: tp.Calibration, poses: tp.PoseSequence) -> None:
    """d_k by pose, coloured by rotation, as in the paper's fig. 8."""
    groups = np.array(rotation_groups(poses.select(poses.index_of(calibration.pose_id))))
    number = np.arange(1, len(groups) + 1)
    for name, colour in ROTATION_COLOURS.items():
        rows = groups == name
        if rows.any():
            axes.plot(number[rows], calibration.d[rows], "o", ms=4.5, color=colour, label=name)
    axes.axhline(calibration.d_rms, color=SOFT, ls="--", lw=1)
    axes.legend(title="rotation", fontsize=7.5, title_fontsize=8, ncol=2, frameon=False, loc="upper left")
    axes.set(xlabel="pose number", ylabel="d / px", title=f"Residuals: d_rms = {calibration.d_rms:.5f} px")
    axes.set_ylim(0, 1.45 * calibration.d.max())


def source_path(axes, matrices: tp.ProjectionMatrices) -> None:
    """The source as the object sees it, beside the circle of an ordinary scan (the paper's fig. 9)."""
    source = matrices.decompose().source
    radius = np.median(np.hypot(source[:, 0], source[:, 1]))
    turn = np.linspace(0, 2 * np.pi, 200)
    axes.plot(radius * np.cos(turn), radius * np.sin(turn), 0 * turn, color=ALERT, lw=1.2, label="circular scan")
    axes.plot(*source.T, "o-", ms=2, lw=1, color=ACCENT, label="this scan")
    axes.scatter(0, 0, 0, color=INK, s=18)
    axes.set_box_aspect((1, 1, 0.45), zoom=1.12)
    axes.view_init(elev=24, azim=-62)
    axes.tick_params(labelsize=7, pad=-1)
    axes.legend(fontsize=7.5, frameon=False, loc="upper right")
    axes.set_title("Path of the source around the object / mm")


def main(folder: Path) -> None:
    plt.rcParams.update({"font.size": 9, "axes.titlesize": 10, "axes.edgecolor": "#aab4c0", "text.color": INK})
    figure = plt.figure(figsize=(13, 4.1), dpi=110)
    axes = [figure.add_subplot(1, 3, 1), figure.add_subplot(1, 3, 2), figure.add_subplot(1, 3, 3, projection="3d")]
    radiograph(axes[0], folder, tp.read_observations(folder / "observations.csv"))
    residuals(axes[1], tp.read_calibration(folder / "calibration.json"), tp.read_poses(folder / "poses.csv"))
    source_path(axes[2], tp.read_matrices(folder / "matrices.npz"))
    for a in axes[:2]:
        a.spines[["top", "right"]].set_visible(False)
    figure.tight_layout(w_pad=2.5)
    figure.savefig(FOLDER / "demo.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
