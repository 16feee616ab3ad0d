"""Draws docs/images/virtual-ct.png, radiographs of the calibration runs as the paper's fig. 7 shows them, and prints
the table of docs/validation/virtual-ct.md.

    python docs/images/make_virtual_ct_picture.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib
import numpy as np

import tomopose as tp
from tomopose.report.style import ACCENT, SOFT

matplotlib.use("Agg")
import matplotlib.pyplot as plt

FOLDER = Path(__file__).parent
SCENES = FOLDER.parents[1] / "examples/scenes"
POSE = 92
"""A pose in the middle of the grid, turned by 5 degrees."""


def crossing(profile, level: float) -> float:
    """Where a falling profile meets a level, by linear interpolation, px."""
    k = int(np.flatnonzero(profile < level)[0])
    return k - 1 + (profile[k - 1] - level) / (profile[k - 1] - profile[k])


def figures(run, image) -> dict[str, str]:
    """What fig. 7 shows without numbers: grey levels, contrast, edge, noise."""
    truth = run.truth()["poses"][POSE]
    u, v = truth["u_ellipse_px"], truth["v_ellipse_px"]
    radius = run.scanner.magnification * run.ball_diameter / 2 / run.scanner.p_u
    # The free half of the ball looks up; the other is in the holder.
    rows, columns = np.mgrid[: run.scanner.n_v, : run.scanner.n_u]
    away = np.hypot(columns - u, rows - v)
    angle = np.degrees(np.arctan2(rows - v, columns - u))
    free = (angle > 50) & (angle < 130)
    empty = image[free & (away > 1.6 * radius)].astype(float)
    core = image[away < 0.5 * radius].astype(float)
    # The edge, oversampled: pixels near the rim, sorted by their distance from it, in steps of a tenth of a pixel.
    near = free & (abs(away - radius) < 6)
    step = np.round(10 * (away[near] - radius + 6)).astype(int)
    edge = (np.bincount(step, image[near]) / np.maximum(np.bincount(step), 1))[1:-1][::-1]
    white, black = empty.mean(), core.mean()
    span = white - black
    width = (crossing(edge, black + 0.1 * span) - crossing(edge, black + 0.9 * span)) / 10
    flat = image.astype(float) - white
    inner = free & (away > 1.6 * radius)
    pairs = inner[:, 1:] & inner[:, :-1]
    correlation = (flat[:, 1:] * flat[:, :-1])[pairs].mean() / empty.var()
    return {
        "grey value of the empty beam": f"{white:.0f}",
        "grey value in the middle of the ball": f"{black:.0f}",
        "contrast of the ball (1 - black / white)": f"{1 - black / white:.3f}",
        "noise of the empty beam, standard deviation": f"{empty.std():.0f}",
        "signal-to-noise ratio of the empty beam": f"{white / empty.std():.0f}",
        "contrast-to-noise ratio of the ball": f"{span / empty.std():.0f}",
        "correlation of neighbouring pixels' noise": f"{correlation:.2f}",
        "width of the edge, 10 % to 90 %": f"{width:.2f} px",
        "pixels looked at": f"{empty.size}",
    }


def main() -> None:
    drawing, axes = plt.subplots(2, 2, figsize=(9, 7.6), gridspec_kw={"height_ratios": [1.6, 1]})
    table: dict[str, list[str]] = {}
    for column, name in enumerate(("2.7", "5.3")):
        run = tp.simulate(tp.read_scene(SCENES / f"ball-m{name}.toml"))
        image = run.image(POSE, threads=2)
        truth = run.truth()["poses"][POSE]
        u, v = (round(truth[k]) for k in ("u_ellipse_px", "v_ellipse_px"))
        half = int(1.7 * run.scanner.magnification * run.ball_diameter / 2 / run.scanner.p_u)
        part = image[v - half : v + half + 1, u - half : u + half + 1].astype(float)
        extent = (u - half - 0.5, u + half + 0.5, v - half - 0.5, v + half + 0.5)
        upper, lower = axes[:, column]
        upper.imshow(part, cmap="gray", origin="lower", extent=extent, vmin=part.min(), vmax=part.max())
        upper.axhline(v, color=SOFT, lw=0.6, ls="--")
        upper.axhline(v + half // 3, color=ACCENT, lw=0.6, ls="--")
        upper.set(title=f"Magnification {name}, pose {run.poses.pose_id[POSE]}", xlabel="u / px", ylabel="v / px")
        where = np.arange(u - half, u + half + 1)
        lower.plot(where, part[half], color=SOFT, lw=0.9, label="through the centre, holder and all")
        lower.plot(where, part[half + half // 3], color=ACCENT, lw=0.9, label="through the free half")
        lower.set(xlabel="u / px", ylabel="grey value", ylim=(0, None))
        lower.legend(fontsize=7.5, frameon=False, loc="lower left")
        for key, value in figures(run, image).items():
            table.setdefault(key, []).append(value)
    drawing.tight_layout()
    drawing.savefig(FOLDER / "virtual-ct.png", dpi=110)
    sys.stdout.write("| | M 2.7 | M 5.3 |\n|---|---|---|\n")
    for key, values in table.items():
        sys.stdout.write(f"| {key} | {' | '.join(values)} |\n")


if __name__ == "__main__":
    main()
