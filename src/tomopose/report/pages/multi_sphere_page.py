"""The report of a multi-sphere calibration: verdict, residuals and balls by view, the manipulator's errors, the
standard."""

from __future__ import annotations

import numpy as np

from tomopose.calibration.arrangements.multi_sphere.result import MultiSphereCalibration
from tomopose.report.figures.coverage_figures import scan_effect
from tomopose.report.figures.scene_figures import source_path
from tomopose.report.page import BAD, CARE, GOOD, Block, Figure, KeyFigure, Page, Section, Table, Verdict, Words, render
from tomopose.report.sections.provenance import provenance_section
from tomopose.report.style import ACCENT, ALERT, ORANGE, axis, layout
from tomopose.report.words import number

TONES = {"trustworthy": GOOD, "doubtful": CARE, "rejected": BAD}
MANY = 40


def multi_sphere_report(result: MultiSphereCalibration, *, title: str = "Multi-sphere calibration") -> str:
    """One offline HTML document."""
    n, lost = len(result.pose_id), len(result.lost)
    matrices = result.matrices()
    effect = scan_effect(matrices)
    path: list[Block] = [source_path(matrices), *([] if effect is None else [effect])]
    if result.manipulator_errors is not None:
        path.append(_manipulator(result.manipulator_errors))
    sentence = f"The pose of the standard was found in {n} of {n + lost} views."
    return render(
        Page(
            title=title,
            subtitle=f"{n + lost} views of a standard of {len(result.standard)} balls",
            verdict=Verdict(
                word=result.verdict.capitalize(),
                sentence=sentence,
                tone=TONES[result.verdict],
                reasons=[f"{f.words}: {f.remedy}" if f.remedy else f.words for f in result.checks],
            ),
            key_figures=[
                KeyFigure(
                    name="d_rms",
                    value=f"{number(result.d_rms)} px",
                    note="All balls of all views: what the path leaves.",
                ),
                KeyFigure(
                    name="chi2/dof",
                    value=number(result.chi2_dof),
                    note="1: as the uncertainties say; far above it something is not modelled.",
                ),
                KeyFigure(
                    name="Balls a view",
                    value=f"{result.balls_used.min()} to {result.balls_used.max()}",
                    note="Three determine a pose; more show a wrong one.",
                ),
                KeyFigure(
                    name="Uncertainty of a view",
                    value=f"{number(np.sqrt(np.mean(np.square(np.asarray(matrices.points_sigma)))))} px",
                    note="1 sigma, rms over the field of view",
                ),
            ],
            sections=[
                Section(title="Views", blocks=[_residuals(result), _not_used(result)]),
                Section(title="The path", blocks=path),
                Section(title="What all views share", blocks=[_scanner(result), _standard(result)]),
                provenance_section(result.provenance),
            ],
            footer="Written by tomopose. Matrices hold for a scan that repeats this path with the same poses; the "
            "manipulator's repeatability enters their uncertainty where it is stated.",
        )
    )


def _residuals(result: MultiSphereCalibration) -> Figure:
    view = np.arange(1, len(result.pose_id) + 1)
    return Figure(
        title="Residuals and balls by view",
        meaning="rms distance of measured and calculated centres, px, and how many balls determine the pose.",
        look_for="No view far above the others; few balls make a pose uncertain.",
        data=[
            {"type": "scatter", "mode": "lines", "name": "d, rms", "x": view, "y": result.d,
             "text": list(result.pose_id), "line": {"color": ACCENT, "width": 1.6}},
            {"type": "scatter", "mode": "lines", "name": "balls (right scale)", "x": view, "y": result.balls_used,
             "yaxis": "y2", "line": {"color": ALERT, "width": 1.2}},
        ],
        layout=layout(
            xaxis=axis("view"),
            yaxis=axis("d / px", rangemode="tozero"),
            yaxis2=axis("balls", overlaying="y", side="right", showgrid=False, rangemode="tozero"),
        ),
    )  # fmt: skip


