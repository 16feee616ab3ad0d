"""The acceptance protocol of a multi-sphere standard as one page: limits, test values, decisions, definitions."""

from __future__ import annotations

import math
from collections.abc import Mapping

from tomopose.measurement.acceptance.protocol import DEFINITIONS, GUIDELINE, Protocol, ProtocolLine
from tomopose.measurement.conformity import Decision
from tomopose.report.page import BAD, CARE, GOOD, Block, Page, Section, Table, Verdict, Words, render
from tomopose.report.sections.provenance import provenance_section
from tomopose.units import MICROMETRES_PER_MM

HEADER: Mapping[str, str] = {
    "machine": "instrument",
    "standard": "standard",
    "certificate": "certificate of the standard",
    "operator": "operator",
    "place": "place",
}
NOT_STATED = "not stated"
MANY = 40


def protocol_report(protocol: Protocol, *, title: str = "Acceptance protocol") -> str:
    """One offline HTML document: the protocol of one volume."""
    held = [q for q in DEFINITIONS if protocol.of(q)]
    details: list[Block] = [
        Table(
            title=f"{quantity}: all test values",
            meaning=_sentence(DEFINITIONS[quantity][0]),
            columns=["of", "value / mm", "reference / mm", "test value / µm", "U (k = 2) / µm", "MPE / µm", "decision"],
            numeric=(1, 2, 3, 4, 5),
            rows=[_cells(x) for x in protocol.of(quantity)],
            folded=len(protocol.of(quantity)) > MANY,
        )
        for quantity in held
    ]
    return render(
        Page(
            title=title,
            subtitle=f"Multi-sphere standard after {GUIDELINE}: {protocol.volume}",
            verdict=_verdict(protocol, held),
            sections=[
                Section(title="Test", blocks=[_header(protocol), _summary(protocol, held), _informative(protocol)]),
                Section(title="Remarks", blocks=[Words(items=list(protocol.remarks))]),
                Section(title="Test values", blocks=details),
                provenance_section(protocol.provenance),
            ],
            footer="Written by tomopose. The uncertainty of a test value is that of the standard and the temperature "
            "(ISO 14253-5), k = 2; decisions after ISO 14253-1.",
        )
    )


def _verdict(protocol: Protocol, held: list[str]) -> Verdict:
    decisions = {q: protocol.decision(q) for q in held}
    judged = {q: d for q, d in decisions.items() if d is not None}
    free = [q for q in held if q not in judged]
    rest = f" Without a limit: {', '.join(free)}." if free else ""
    if not judged:
        return Verdict(word="Measured", sentence="No limits were given, so nothing is judged.", tone=CARE)
    for decision, word, tone in (
        (Decision.NOT_CONFORMING, "Not conforming", BAD),
        (Decision.NOT_DECIDABLE, "Not decidable", CARE),
    ):
        which = [q for q, d in judged.items() if d is decision]
        if which:
            return Verdict(word=word, sentence=f"{', '.join(which)}: {decision.value}.{rest}", tone=tone)
    return Verdict(word="Conforming", sentence=f"{', '.join(judged)} conform to the stated limits.{rest}", tone=GOOD)


def _header(protocol: Protocol) -> Table:
    rows = [[words, protocol.header.get(key) or NOT_STATED] for key, words in HEADER.items()]
    return Table(title="Instrument and standard", meaning="As the plan states them.", columns=["", ""], rows=rows)


def _summary(protocol: Protocol, held: list[str]) -> Table:
    rows = []
    for quantity in held:
        words, own = DEFINITIONS[quantity]
        worst, decision = protocol.worst(quantity), protocol.decision(quantity)
        if worst is not None:
            source = GUIDELINE if own else "this package, from quantities of the guideline"
            judged = "no limit" if decision is None else decision.value
            cells = [quantity, str(len(protocol.of(quantity))), worst.name, *_cells(worst)[3:6], judged]
            rows.append([*cells, words, source])
    return Table(
        title="Summary",
        meaning="The test value that comes nearest to its limit, or exceeds it most; the largest one without a limit.",
        columns=[
            "quantity",
            "test values",
            "worst",
            "test value / µm",
            "U (k = 2) / µm",
            "MPE / µm",
            "decision",
            "definition",
            "definition of",
        ],
        numeric=(1, 3, 4, 5),
        rows=rows,
    )


def _informative(protocol: Protocol) -> Table:
    return Table(
        title="For information",
        meaning="Form of whole surfaces: it grows with noise and with the number of points, and has no limit here.",
        columns=["quantity", "value / µm"],
        numeric=(1,),
        rows=[[k, f"{v * MICROMETRES_PER_MM:.2f}"] for k, v in protocol.informative.items()],
    )


def _cells(x: ProtocolLine) -> list[str]:
    def um(value: float, words: str, sign: str = "") -> str:
        return f"{value * MICROMETRES_PER_MM:{sign}.2f}" if math.isfinite(value) else words

    return [
        x.name,
        f"{x.value:.5f}",
        f"{x.reference:.5f}" if math.isfinite(x.reference) else "–",
        um(x.test_value, "–", "+"),
        um(x.U, NOT_STATED),
        um(x.mpe, "none"),
        "–" if x.decision is None else x.decision.value,
    ]


def _sentence(words: str) -> str:
    return words[0].upper() + words[1:] + "."
