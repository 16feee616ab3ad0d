"""What the poses of a calibration determine, and what they do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tomopose.calibration.checks.conventions.hypothesis import WORDS, Hypothesis
from tomopose.calibration.result import Calibration
from tomopose.report.figures.coverage_figures import correlation_map, singular_values
from tomopose.report.page import Block, Section, Table, Words
from tomopose.report.words import NOT_GIVEN, cell, heading

EXCLUDED = ("worse", "unfit")
HYPOTHESIS_COLUMNS = ("words", "verdict", "d_rms_px", "delta_chi2", "cure")


def observability_section(calibration: Calibration) -> Section:
    """Unobservable directions, correlations, singular values, alternative conventions."""
    seen = calibration.observability
    blocks: list[Block] = []
    if seen.unobservable:
        blocks.append(Words(title="Directions that these poses cannot determine", items=seen.unobservable, wide=False))
        lead = "Some directions of the parameters are not held by these poses."
    else:
        blocks.append(
            Words(
                title="Directions that these poses cannot determine",
                paragraphs=["None among the parameters solved for."],
                wide=False,
            )
        )
        lead = "All parameters solved for are held by these poses."
    if seen.notes:
        blocks.append(Words(title="What is taken as known, and what would help", items=seen.notes, wide=False))
    else:
        blocks.append(Words(title="What would help", paragraphs=["Nothing was proposed."], wide=False))
    alike = sum(1 for h in calibration.hypotheses if h.outcome == "same")
    if alike:
        lead += f" Alternative conventions that they cannot distinguish from the declared one: {alike}, see below."
    blocks += [correlation_map(calibration), singular_values(calibration)]
    blocks += _hypotheses(calibration.hypotheses)
    return Section(title="What the poses determine", lead=lead, blocks=blocks)


def _hypotheses(hypotheses: Sequence[Hypothesis]) -> list[Block]:
    """Alternatives that are still possible, open to view; those that the data exclude, folded away."""
    if not hypotheses:
        return [Words(title="Alternative conventions", paragraphs=[f"Hypotheses tried: {NOT_GIVEN}."])]
    excluded = [h for h in hypotheses if h.outcome in EXCLUDED]
    possible = [h for h in hypotheses if h.outcome not in EXCLUDED]
    tables = []
    for title, rows, words in (
        (
            "Alternative conventions",
            possible,
            "Other readings of the same data (orders, signs, flips, pairing), fitted the same way. These poses cannot "
            "distinguish one that fits about as well, and one of the two ruins the scan.",
        ),
        ("Alternative conventions that the data exclude", excluded, "They fit significantly worse."),
    ):
        if rows:
            tables.append(
                Table(
                    title=title,
                    meaning=words,
                    columns=[heading(c) for c in HYPOTHESIS_COLUMNS],
                    rows=[
                        [h.words, WORDS.get(h.outcome, h.outcome), cell(h.d_rms), _difference(h.delta), cell(h.remedy)]
                        for h in rows
                    ],
                    folded=rows is excluded,
                )
            )
    return list(tables)


def _difference(delta: float) -> str:
    """Differences of chi2 need no more than a decimal: what is below one is nothing."""
    if np.isfinite(delta) and abs(delta) < 1e4:
        return f"{delta:.1f}".replace("-0.0", "0.0")
    return cell(delta)
