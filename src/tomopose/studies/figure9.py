"""Figure 9: the source's paths around the object, circular and tilted, as they are driven and as they are meant."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np

from tomopose.geometry.projection import eq5_matrices
from tomopose.geometry.rotations import R_y, R_z, rotation_angle_between
from tomopose.manipulator.poses import PoseSequence
from tomopose.report.page import Figure
from tomopose.report.style import ACCENT, ALERT, ORANGE, axis, layout, space_axis
from tomopose.studies.demo import demo_setup, paper_scanner
from tomopose.studies.parts.result import Progress, Scale, StudyCheck, StudyRow, check_below
from tomopose.studies.parts.steps import Steps
from tomopose.trajectory.completeness import source_path
from tomopose.trajectory.scan import circular_scan, tilted_scan
from tomopose.trajectory.tilt import R_HT_MOUNTED, eq11_triangle, sine_tilt
from tomopose.units import Array

PERIODS = 7
# Sec. 6.1, fig. 9, table 3: tilt's wave, largest and smallest tilt (deg), projections, voxel side (um).
PRINTED: Mapping[float, tuple[float, float, int, float]] = MappingProxyType(
    {5.3: (8.0, -8.0, 900, 75.6), 2.7: (5.0, -3.0, 1000, 148.2)}
)
WAVES: Mapping[float, Callable[[Array], Array]] = MappingProxyType({5.3: eq11_triangle, 2.7: sine_tilt})
OBJECTS = MappingProxyType({5.3: "multi-feature specimen", 2.7: "multi-sphere standard"})

TITLE = "Figure 9: source paths"
QUESTION = "Where is the source, seen from the object, and how far is the driven tilt from the one meant?"
NOTES = (
    "The path is taken from the projection matrices of eq. (5), not drawn from the formula: it passes the whole chain.",
    "The paper sets the poses with R_HT = R_z(pi), since no calibration was at hand; ours uses the calibrated R_HT. "
    "Both know the poses that were set, so neither is an error of the reconstruction; the path is just not quite "
    "the one meant.",
    "The small scale drives fewer views; the path is the same.",
)


@dataclass(frozen=True, kw_only=True)
class Path:
    """Source (n, 3), mm, in W at home, and how the object is turned beside the table, R (n, 3, 3) in W, at table angles
    alpha (n,), rad."""

    source: Array
    R: Array
    alpha: Array

    @property
    def tilt(self) -> Array:
        """(n,), rad, about y_W."""
        return np.arctan2(self.R[:, 0, 2], self.R[:, 2, 2])


def path_of(scan: PoseSequence, magnification: float) -> Path:
    """The source's path of a scan by the true mount, taken from the matrices of eq. (5)."""
    setup, scanner = demo_setup(paper=True), paper_scanner(magnification)
    alpha = scan.alpha
    P = eq5_matrices(scanner, T_HT=setup.T_HT, T_MH=scan.T_MH, alpha=alpha)
    turned = scanner.T_WS.R.T @ np.linalg.inv(scanner.K) @ P[:, :, :3]
    return Path(source=source_path(P), R=turned @ np.swapaxes(R_z(alpha), -1, -2), alpha=alpha)


def tilt_error(path: Path, meant: Array) -> float:
    """Largest angle, rad, between the object's rotation and the one meant, R_y(tilt)."""
    return float(np.max(rotation_angle_between(path.R, R_y(meant))))


