"""What the manipulator's errors do to a reconstructed surface: fig. 12's periodic pattern on a plain cylinder.

The line integrals of a cylinder are known in closed form, so that nothing but the matrices and the view order differs
between the volumes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from tomopose.calibration.projection_matrices import projection_matrices
from tomopose.errors import InputError
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.manipulator.poses import PoseSequence
from tomopose.reconstruction.run import reconstruct
from tomopose.reconstruction.settings import FDK, SART, Algorithm
from tomopose.report.page import Figure
from tomopose.report.style import ACCENT, ALERT, ORANGE, axis, layout
from tomopose.studies.parts.result import Progress, Scale, StudyCheck, StudyRow, check_below
from tomopose.studies.parts.steps import Steps
from tomopose.studies.parts.virtual_hexapod import ball_run, real_T_MH, scan_of
from tomopose.studies.section6.calibrations import kinematic, planned_run, projected, rigid
from tomopose.studies.section6.tables import PRINTED_CYLINDER_UM
from tomopose.trajectory.scan import circular_scan
from tomopose.units import Array
from tomopose.volume import Volume, VoxelGrid

MAGNIFICATION = 5.3
RADIUS, HALF_HEIGHT = 15.0, 6.0
ATTENUATION = 0.05
PERIODS = 7
ANGLES = 252
PLAN = {"small": (8, 126), "paper": (4, 504)}
"""Scale -> detector binning, views."""
FILTERED, GOLDEN, SEQUENTIAL = FDK(), SART(order="golden"), SART(order="sequential")

TITLE = "Fig. 12 in principle: a cylinder's surface"
QUESTION = "Do the manipulator's errors print the tilt's seven periods on a surface, and are they gone by our best?"
NOTES = (
    "The paper's specimen is in study section6. Here it, noise and beam hardening are left out: the object is a plain "
    "cylinder of 15 mm radius, its line integrals exact. What is seen is the effect of the matrices alone; the surface "
    "errors of a real scan are larger for other reasons too.",
    "The manipulator is the virtual hexapod of study table2; 189 calibration centres are projected and given the "
    "paper's detection error, for both methods alike, at the paper's poses and at ours of study section6. The circular "
    "scan does not move it, and has exact matrices.",
    "Reconstruction by the paper's method: one iteration of SART with relaxation 0.8, here with views in golden order; "
    "the circular scan's shows the sequential order, with exact matrices. By our best: filtered back-projection, the "
    "ramp along the source's path, for both scans.",
    "The surface is found half way between the values inside and outside, radius by radius in three slices; each "
    "slice's centre and mean radius are removed, since object pose and grey level are not in question.",
)


def cylinder_integrals(
    P: Array,
    scanner: Scanner,
    *,
    radius: float = RADIUS,
    ends: Sequence[tuple[float, float]] = ((-HALF_HEIGHT, HALF_HEIGHT),),
) -> Array:
    """Line integrals (n_v, n_u) of upright cylinders about z in the view with matrix P (3, 4), pixel centres.

    ends: heights, mm, of the two end faces of each cylinder; they do not overlap.
    """
    inverse = np.linalg.inv(P[:, :3])
    s = -inverse @ P[:, 3]
    u, v = np.meshgrid(np.arange(scanner.n_u), np.arange(scanner.n_v))
    d = np.stack([u, v, np.ones_like(u)], axis=-1) @ inverse.T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    a, b = d[..., 0] ** 2 + d[..., 1] ** 2, d[..., 0] * s[0] + d[..., 1] * s[1]
    under = b**2 - a * (s[0] ** 2 + s[1] ** 2 - radius**2)
    met = under > 0
    a, b, slope, root = a[met], b[met], d[met][:, 2], np.sqrt(under[met])
    enter, leave = (-b - root) / a, (-b + root) / a
    length = np.zeros_like(a)
    for bottom, top in ends:
        with np.errstate(divide="ignore"):
            at = (bottom - s[2]) / slope, (top - s[2]) / slope
        length += np.maximum(np.minimum(leave, np.maximum(*at)) - np.maximum(enter, np.minimum(*at)), 0.0)
    image = np.zeros(met.shape)
    image[met] = ATTENUATION * length
    return image


def surface_deviation(volume: Volume) -> Array:
    """Radius less its mean (ANGLES,), um, over the angle: half-level crossings, mean of three slices, each slice's
    centre removed."""
    grid = volume.grid
    step = float(grid.spacing[0])
    phi = 2 * np.pi * np.arange(ANGLES) / ANGLES
    r = np.arange(RADIUS - 6 * step, RADIUS + 6 * step, step / 4)
    values = np.asarray(volume.values, dtype=np.float64)
    radii = []
    for z in (-HALF_HEIGHT / 2, 0.0, HALF_HEIGHT / 2):
        x = np.stack([np.full((ANGLES, r.size), z), np.outer(np.sin(phi), r), np.outer(np.cos(phi), r)])
        index = (x - grid.origin[::-1, None, None]) / grid.spacing[::-1, None, None]
        profile = map_coordinates(values, index, order=1)
        quarter = r.size // 4
        # Local: views in sequence leave other values on one side than on the other.
        level = (profile[:, :quarter].mean(axis=1) + profile[:, -quarter:].mean(axis=1)) / 2
        below = profile < level[:, None]
        if not below.any(axis=1).all() or below[:, 0].any():
            raise InputError(f"the volume shows no edge of the cylinder at z = {z:g} mm")
        k, rows = np.argmax(below, axis=1), np.arange(ANGLES)
        a, b = profile[rows, k - 1], profile[rows, k]
        radii.append(r[k - 1] + step / 4 * (a - level) / (a - b))
    spectrum = np.fft.rfft(np.mean(radii, axis=0))
    spectrum[:2] = 0.0
    return np.asarray(1e3 * np.fft.irfft(spectrum, ANGLES))


def periodic_part(deviation: Array) -> float:
    """Amplitude, um, of the tilt's seven periods in a deviation (ANGLES,)."""
    return float(2 * np.abs(np.fft.rfft(deviation)[PERIODS]) / len(deviation))


