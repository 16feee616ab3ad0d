"""What made a result, as the last section of each report."""

from __future__ import annotations

from collections.abc import Mapping

from tomopose.provenance import MEASUREMENT, Provenance
from tomopose.report.page import Block, Section, Table, Words
from tomopose.report.words import NOT_GIVEN, cell


def provenance_section(provenance: Provenance | None) -> Section:
    """Version, time, arguments, dependencies, and the inputs by their SHA-256."""
    if provenance is None:
        return Section(title="Provenance", blocks=[Words(paragraphs=[f"Provenance: {NOT_GIVEN}."])])
    seed = "none" if provenance.seed is None else str(provenance.seed)
    facts = [
        ["tomopose", provenance.version],
        ["time (UTC)", provenance.time_utc or NOT_GIVEN],
        ["platform", provenance.platform or NOT_GIVEN],
        ["seed", seed],
        *[[name, version] for name, version in provenance.dependencies.items()],
        *[[f"argument {name}", cell(value)] for name, value in provenance.arguments.items() if name != MEASUREMENT],
    ]
    blocks: list[Block] = [Table(title="Made by", meaning="", columns=["what", "value"], rows=facts)]
    said = provenance.arguments.get(MEASUREMENT)
    if isinstance(said, Mapping) and said:
        blocks.insert(
            0,
            Table(
                title="Measurement",
                meaning="What the project file says of machine, operator and certificates.",
                columns=["what", "value"],
                rows=[[str(name).replace("_", " "), cell(value)] for name, value in said.items()],
            ),
        )
    if provenance.inputs:
        blocks.append(
            Table(
                title="Inputs",
                meaning="SHA-256 of each file that was read.",
                columns=["file", "SHA-256"],
                rows=[[name, digest] for name, digest in provenance.inputs.items()],
                folded=len(provenance.inputs) > 12,
            )
        )
    return Section(title="Provenance", lead="What this result was made from, and by what.", blocks=blocks)
