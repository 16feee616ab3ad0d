"""A stack of discs on both paths: the faces that a circular scan misses, made visible (Defrise's phantom, sec. 6.3).

Upright discs have nothing but faces in the planes that a circular path meets badly.  Their line integrals are known in
closed form and the matrices are exact, so that only the path differs between the volumes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices
from tomopose.geometry.scanner import Scanner
from tomopose.manipulator.poses import PoseSequence
from tomopose.reconstruction.run import reconstruct
from tomopose.report.page import Figure
from tomopose.report.style import ACCENT, ALERT, SEQUENTIAL, axis, colour_bar, layout
from tomopose.studies.cylinder import ATTENUATION, cylinder_integrals
from tomopose.studies.demo import demo_setup, paper_scanner
from tomopose.studies.parts.result import Scale, StudyCheck, StudyRow, check_below
from tomopose.units import Array
from tomopose.volume import VoxelGrid

MAGNIFICATION = 5.3
RADIUS, THICKNESS, PITCH, DISCS = 14.0, 1.5, 3.0, 17
"""mm.  At the outermost disc the planes that are missed lean by up to 5 degrees: over the discs' diameter that is more
than a gap."""
PLAN = {"small": (8, 126), "paper": (4, 504)}
"""Scale -> detector binning, views."""
AWAY = 0.36
"""Distance, mm, from a face within which a sharp edge may ring."""
SUBROWS = (-1 / 3, 0.0, 1 / 3)
"""A pixel is the mean of rays at these parts of its height: single rays along a face see it or see it not."""

COLOURS = {"circular scan": ALERT, "3D scan": ACCENT}


def heights() -> Array:
    """(DISCS,) z of the discs' middles, mm, about the source's plane."""
    return np.asarray(PITCH * (np.arange(DISCS) - (DISCS - 1) / 2), dtype=np.float64)


def disc_integrals(P: Array, scanner: Scanner, faces: Sequence[tuple[float, float]]) -> np.ndarray:
    """Image (n_v, n_u), float32, of the view with matrix P (3, 4)."""
    rows = []
    for part in SUBROWS:
        lowered = P.copy()
        lowered[1] -= part * P[2]
        rows.append(cylinder_integrals(lowered, scanner, radius=RADIUS, ends=faces))
    result: np.ndarray = np.mean(rows, axis=0).astype(np.float32)
    return result


def disc_profile(scan: PoseSequence, scale: Scale) -> dict[str, Any]:
    """z (n,), value on the discs' axis (mean of a core of 4 mm radius) over the true one, and the section y = 0."""
    binning, _ = PLAN[scale]
    fine = paper_scanner(MAGNIFICATION)
    alpha = scan.alpha
    P = eq5_matrices(fine, T_HT=demo_setup(paper=True).T_HT, T_MH=scan.T_MH, alpha=alpha)
    matrices = ProjectionMatrices(
        P=P, n_u=fine.n_u, n_v=fine.n_v, p_u=fine.p_u, p_v=fine.p_v, pose_id=scan.pose_id, scanner=fine
    ).binned(binning)
    scanner = fine.binned(binning)
    faces = [(z - THICKNESS / 2, z + THICKNESS / 2) for z in heights()]
    images = [disc_integrals(p, scanner, faces) for p in matrices.P]
    side = float(np.sqrt(scanner.p_u * scanner.p_v)) / scanner.magnification
    half_height = heights()[-1] + PITCH / 2 + 2.0
    n, n_z = int(2 * (RADIUS + 3.0) / side), int(2 * half_height / side)
    grid = VoxelGrid(shape=(n_z, n, n), spacing=side)
    volume = reconstruct(
        images,
        matrices,
        grid,
        images_are="line-integrals",
        engine="cpu",
        algorithm="fdk",
        consistency="off",
    )
    x = grid.origin[0] + side * np.arange(n)
    core = np.hypot(x[:, None], x[None, :]) < 4.0
    values = np.asarray(volume.values, dtype=np.float64) / ATTENUATION
    z = grid.origin[2] + side * np.arange(n_z)
    return {"z": z, "x": x, "axis": values[:, core].mean(axis=1), "section": values[:, n // 2]}


def wrongness(profile: Mapping[str, object]) -> Array:
    """(DISCS,) rms of value less truth around each disc, within 10 mm of the axis, farther than AWAY from any face:
    what has been smeared into discs and gaps."""
    z, x, section = (np.asarray(profile[name]) for name in ("z", "x", "section"))
    faces = (heights()[:, None] + [-THICKNESS / 2, THICKNESS / 2]).ravel()
    clear = np.abs(z[:, None] - faces).min(axis=1) > AWAY
    inside = np.abs(z[:, None] - heights()).min(axis=1) < THICKNESS / 2
    error = section[:, np.abs(x) < 10.0] - inside[:, None]
    return np.array([np.sqrt(np.mean(error[clear & (np.abs(z - h) < PITCH / 2)] ** 2)) for h in heights()])


def rows_and_checks(found: Mapping[str, Mapping[str, object]]) -> tuple[list[StudyRow], list[StudyCheck]]:
    """What is smeared around the outermost third of the discs and around the middle three, for both paths."""
    order = np.argsort(np.abs(heights()))
    rms = {name: wrongness(profile) for name, profile in found.items()}
    part = {
        where: {name: float(np.sqrt(np.mean(r[chosen] ** 2))) for name, r in rms.items()}
        for where, chosen in (("middle three discs", order[:3]), ("outermost six discs", order[-6:]))
    }
    group = f"M {MAGNIFICATION}, stack of discs"
    rows = [
        StudyRow(
            group=group,
            quantity=f"{name}: error around the {where}, rms",
            unit="1",
            best=value,
            note="1: the discs' value",
        )
        for where, values in part.items()
        for name, value in values.items()
    ]
    outer, middle = part["outermost six discs"], part["middle three discs"]
    return rows, [
        StudyCheck(
            statement="on the circular path flat faces are smeared with height",
            found=f"error {middle['circular scan']:.3g} in the middle, {outer['circular scan']:.3g} outside",
            holds=outer["circular scan"] > 3 * middle["circular scan"],
        ),
        check_below(
            "the 3D scan leaves less than half of that error outside",
            outer["3D scan"] / outer["circular scan"],
            0.5,
            "",
        ),
        StudyCheck(
            statement="in the middle, where a circle is exact, the circle is the better path",
            found=f"error {middle['circular scan']:.3g} against {middle['3D scan']:.3g}",
            holds=middle["circular scan"] < middle["3D scan"],
        ),
    ]


def figures(found: Mapping[str, Mapping[str, object]]) -> list[Figure]:
    """Profiles along the axis, and a section through each volume."""
    lines = [
        {
            "type": "scatter",
            "mode": "lines",
            "name": name,
            "x": p["z"],
            "y": p["axis"],
            "line": {"color": COLOURS[name], "width": 1.6},
        }
        for name, p in found.items()
    ]
    profile = Figure(
        title="A stack of discs along its axis",
        meaning="Value over that of the discs, mean of a core of 4 mm radius.",
        look_for="Discs and gaps as flat outside as in the middle; on the circular path they are not.",
        data=lines,
        layout=layout(xaxis=axis("z / mm"), yaxis=axis("value")),
    )
    sections = [
        Figure(
            title=f"Stack of discs, {name}",
            meaning="Section y = 0; 1 is the discs' attenuation.",
            look_for="Flat faces with sharp edges; smeared ones are cone-beam artefacts.",
            data=[
                {
                    "type": "heatmap",
                    "x": p["x"],
                    "y": p["z"],
                    "z": p["section"],
                    "zmin": 0.0,
                    "zmax": 1.2,
                    "colorscale": SEQUENTIAL,
                    "colorbar": colour_bar("value"),
                }
            ],
            layout=layout(xaxis=axis("x / mm"), yaxis=axis("z / mm")),
            wide=False,
            height=440,
        )
        for name, p in found.items()
    ]
    return [profile, *sections]