def cases_of(scale: Scale, seed: int) -> tuple[dict[str, tuple[Any, Any, Algorithm]], Scanner]:
    """Name -> (true matrices, those used, how it is reconstructed), and the binned scanner."""
    binning, views = PLAN[scale]
    run = ball_run(MAGNIFICATION, 3, seed, number=1)
    rng = np.random.default_rng(np.random.SeedSequence([seed, 12]))
    seen = projected(run, rng)
    ours = planned_run(MAGNIFICATION, seed, number=1)
    paper, best = rigid(run, seen), kinematic(ours, projected(ours, rng), MAGNIFICATION)
    scan, circle = scan_of(MAGNIFICATION, views), circular_scan(views)
    fine = run.scanner

    def true(poses: PoseSequence, T_MH: RigidTransform) -> ProjectionMatrices:
        P = eq5_matrices(fine, T_HT=run.T_HT, T_MH=T_MH, alpha=poses.alpha)
        return ProjectionMatrices(
            P=P, n_u=fine.n_u, n_v=fine.n_v, p_u=fine.p_u, p_v=fine.p_v, pose_id=poses.pose_id, scanner=fine
        ).binned(binning)

    tilted, round_ = true(scan, real_T_MH(scan, MAGNIFICATION)), true(circle, circle.T_MH)
    return {
        "circular scan": (round_, round_, FILTERED),
        "3D scan, paper's method": (tilted, projection_matrices(paper, scan, binning=binning), GOLDEN),
        "3D scan, our best": (tilted, projection_matrices(best, scan, binning=binning), FILTERED),
        "3D scan, true matrices": (tilted, tilted, FILTERED),
        "circular scan, sequential order": (round_, round_, SEQUENTIAL),
    }, fine.binned(binning)


def run(scale: Scale, seed: int, steps: Steps, progress: Progress) -> tuple[Any, Any, Any, Any]:
    """Rows, checks, figures and notes."""
    cases, scanner = cases_of(scale, seed)
    side = float(np.sqrt(scanner.p_u * scanner.p_v)) / scanner.magnification
    n, n_z = int(2 * (RADIUS + 3.0) / side), int(2 * (HALF_HEIGHT + 3.0) / side)
    grid = VoxelGrid(shape=(n_z, n, n), spacing=side)
    found = {}
    for k, (name, (P_true, P_used, how)) in enumerate(cases.items()):

        def surface(
            P_true: ProjectionMatrices = P_true, P_used: ProjectionMatrices = P_used, how: Algorithm = how
        ) -> dict[str, Any]:
            images = [cylinder_integrals(P, scanner).astype(np.float32) for P in P_true.P]
            volume = reconstruct(images, P_used, grid, images_are="line-integrals", engine="cpu", algorithm=how)
            return {"deviation": surface_deviation(volume)}

        found[name] = np.array(steps.of(f"surface-{k}", surface)["deviation"])
        progress(k + 1, len(cases))
    return rows_of(found), checks_of(found), (figure_of(found),), NOTES


