"""The certificate: what it says of a calibration, as a page and as DCC XML."""

from __future__ import annotations

import dataclasses
import os
import re
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from tomopose.errors import EngineMissingError, InputError
from tomopose.report.certificate.content import certificate_of
from tomopose.report.certificate.dcc import dcc_xml
from tomopose.report.certificate.page import certificate_report
from tomopose.report.printing import write_pdf

NS = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
FACTS = {
    "machine": "Scanner <3>", "serial": "0815", "operator": "N. Sato", "ball_certificate": "D-K-1",
    "temperature_C": "20.3",
    "valid_until": "2027-01-31", "customer": "Customer A", "order": "17", "room": "B 1", "country": "JP",
}  # fmt: skip


@pytest.fixture
def certificate(sample):
    calibration, _, _ = sample()
    return calibration, certificate_of(calibration, FACTS)


def test_the_page_holds_every_field_and_a_line_to_sign(certificate):
    _, content = certificate
    html = certificate_report(content)
    for words in ("Scanner &lt;3&gt;", "0815", "N. Sato", "D-K-1", "20.3", "2027-01-31", "Customer A", "17", "B 1"):
        assert f">{words}</td>" in html
    assert "Signature: ____" in html
    assert "Decision rule" in html
    assert content.number in html
    assert "k = 2" in html


def test_what_nobody_stated_is_named_as_not_stated(sample):
    calibration, _, _ = sample()
    html = certificate_report(certificate_of(calibration))
    rows = re.findall(r'<tr role="row"><td[^>]*>(.*?)</td><td[^>]*>(.*?)</td></tr>', html)
    assert dict(rows)["Serial number"] == "not stated"
    assert dict(rows)["Certificate of the ball"] == "not stated"


def test_results_are_values_with_twice_their_standard_uncertainty(certificate):
    calibration, content = certificate
    assert [x.name for x in content.results] == [p.name for p in calibration.parameters]
    np.testing.assert_allclose([x.U for x in content.results], [2 * p.u for p in calibration.parameters])


def test_the_xml_holds_the_same_numbers_in_si(certificate):
    calibration, content = certificate
    root = ET.fromstring(dcc_xml(content).split("\n", 1)[1])
    assert root.get("schemaVersion") == "3.2.1"
    quantities = root.findall(".//dcc:result/dcc:data/dcc:quantity", NS)
    assert len(quantities) == len(calibration.parameters)
    for q, p in zip(quantities, calibration.parameters, strict=True):
        assert q.find("dcc:name/dcc:content", NS).text.startswith(p.name)
        assert float(q.find("si:real/si:value", NS).text) == pytest.approx(p.value, rel=1e-11)
        assert float(q.find("si:real/si:expandedUnc/si:uncertainty", NS).text) == pytest.approx(2 * p.u, rel=1e-11)
        unit = {"rad": r"\radian", "mm": r"\milli\metre"}[p.unit]
        assert q.find("si:real/si:unit", NS).text == unit
    assert root.find(".//dcc:coreData/dcc:countryCodeISO3166_1", NS).text == "JP"
    assert root.find(".//dcc:influenceCondition//si:value", NS).text == "20.3"
    assert root.find(".//dcc:item/dcc:name/dcc:content", NS).text == "Scanner <3>"


def test_the_xml_keeps_to_the_schema(certificate):
    """PTB's schema is under another licence and not part of the repository: TOMOPOSE_DCC_XSD names it where it is."""
    _, content = certificate
    text = dcc_xml(content)
    order = [e.tag.split("}")[1] for e in ET.fromstring(text.split("\n", 1)[1])]
    assert order == ["administrativeData", "measurementResults"]
    schema = os.environ.get("TOMOPOSE_DCC_XSD")
    if schema:
        import xmlschema

        xmlschema.XMLSchema(schema).validate(text.split("\n", 1)[1])
    core = ET.fromstring(text.split("\n", 1)[1]).find(".//dcc:coreData", NS)
    assert [e.tag.split("}")[1] for e in core] == [
        "countryCodeISO3166_1", "usedLangCodeISO639_1", "mandatoryLangCodeISO639_1", "uniqueIdentifier",
        "identifications",
        "beginPerformanceDate", "endPerformanceDate", "performanceLocation",
    ]  # fmt: skip


def test_the_same_result_has_the_same_number_and_another_one_another(certificate):
    calibration, content = certificate
    assert certificate_of(calibration, {}).number == content.number
    first = calibration.parameters[0]
    other = dataclasses.replace(
        calibration, parameters=(dataclasses.replace(first, value=first.value + 1e-9), *calibration.parameters[1:])
    )
    assert certificate_of(other, FACTS).number != content.number


def test_a_rejected_calibration_is_not_certified(sample):
    calibration, _, _ = sample(verdict="rejected")
    with pytest.raises(InputError, match="rejected calibration is not certified"):
        certificate_of(calibration, FACTS)


def test_a_country_that_is_no_code_is_refused(certificate):
    calibration, _ = certificate
    with pytest.raises(InputError, match="two letters"):
        dcc_xml(certificate_of(calibration, {**FACTS, "country": "Japan"}))


def test_what_cannot_be_determined_has_no_number(certificate):
    calibration, _ = certificate
    blind = tuple(dataclasses.replace(p, u=float("nan")) for p in calibration.parameters)
    text = dcc_xml(certificate_of(dataclasses.replace(calibration, parameters=blind), FACTS))
    assert "expandedUnc" not in text
    assert "nan" not in re.sub(r"<dcc:content>.*?</dcc:content>", "", text)


@pytest.mark.slow
@pytest.mark.browser
def test_a_report_is_printed_as_pdf(certificate, tmp_path):
    from browser import chromium_path

    chromium_path()
    _, content = certificate
    write_pdf(tmp_path / "c.pdf", certificate_report(content))
    data = (tmp_path / "c.pdf").read_bytes()
    assert data.startswith(b"%PDF")
    assert data.rstrip().endswith(b"%%EOF")
    assert len(data) > 20_000


def test_without_a_browser_the_error_says_what_to_install(certificate, tmp_path, monkeypatch):
    monkeypatch.setattr("tomopose.report.printing.shutil.which", lambda name: None)
    with pytest.raises(EngineMissingError, match="PDF needs a Chromium"):
        write_pdf(Path(tmp_path / "c.pdf"), "<p>x</p>")
    assert list(tmp_path.iterdir()) == []
