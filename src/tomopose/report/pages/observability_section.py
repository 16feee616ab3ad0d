"""What the poses of a calibration can tell, and what they cannot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tomopose.calibration.result import Calibration
from tomopose.report.figures.coverage_figures import correlation_map, singular_values
from tomopose.report.page import Block, Section, Table, Words
from tomopose.report.words import NOT_GIVEN, cell, heading

HYPOTHESIS_COLUMNS = ("words", "verdict", "d_rms_px", "delta_chi2", "cure")


def observability_section(calibration: Calibration) -> Section:
    """Unobservable directions, correlations, singular values, rivals."""
    seen = calibration.observability
    blocks: list[Block] = []
    if seen.unobservable:
        blocks.append(Words(title="Directions that these poses cannot tell", items=seen.unobservable, wide=False))
        lead = "Some directions of the parameters are not held by these poses."
    else:
        blocks.append(
            Words(
                title="Directions that these poses cannot tell",
                paragraphs=["None among the parameters solved for."],
                wide=False,
            )
        )
        lead = "All parameters solved for are held by these poses."
    if seen.notes:
        blocks.append(Words(title="What is taken as known, and what would help", items=seen.notes, wide=False))
    else:
        blocks.append(Words(title="What would help", paragraphs=["Nothing was proposed."], wide=False))
    alike = sum(1 for row in calibration.hypotheses if str(row.get("verdict", "")).startswith("cannot be told apart"))
    if alike:
        lead += f" Rival conventions that they cannot tell from the declared one: {alike}, see below."
    blocks += [correlation_map(calibration), singular_values(calibration)]
    blocks += _hypotheses(calibration.hypotheses)
    return Section(title="What the poses can tell", lead=lead, blocks=blocks)


def _hypotheses(hypotheses: Sequence[Mapping[str, Any]]) -> list[Block]:
    """Rivals that are still possible, open to view; those that the data exclude, folded away."""
    if not hypotheses:
        return [Words(title="Rival conventions", paragraphs=[f"Hypotheses tried: {NOT_GIVEN}."])]
    present = {key for row in hypotheses for key in row}
    columns = [c for c in HYPOTHESIS_COLUMNS if c in present] or sorted(present)
    excluded = [row for row in hypotheses if row.get("verdict") == "excluded"]
    possible = [row for row in hypotheses if row.get("verdict") != "excluded"]
    tables = []
    for title, rows, words in (
        (
            "Rival conventions",
            possible,
            "Other readings of the same data (orders, signs, flips, pairing), fitted the same way. One that fits about "
            "as well cannot be told apart with these poses, and one of the two ruins the scan.",
        ),
        ("Rival conventions that the data exclude", excluded, "They fit significantly worse."),
    ):
        if rows:
            tables.append(
                Table(
                    title=title,
                    meaning=words,
                    columns=[heading(c) for c in columns],
                    rows=[[_hypothesis_cell(c, row.get(c)) for c in columns] for row in rows],
                    folded=rows is excluded,
                )
            )
    return list(tables)


def _hypothesis_cell(column: str, value: Any) -> str:
    """Differences of chi2 need no more than a decimal: what is below one is nothing."""
    if column == "delta_chi2" and value is not None and abs(value) < 1e4:
        return f"{value:.1f}".replace("-0.0", "0.0")
    return cell(value)
