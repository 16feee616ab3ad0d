"""The certificate as one page of HTML, to be printed and signed."""

from __future__ import annotations

import math

from tomopose.report.certificate.content import DECISION_RULE, HEADER, METHOD, NOT_STATED, Certificate
from tomopose.report.page import CARE, GOOD, Page, Section, Table, Verdict, Words, render
from tomopose.report.words import number


def certificate_report(certificate: Certificate, *, title: str = "Calibration certificate") -> str:
    """One offline HTML document.  What the project file does not state is named as not stated."""
    c = certificate
    good = c.verdict == "trustworthy"
    verdict = Verdict(
        word=c.verdict.capitalize(),
        sentence="No check gave a reason for doubt." if good else "Use it only after what is named here is settled.",
        tone=GOOD if good else CARE,
        reasons=c.reasons,
    )
    extra = [k for k in c.facts if k not in HEADER]
    header = Table(
        title="What was calibrated",
        meaning="",
        columns=["field", "entry"],
        rows=[
            *([words, c.fact(key)] for key, words in HEADER.items()),
            *([key.replace("_", " "), c.facts[key]] for key in extra),
            ["Date (UTC)", c.date],
        ],
        wide=False,
    )
    results = Table(
        title="Results",
        meaning="U is the expanded uncertainty, k = 2, which covers about 95 % under a normal law.",
        columns=["quantity", "what it is", "value", "U (k = 2)", "unit"],
        rows=[
            [x.name, x.meaning or "–", _digits(x.value, x.U), number(x.U) if math.isfinite(x.U) else NOT_STATED, x.unit]
            for x in c.results
        ],
        numeric=(2, 3),
    )
    inputs = Table(
        title="Inputs, by their SHA-256",
        meaning="",
        columns=["file", "SHA-256"],
        rows=[[name, digest] for name, digest in c.inputs.items()],
    )
    words = [
        f"Method: {METHOD}",
        f"Residual: {number(c.d_rms_px)} px, {number(c.d_rms_um)} µm at the ball, of {c.poses} poses.",
        f"Decision rule: {DECISION_RULE}",
        "The results are valid at the time and under the conditions of the measurement. Angles are those of "
        "R = R_x R_y R_z; T_HT takes coordinates of the manipulator's base H to those of the table T.",
    ]
    signature = ["Place and date: ______________________________", "Signature: ______________________________"]
    return render(
        Page(
            title=title,
            subtitle=f"Number {c.number}",
            verdict=verdict,
            sections=[
                Section(
                    title="Object and conditions",
                    blocks=[header, Words(title="Signature", paragraphs=signature, wide=False)],
                ),
                Section(title="Results", blocks=[results]),
                Section(
                    title="Assumed, not measured",
                    blocks=[Words(items=list(c.assumed) or ["nothing"])],
                ),
                Section(title="Statements", blocks=[Words(paragraphs=words), inputs]),
            ],
            footer=f"Written by tomopose {c.version}. This page is no accreditation; whoever signs it vouches for it.",
        )
    )


def _digits(value: float, U: float) -> str:
    """A value to two figures of its uncertainty."""
    if not (math.isfinite(U) and U > 0):
        return f"{value:.6g}"
    return f"{value:.{max(0, 1 - math.floor(math.log10(U)))}f}"