def rows_of(found: dict[str, Array]) -> list[StudyRow]:
    """Largest deviation and the part with the tilt's period, of each volume."""
    circle, theirs, ours, true, sequential = found.values()
    return [
        StudyRow(
            group="3D scan",
            quantity="largest deviation of the surface",
            unit="um",
            source="sec. 6.3, fig. 12",
            printed=PRINTED_CYLINDER_UM,
            paper_method=float(np.abs(theirs).max()),
            best=float(np.abs(ours).max()),
        ),
        StudyRow(
            group="3D scan",
            quantity="part with seven periods a turn",
            unit="um",
            source="sec. 6.3, fig. 12",
            paper_method=periodic_part(theirs),
            best=periodic_part(ours),
            note="printed: periodic, no figure",
        ),
        StudyRow(
            group="3D scan",
            quantity="largest deviation with the true matrices",
            unit="um",
            best=float(np.abs(true).max()),
        ),
        StudyRow(
            group="3D scan",
            quantity="part with seven periods with the true matrices",
            unit="um",
            best=periodic_part(true),
        ),
        StudyRow(
            group="circular scan",
            quantity="largest deviation of the surface",
            unit="um",
            paper_method=float(np.abs(sequential).max()),
            best=float(np.abs(circle).max()),
            note="paper's method: SART in sequential order",
        ),
    ]


def checks_of(found: dict[str, Array]) -> list[StudyCheck]:
    """The pattern is there by the paper's method; by our best nothing of it comes from the matrices.  Where the 3D
    scan is the worse one, that is a check too."""
    circle, theirs, ours, true, sequential = found.values()
    spectrum = np.abs(np.fft.rfft(theirs))
    loudest = int(np.argmax(spectrum))
    return [
        StudyCheck(
            statement="by the paper's method the deviations repeat with the tilt's seven periods",
            found=f"the strongest part has {loudest} periods",
            holds=loudest % PERIODS == 0,
        ),
        check_below(
            "by our best the part with seven periods is within 1.2 x of what the true matrices give",
            periodic_part(ours) / periodic_part(true),
            1.2,
            "x",
        ),
        check_below(
            "by our best the surface is within 1.2 x of what the true matrices give (rms)",
            float(np.std(ours) / np.std(true)),
            1.2,
            "x",
        ),
        StudyCheck(
            statement="with the true matrices the 3D scan's surface deviates more than the circular one's (rms)",
            found=f"{np.std(true):.3g} against {np.std(circle):.3g} um",
            holds=bool(np.std(true) > np.std(circle)),
        ),
        StudyCheck(
            statement="one sweep of SART with the views in sequence bends the circular scan's surface, true matrices",
            found=f"{np.abs(sequential).max():.3g} um, by filtered back-projection {np.abs(circle).max():.3g} um",
            holds=bool(np.abs(sequential).max() > 1.5 * np.abs(circle).max()),
        ),
    ]


def figure_of(found: dict[str, Array]) -> Figure:
    """Deviations over the angle."""
    phi = 360.0 * np.arange(ANGLES) / ANGLES
    data = [
        {"type": "scatter", "mode": "lines", "name": name, "x": phi, "y": d, "line": {"color": colour, "width": 1.6}}
        for (name, d), colour in zip(found.items(), (ALERT, ORANGE, ACCENT), strict=False)
    ]
    return Figure(
        title="Surface of a cylinder",
        meaning="Radius less its mean by angle, um: SART by the paper's method, FDK by ours.",
        look_for="Seven waves by the paper's method; by our best no more than the true matrices leave.",
        data=data,
        layout=layout(xaxis=axis("angle / deg"), yaxis=axis("deviation / um")),
    )