def _manipulator(errors: np.ndarray) -> Figure:
    view = np.arange(1, len(errors) + 1)
    turn, shift = 1e6 * errors[:, :3], 1e3 * errors[:, 3:]
    data = [
        {"type": "scatter", "mode": "lines", "name": f"turn about {c} / µrad", "x": view, "y": turn[:, k],
         "line": {"color": colour, "width": 1.4}}
        for k, (c, colour) in enumerate(zip("xyz", (ACCENT, ALERT, ORANGE), strict=True))
    ] + [
        {"type": "scatter", "mode": "lines", "name": f"shift along {c} / µm (right scale)", "x": view,
         "y": shift[:, k], "yaxis": "y2", "line": {"color": colour, "width": 1.4, "dash": "dot"}}
        for k, (c, colour) in enumerate(zip("xyz", (ACCENT, ALERT, ORANGE), strict=True))
    ]  # fmt: skip
    return Figure(
        title="What the manipulator does beside its table",
        meaning="Found pose less the one of the pose table under the best rigid mount, along W, at the standard's "
        "middle.",
        look_for="A pattern that repeats with the path is a systematic error, which these matrices hold; scatter is "
        "not repeatable.",
        data=data,
        layout=layout(
            xaxis=axis("view"),
            yaxis=axis("turn / µrad"),
            yaxis2=axis("shift / µm", overlaying="y", side="right", showgrid=False),
        ),
    )


def _not_used(result: MultiSphereCalibration) -> Block:
    rows = [[name, why] for name, why in result.lost.items()]
    rows += [[name, "; ".join(words)] for name, words in result.left_out.items()]
    if not rows:
        return Words(title="Not used", paragraphs=["Every ball of every view was used."])
    return Table(
        title="Not used",
        meaning="Views without a pose, and balls that were left out of a view.",
        columns=["view", "why"],
        rows=rows,
        folded=len(rows) > MANY,
    )


def _scanner(result: MultiSphereCalibration) -> Block:
    m, names = len(result.standard), result.path.shared.scanner_names
    sigma = np.sqrt(np.diag(result.path.shared.covariance))[3 * m :]
    prior = {a.name: (a.sigma, a.unit, a.source) for a in result.assumed}
    if not names:
        return Words(title="Scanner", paragraphs=["All values of the scanner count as exact."])
    return Table(
        title="Scanner's values",
        meaning="Estimated along the path with the stated or assumed uncertainty as prior.",
        columns=["value", "given", "prior sigma", "from", "estimated", "sigma", "unit"],
        numeric=(1, 2, 4, 5),
        rows=[
            [name, f"{getattr(result.given, name):.7g}", number(prior[name][0]), prior[name][2],
             f"{getattr(result.scanner, name):.7g}", number(s), prior[name][1]]
            for name, s in zip(names, sigma, strict=True)
        ],
    )  # fmt: skip


def _standard(result: MultiSphereCalibration) -> Table:
    moved = 1e3 * (result.path.centres - result.standard.centres)
    sigma = 1e3 * np.sqrt(np.diag(result.path.shared.covariance))[: 3 * len(moved)].reshape(-1, 3)
    stated = "assumed: nobody stated it" if result.standard.sigma is None else "stated"
    used = np.zeros(len(moved), dtype=int)
    for v in result.views:
        used[v.ball] += 1
    return Table(
        title="The standard's balls",
        meaning=f"Estimated less calibrated coordinates; the prior uncertainty is {stated}.",
        columns=["ball", "views", "dx / µm", "dy / µm", "dz / µm", "sigma / µm", "prior sigma / µm"],
        numeric=(1, 2, 3, 4, 5, 6),
        rows=[
            [name, str(used[i]), *(f"{v:.2f}" for v in moved[i]), f"{sigma[i].max():.2f}",
             f"{1e3 * result.standard.sigma_mm[i]:.2f}"]
            for i, name in enumerate(result.standard.names)
        ],
        folded=len(moved) > MANY,
    )  # fmt: skip
