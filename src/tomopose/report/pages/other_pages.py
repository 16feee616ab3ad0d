"""Reports of what precedes and follows a calibration: detections alone, and the matrices of a scan."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tomopose.geometry.projection import ProjectionMatrices, ViewGeometry
from tomopose.observations import BallObservations
from tomopose.provenance import Provenance
from tomopose.report.figures.coverage_figures import scan_effect
from tomopose.report.figures.scene_figures import source_path
from tomopose.report.figures.thumbnails import Thumbnail
from tomopose.report.gather import MOST_DRAWN, MOST_LISTED, evenly, listed_words
from tomopose.report.page import (
    BAD,
    CARE,
    GOOD,
    Block,
    Figure,
    KeyFigure,
    Page,
    Pictures,
    Section,
    Table,
    Verdict,
    Words,
    render,
)
from tomopose.report.sections.provenance import provenance_section
from tomopose.report.style import ACCENT, ALERT, ORANGE, axis, layout
from tomopose.report.words import NOT_DETERMINABLE, NOT_GIVEN, number

MANY_LOST = 0.05
"""Share of images without a usable ball above which a run is doubtful."""


def observations_report(
    observations: BallObservations,
    *,
    thumbnails: Sequence[Thumbnail] = (),
    provenance: Provenance | None = None,
    title: str = "Detection report",
) -> str:
    """One offline HTML document about detections: where, how sure, which failed and why."""
    n, seen = len(observations), int(observations.seen.sum())
    lost = n - seen
    blocks: list[Block] = []
    if seen:
        blocks += [_positions(observations), _sigmas(observations)]
    blocks.append(
        Table(
            title="Not used",
            meaning="Images without a measured ball, and why." + listed_words(lost, "the first", "observations.csv"),
            columns=["pose", "image", "status"],
            rows=[
                [
                    observations.pose_id[k],
                    observations.image[k] if observations.image else "–",
                    _status(observations, k),
                ]
                for k in np.flatnonzero(~observations.seen)[:MOST_LISTED]
            ],
        )
        if lost
        else Words(title="Not used", paragraphs=["Every image gave a ball."])
    )
    if thumbnails:
        blocks.append(
            Pictures(
                title="Detections as pictures",
                meaning="Crops with the silhouette that was found (orange) and the projected centre (blue).",
                look_for="The line should follow the ball's rim all round.",
                thumbnails=thumbnails,
            )
        )
    return render(
        Page(
            title=title,
            subtitle=f"{n} images",
            verdict=_detection_verdict(n, seen),
            key_figures=_detection_keys(observations),
            sections=[
                Section(title="Detections", blocks=blocks),
                _all_rows(observations),
                provenance_section(provenance),
            ],
            footer="Written by tomopose.",
        )
    )


def _status(observations: BallObservations, k: int) -> str:
    return observations.status[k] if observations.status is not None else NOT_GIVEN


def _detection_verdict(n: int, seen: int) -> Verdict:
    if seen == 0:
        return Verdict(word="Nothing found", sentence=f"No ball was measured in any of {n} images.", tone=BAD)
    lost = n - seen
    if lost > MANY_LOST * n:
        return Verdict(word="Doubtful", sentence=f"{lost} of {n} images gave no usable ball.", tone=CARE)
    return Verdict(word="Measured", sentence=f"The ball was measured in {seen} of {n} images.", tone=GOOD)


def _detection_keys(observations: BallObservations) -> list[KeyFigure]:
    sigma = observations.sigma[observations.seen]
    snr = None if observations.snr is None else observations.snr[observations.seen]
    middle = NOT_GIVEN if snr is None or not np.isfinite(snr).any() else number(np.nanmedian(snr))
    return [
        KeyFigure(
            name="Images with a ball",
            value=f"{int(observations.seen.sum())} of {len(observations)}",
            note="The others are listed below, each with its reason.",
        ),
        KeyFigure(
            name="Standard uncertainty",
            note="Median of u and v, as the detection predicts it; 0.05 px and less is good.",
            value=f"{number(np.median(sigma))} px" if sigma.size else NOT_DETERMINABLE,
        ),
        KeyFigure(
            name="SNR",
            value=middle,
            note="Median of the ball's contrast over the noise; the higher, the smaller the uncertainty.",
        ),
    ]


def _drawn_words(drawn: int, n: int) -> str:
    """Says how many of n images a figure shows; "" where it shows all."""
    return "" if drawn == n else f" Drawn are {drawn} of {n}, evenly over the run."


def _positions(observations: BallObservations) -> Figure:
    used = observations.used
    shown = used.select(evenly(len(used), MOST_DRAWN))
    x = shown.x_D
    return Figure(
        title="Where the ball was seen",
        meaning="Projected ball centres on the detector." + _drawn_words(len(shown), len(used)),
        look_for="A regular plan gives a regular pattern; a point out of line is a wrong ball or a wrong pairing.",
        data=[
            {
                "type": "scatter",
                "mode": "markers",
                "x": x[:, 0],
                "y": x[:, 1],
                "text": shown.pose_id,
                "marker": {"size": 5.5, "color": ACCENT},
                "hovertemplate": "pose %{text}<br>%{x:.2f}, %{y:.2f} px<extra></extra>",
            }
        ],
        layout=layout(
            xaxis=axis("u / px", constrain="domain"),
            yaxis=axis("v / px", scaleanchor="x", scaleratio=1, constrain="domain"),
            showlegend=False,
        ),
        height=430,
        wide=False,
    )


def _sigmas(observations: BallObservations) -> Figure:
    sigma = np.where(observations.seen[:, None], observations.sigma, np.nan)
    shown = evenly(len(observations), MOST_DRAWN)
    return Figure(
        title="Standard uncertainty by image",
        meaning="Predicted standard uncertainty of the centre in u and v."
        + _drawn_words(len(shown), len(observations)),
        look_for="It should be level; a rising line is a failing exposure or a source that drifts out of focus.",
        data=[
            {
                "type": "scatter",
                "mode": "markers",
                "name": name,
                "x": shown + 1,
                "y": sigma[shown, k],
                "marker": {"size": 5, "color": colour},
                "text": [observations.pose_id[i] for i in shown],
                "hovertemplate": f"pose %{{text}}<br>{name} %{{y:.5f}} px<extra></extra>",
            }
            for k, (name, colour) in enumerate((("u", ACCENT), ("v", ORANGE)))
        ],
        layout=layout(xaxis=axis("image"), yaxis=axis("σ / px", rangemode="tozero")),
        height=430,
        wide=False,
    )


def _all_rows(observations: BallObservations) -> Section:
    sigma = observations.sigma
    worst_first = np.argsort(np.where(observations.seen, -sigma.max(axis=1), -np.inf), kind="stable")
    rows = [
        [
            observations.pose_id[k],
            f"{observations.x_D[k, 0]:.4f}",
            f"{observations.x_D[k, 1]:.4f}",
            number(sigma[k, 0]),
            number(sigma[k, 1]),
            _status(observations, k),
        ]
        for k in np.sort(worst_first[:MOST_LISTED])
    ]
    which = "those without a ball and the most uncertain"
    return Section(
        title="All images",
        blocks=[
            Table(
                title="Rows",
                meaning="A click on a column's head sorts by it."
                + listed_words(len(observations), which, "observations.csv"),
                folded=True,
                numeric=(1, 2, 3, 4),
                columns=["pose", "u / px", "v / px", "σ_u / px", "σ_v / px", "status"],
                rows=rows,
            )
        ],
    )


def _source_distance(view: ViewGeometry) -> Figure:
    """Distance and height of the source, view by view."""
    return Figure(
        title="Distance of the source by view",
        meaning="Distance of the source from the origin of W, and its height above the plane of the table.",
        look_for="A tilted scan changes the height smoothly; a jump is a missing or exchanged pose.",
        data=[
            {
                "type": "scatter",
                "mode": "lines",
                "name": "distance",
                "x": np.arange(1, len(view.source) + 1),
                "y": np.linalg.norm(view.source, axis=1),
                "line": {"color": ACCENT, "width": 1.8},
            },
            {
                "type": "scatter",
                "mode": "lines",
                "name": "height (right scale)",
                "x": np.arange(1, len(view.source) + 1),
                "y": view.source[:, 2],
                "yaxis": "y2",
                "line": {"color": ALERT, "width": 1.8},
            },
        ],
        layout=layout(
            xaxis=axis("view"),
            yaxis=axis("distance / mm"),
            yaxis2=axis("height / mm", overlaying="y", side="right", showgrid=False),
        ),
        height=340,
    )


def matrices_report(
    matrices: ProjectionMatrices,
    *,
    exports: Sequence[str] = (),
    provenance: Provenance | None = None,
    title: str = "Scan geometry report",
) -> str:
    """One offline HTML document about projection matrices: the source's path, distances by view, expected effect.

    exports: names of the formats written from them.
    """
    view = matrices.decompose()
    effect = scan_effect(matrices)
    blocks: list[Block] = [source_path(matrices)]
    blocks.append(
        effect
        if effect is not None
        else Words(
            title="Expected effect on the scan",
            paragraphs=[f"{NOT_DETERMINABLE}: the matrices hold no uncertainty."],
            wide=False,
        )
    )
    blocks.append(_source_distance(view))
    if exports:
        blocks.append(Words(title="Written for", items=exports))
    return render(
        Page(
            title=title,
            subtitle=f"{len(matrices)} views, detector {matrices.n_u} × {matrices.n_v} pixels of {matrices.p_u:g} × "
            f"{matrices.p_v:g} mm",
            key_figures=[
                KeyFigure(name="Views", value=str(len(matrices)), note="One matrix each."),
                KeyFigure(
                    name="d_SD",
                    value=f"{np.median(view.d_SD):.3f} mm",
                    note="Source to detector, median; the same in every view of a usual scan.",
                ),
                KeyFigure(
                    name="Source to object",
                    value=f"{np.median(np.linalg.norm(view.source, axis=1)):.3f} mm",
                    note="To the origin of W, median: with d_SD it gives the magnification.",
                ),
                KeyFigure(
                    name="Height of the source",
                    value=f"{view.source[:, 2].min():.1f} … {view.source[:, 2].max():.1f} mm",
                    note="Along z of W; a circular scan keeps one height, a 3D scan does not.",
                ),
            ],
            sections=[Section(title="The scan", blocks=blocks), provenance_section(provenance)],
            footer="Written by tomopose. P is that of eq. (5): points of W, object at home, to pixels.",
        )
    )
