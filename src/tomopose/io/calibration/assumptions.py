"""What was assumed, what it does to a scan, and what explains the residuals, as calibration.json holds them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tomopose.calibration.checks.score_tests.ranking import Explanation
from tomopose.calibration.model.assumed import Assumed
from tomopose.calibration.model.budget import Halves, ScanBudget, budget_words
from tomopose.calibration.model.unseen import Unseen, unseen_unit
from tomopose.calibration.result import Calibration
from tomopose.calibration.rigid.contradiction import Contradicted
from tomopose.io.calibration.checks_blocks import number
from tomopose.io.numbers_json import decode_array, encode


def document(cal: Calibration) -> dict[str, Any]:
    """The keys assumed, unseen, explanations, contradicted, scan_uncertainty and halves."""
    unseen = cal.unseen
    stated = [{"name": a.name, "sigma": encode(a.sigma), "unit": a.unit, "from": a.source} for a in cal.assumed]
    if unseen is not None:
        # one list for the reader; the gains that belong to these are under "unseen"
        stated += [
            {"name": name, "sigma": encode(float(s)), "unit": unseen_unit(name), "from": "default"}
            for name, s in zip(unseen.names, unseen.sigma, strict=True)
        ]
    return {
        "assumed": stated,
        "assumed_values": {a.name: encode(a.value) for a in cal.assumed if a.value is not None},
        "unseen": None if unseen is None else {"names": list(unseen.names), "gain": encode(np.asarray(unseen.gain))},
        "explanations": [e.to_json() for e in cal.explanations],
        "contradicted": [{"name": c.name, "stated": encode(c.stated), "off": encode(c.off)} for c in cal.contradicted],
        "scan_uncertainty": None if cal.budget is None else _budget(cal.budget, cal),
        "halves": None if cal.halves is None else _halves(cal.halves),
    }


def _halves(h: Halves) -> dict[str, Any]:
    return {
        "rms_px": encode(h.rms_px),
        "stated_px": encode(h.stated_px),
        "p": encode(h.p),
        "x_D_px": encode(h.x_D),
        "difference_px": encode(h.difference),
        "sigma_px": encode(h.sigma),
    }


def _halves_from(document: Mapping[str, Any] | None) -> Halves | None:
    if document is None:
        return None
    k = len(document["x_D_px"])
    x_D, difference, sigma = (decode_array(document[name], k, 2) for name in ("x_D_px", "difference_px", "sigma_px"))
    return Halves(
        x_D=x_D,
        difference=difference,
        sigma=sigma,
        rms_px=number(document["rms_px"]),
        stated_px=number(document["stated_px"]),
        p=number(document["p"]),
    )


def _budget(b: ScanBudget, cal: Calibration) -> dict[str, Any]:
    return {
        "px": encode(b.total),
        "measured_px": encode(b.measured),
        "shares_px": {name: encode(px) for name, px in b.shares},
        "two_table_angles_px": b.two_angles,
        "tilted": b.tilted,
        "words": budget_words(b, cal.assumed),
    }


def from_document(document: Mapping[str, Any], m: int) -> dict[str, Any]:
    """The fields of a Calibration with m coordinates; a file without them has none of it."""
    unseen, budget = document.get("unseen"), document.get("scan_uncertainty")
    rows = {a["name"]: a for a in document["assumed"]}
    values = document.get("assumed_values", {})
    names = () if unseen is None else tuple(unseen["names"])
    return {
        "assumed": tuple(
            Assumed(
                name=a["name"],
                value=number(values[a["name"]]) if a["name"] in values else None,
                sigma=number(a["sigma"]),
                unit=a["unit"],
                source=a["from"],
            )
            for a in rows.values()
            if a["name"] not in names
        ),
        "unseen": None
        if unseen is None
        else Unseen(
            names=names,
            sigma=np.array([number(rows[n]["sigma"]) for n in names]),
            gain=decode_array(unseen["gain"], m, len(names)),
        ),
        "explanations": tuple(
            Explanation(
                name=e["name"],
                words=e["words"],
                evidence=number(e["evidence"]),
                share=number(e["share"]),
                size=np.asarray(e["size"], dtype=np.float64),
                kind=e["kind"],
                at=e["at"],
                also=tuple(e["also"]),
                predicts=bool(e["predicts"]),
            )
            for e in document.get("explanations", ())
        ),
        "contradicted": tuple(
            Contradicted(name=c["name"], stated=number(c["stated"]), off=number(c["off"]))
            for c in document.get("contradicted", ())
        ),
        "halves": _halves_from(document.get("halves")),
        "budget": None
        if budget is None
        else ScanBudget(
            total=number(budget["px"]),
            measured=number(budget["measured_px"]),
            shares=tuple((name, number(px)) for name, px in budget["shares_px"].items()),
            two_angles=None if budget["two_table_angles_px"] is None else float(budget["two_table_angles_px"]),
            tilted=bool(budget.get("tilted", True)),
        ),
    }