def figures_of(paths: Mapping[float, tuple[Path, Path]]) -> list[Figure]:
    """The path in space and the tilt over the table angle, at each magnification."""
    figures = []
    for magnification, (tilted, circle) in paths.items():
        name = f"M {magnification}, {OBJECTS[magnification]}"
        data = [
            {
                "type": "scatter3d",
                "mode": "lines",
                "name": label,
                "x": p.source[:, 0],
                "y": p.source[:, 1],
                "z": p.source[:, 2],
                "line": {"color": colour, "width": 4},
            }
            for label, p, colour in (("3D scan", tilted, ACCENT), ("circular scan", circle, ALERT))
        ]
        scene = {
            "xaxis": space_axis("x / mm"),
            "yaxis": space_axis("y / mm"),
            "zaxis": space_axis("z / mm"),
            "aspectmode": "data",
        }
        figures.append(
            Figure(
                title=f"Source path, {name}",
                meaning="Positions of the source seen from the object.",
                look_for="Seven periods up and down around the circle.",
                data=data,
                layout=layout(scene=scene),
                height=460,
            )
        )
    tilts = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": f"M {m}",
            "x": np.degrees(p.alpha),
            "y": np.degrees(p.tilt),
            "line": {"color": colour, "width": 2},
        }
        for (m, (p, _)), colour in zip(paths.items(), (ACCENT, ORANGE), strict=True)
    ]
    figures.append(
        Figure(
            title="Tilt of the object",
            meaning="Turn about y_W by table angle: by it the source climbs over the object.",
            look_for="The triangle of eq. (11) and the sine with its offset.",
            data=tilts,
            layout=layout(xaxis=axis("table angle / deg"), yaxis=axis("tilt / deg")),
        )
    )
    return figures


def crossings(values: Array) -> int:
    """How often a closed wave rises through its middle."""
    level = (values.max() + values.min()) / 2
    above = values >= level
    return int(np.sum(above & ~np.roll(above, 1)))


def run(scale: Scale, seed: int, steps: Steps, progress: Progress) -> tuple[Any, Any, Any, Any]:
    """Rows, checks, figures and notes; nothing here is random."""
    R_HT = demo_setup(paper=True).T_HT.R
    rows: list[StudyRow] = []
    checks: list[StudyCheck] = []
    paths = {}
    for k, (magnification, (high, low, n, voxel)) in enumerate(PRINTED.items()):
        wave, group = WAVES[magnification], f"M {magnification}, {OBJECTS[magnification]}"
        views = n if scale == "paper" else 252
        as_set = path_of(tilted_scan(views, wave, R_HT=R_HT_MOUNTED), magnification)
        as_meant = path_of(tilted_scan(views, wave, R_HT=R_HT), magnification)
        paths[magnification] = (as_meant, path_of(circular_scan(views), magnification))
        scanner = paper_scanner(magnification)
        meant = wave(as_meant.alpha)
        off, best = tilt_error(as_set, meant), tilt_error(as_meant, meant)
        both = (as_set, as_meant)
        for quantity, printed, extreme in (("largest tilt", high, np.max), ("smallest tilt", low, np.min)):
            found = [float(np.degrees(extreme(p.tilt))) for p in both]
            rows.append(
                StudyRow(
                    group=group,
                    quantity=quantity,
                    unit="deg",
                    source="sec. 6.1",
                    printed=printed,
                    paper_method=found[0],
                    best=found[1],
                )
            )
        tilt = np.degrees(as_set.tilt)
        ends_off = float(max(abs(tilt.max() - high), abs(tilt.min() - low)))
        periods = [crossings(p.tilt) for p in both]
        rows += [
            StudyRow(
                group=group,
                quantity="periods",
                unit="1",
                source="sec. 6.1",
                printed=PERIODS,
                paper_method=periods[0],
                best=periods[1],
            ),
            StudyRow(
                group=group,
                quantity="largest error of the tilt",
                unit="mrad",
                paper_method=1e3 * off,
                best=1e3 * best,
                note="driven against meant",
            ),
            StudyRow(
                group=group,
                quantity="voxel side",
                unit="um",
                source="table 3",
                printed=voxel,
                best=1e3 * 2 * scanner.p_u / scanner.magnification,
                note="gives d_SR; not a test",
            ),
        ]
        checks += [
            StudyCheck(
                statement=f"the path has the printed seven periods ({group})",
                found=f"{periods[1]}",
                holds=periods == [PERIODS, PERIODS],
            ),
            check_below(f"with the calibrated R_HT the tilt is the one meant ({group})", 1e3 * best, 1e-6, "mrad"),
            check_below(
                f"with R_z(pi) in its place the tilt's ends are the printed ones ({group})", ends_off, 0.01, "deg"
            ),
        ]
        progress(k + 1, len(PRINTED))
    return rows, checks, figures_of(paths), NOTES
