"""Completeness: which planes through the object the source's path meets, circular against tilted (sec. 6.3, ref. [22]),
and what becomes of faces in planes that are missed.

For a circle of radius d_SR and a point on its axis at height h the answer is known: a plane misses the circle where its
normal lies closer than atan(|h| / d_SR) to the axis, so that the share met is cos(atan(|h| / d_SR)).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tomopose.report.page import Figure
from tomopose.report.style import SEQUENTIAL, axis, colour_bar, layout
from tomopose.studies.demo import demo_setup, paper_scanner
from tomopose.studies.figure9 import OBJECTS, WAVES, path_of
from tomopose.studies.parts import tuy_discs
from tomopose.studies.parts.result import Progress, Scale, StudyCheck, StudyRow, check_below
from tomopose.studies.parts.steps import Steps
from tomopose.trajectory.completeness import tuy_completeness
from tomopose.trajectory.scan import circular_scan, tilted_scan
from tomopose.units import Array

HALF_SIZE = {5.3: (15.0, 30.0), 2.7: (45.0, 40.0)}
"""Radius and half height, mm, of the upright cylinder that holds the object."""
PAPERS = 5.3
"""The paper's sentence is about the specimen's path."""
VIEWS = {"small": 252, "paper": 900}
PLANES = {"small": 2000, "paper": 20000}
POINTS = {"small": (7, 9), "paper": (15, 21)}

TITLE = "Completeness of circular and tilted paths"
QUESTION = (
    "Does the specimen's tilted scan see every plane through it, as the paper says, and the circular one not; and the "
    "standard's?"
)
NOTES = (
    "The paper says of the multi-feature specimen's scan at M 5.3 that cone-beam artefacts at the threaded hole are "
    "present for the circular path alone, since the 3D path satisfies the sufficiency condition; it prints no figure, "
    "and says nothing of the standard's path at M 2.7, which is looked at here as well. Here the share of planes is "
    "counted that meet the path, in the object's upright middle section.",
    "The condition is about untruncated views and a continuous path. It says nothing about noise, absorption or "
    "errors of the geometry.",
    "The stack of discs has exact line integrals and matrices, no noise, and is reconstructed by filtered "
    "back-projection along the source's path, on both paths: what differs is the path alone.",
    "A plane that is missed leaves the faces that lie in it blurred: on the circular path these are faces nearly "
    "parallel to the source's plane, the more the higher they are.",
)


def section(radius: float, half_height: float, n: tuple[int, int]) -> tuple[Array, Array, Array]:
    """x (a,), z (b,) and the points (a b, 3), mm, of the section y = 0, z slowest."""
    x, z = np.linspace(-radius, radius, n[0]), np.linspace(-half_height, half_height, n[1])
    X, Z = np.meshgrid(x, z)
    return x, z, np.column_stack([X.ravel(), np.zeros(X.size), Z.ravel()])


def share_map(title: str, x: Array, z: Array, share: Array, lowest: float) -> Figure:
    """Share of planes met over the section."""
    return Figure(
        title=title,
        meaning="Share of all planes through a point that meet the source's path; 1 is complete.",
        look_for="The circular path loses planes with height; the tilted one should be 1 throughout.",
        data=[
            {
                "type": "heatmap",
                "x": x,
                "y": z,
                "z": share,
                "zmin": lowest,
                "zmax": 1.0,
                "colorscale": SEQUENTIAL,
                "colorbar": colour_bar("share"),
            }
        ],
        layout=layout(xaxis=axis("x / mm"), yaxis=axis("z / mm")),
        wide=False,
        height=440,
    )


def run(scale: Scale, seed: int, steps: Steps, progress: Progress) -> tuple[Any, Any, Any, Any]:
    """Rows, checks, figures and notes; nothing here is random."""
    rows: list[StudyRow] = []
    checks: list[StudyCheck] = []
    figures = []
    for k, (magnification, (radius, half_height)) in enumerate(HALF_SIZE.items()):
        group = f"M {magnification}, {OBJECTS[magnification]}"
        x, z, points = section(radius, half_height, POINTS[scale])
        views, planes = VIEWS[scale], PLANES[scale]
        scans = {
            "circular scan": circular_scan(views),
            "3D scan": tilted_scan(views, WAVES[magnification], R_HT=demo_setup(paper=True).T_HT.R),
        }
        share = {}
        for name, scan in scans.items():
            path = path_of(scan, magnification).source
            share[name] = tuy_completeness(path, points, n_planes=planes).share.reshape(len(z), len(x))
            printed = 1.0 if (name, magnification) == ("3D scan", 5.3) else None
            rows += [
                StudyRow(
                    group=group,
                    quantity=f"{name}, {what} share",
                    unit="1",
                    best=float(value),
                    printed=printed,
                    source="sec. 6.3, ref. [22]" if printed else "",
                )
                for what, value in (("mean", share[name].mean()), ("smallest", share[name].min()))
            ]
        lowest = float(min(s.min() for s in share.values()))
        figures += [share_map(f"{name}, {group}", x, z, s, lowest) for name, s in share.items()]
        d_SR = paper_scanner(magnification).d_SR
        known = np.cos(np.arctan(np.abs(z) / d_SR))
        off = float(np.abs(share["circular scan"][:, len(x) // 2] - known).max())
        checks += [
            check_below(
                f"on the axis the circular scan's share is the known one (largest difference, {group})", off, 2e-3, ""
            ),
            StudyCheck(
                statement=f"the 3D scan meets every plane through the object, as the paper says ({group})"
                if magnification == PAPERS
                else f"the 3D scan misses a fifth of what the circular one misses at most ({group})",
                found=f"smallest share {share['3D scan'].min():.5f}",
                holds=bool(
                    share["3D scan"].min() == 1
                    if magnification == PAPERS
                    else 1 - share["3D scan"].min() <= (1 - share["circular scan"].min()) / 5
                ),
            ),
            StudyCheck(
                statement=f"the circular scan does not ({group})",
                found=f"smallest share {share['circular scan'].min():.5f}",
                holds=bool(share["circular scan"].min() < 1),
            ),
        ]
        progress(k + 1, len(HALF_SIZE) + 2)
    _, views = tuy_discs.PLAN[scale]
    discs = {}
    for k, (name, scan) in enumerate(
        (
            ("circular scan", circular_scan(views)),
            ("3D scan", tilted_scan(views, WAVES[tuy_discs.MAGNIFICATION], R_HT=demo_setup(paper=True).T_HT.R)),
        )
    ):
        discs[name] = steps.of(f"discs-{k}", lambda scan=scan: tuy_discs.disc_profile(scan, scale))  # type: ignore[misc]
        progress(len(HALF_SIZE) + k + 1, len(HALF_SIZE) + 2)
    more_rows, more_checks = tuy_discs.rows_and_checks(discs)
    rows += more_rows
    checks += more_checks
    figures += tuy_discs.figures(discs)
    return rows, checks, figures, NOTES
