"""The certificate as a digital calibration certificate: XML of PTB's DCC schema 3.2.1 with quantities in D-SI 2.1.0.

The schema (https://ptb.de/dcc/v3.2.1/dcc.xsd) is under the LGPL and therefore not part of this package; whoever has it
checks a file with `xmlschema-validate --schema dcc.xsd FILE`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from xml.etree import ElementTree as ET

from tomopose.errors import InputError
from tomopose.report.certificate.content import COVERAGE, DECISION_RULE, METHOD, NOT_STATED, Certificate, K, Line

DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"
VERSION = "3.2.1"
UNITS: Mapping[str, str] = {
    "mm": r"\milli\metre",
    "rad": r"\radian",
    "": r"\one",
    "1": r"\one",
    "px": r"\one",
    "deg": r"\degree",
    "um": r"\micro\metre",
}
"""Units of D-SI; pixels are counted, which the quantity's name says."""
COUNTRY, LANGUAGE = "country", "language"
"""Keys of [certificates] in tomopose.toml: ISO 3166 and ISO 639 codes."""


def _add(parent: ET.Element, name: str, text: str | None = None, *, space: str = DCC) -> ET.Element:
    element = ET.SubElement(parent, f"{{{space}}}{name}")
    element.text = None if text is None else _words(text)
    return element


def _words(text: str) -> str:
    """Text as XML 1.0 can hold it, with single blanks."""
    return " ".join("".join(c for c in text if c.isprintable() or c.isspace()).split()) or NOT_STATED


def _content(parent: ET.Element, name: str, *texts: str) -> ET.Element:
    element = _add(parent, name)
    for text in texts:
        _add(element, "content", text)
    return element


def _contact(parent: ET.Element, name: str, words: str, *, place: bool, country: str) -> None:
    contact = _add(parent, name)
    _content(contact, "name", words)
    if place:
        _add(_add(contact, "location"), "countryCode", country)


def _identification(parent: ET.Element, issuer: str, value: str, words: str) -> None:
    one = _add(parent, "identification")
    _add(one, "issuer", issuer)
    _add(one, "value", value)
    _content(one, "name", words)


def _number(x: float) -> str:
    return f"{x:.12g}"


def _quantity(parent: ET.Element, line: Line) -> None:
    quantity = _add(parent, "quantity")
    pixels = " (pixels)" if line.unit == "px" else ""
    _content(quantity, "name", f"{line.name}{pixels}" + (f": {line.meaning}" if line.meaning else ""))
    if line.unit not in UNITS:
        raise InputError(f"{line.name} has the unit {line.unit!r}, for which no D-SI unit is known here")
    if not math.isfinite(line.value):
        _content(quantity, "noQuantity", "not determinable")
        return
    real = _add(quantity, "real", space=SI)
    _add(real, "value", _number(line.value), space=SI)
    _add(real, "unit", UNITS[line.unit], space=SI)
    if math.isfinite(line.U) and line.U > 0:
        expanded = _add(real, "expandedUnc", space=SI)
        _add(expanded, "uncertainty", _number(line.U), space=SI)
        _add(expanded, "coverageFactor", _number(K), space=SI)
        _add(expanded, "coverageProbability", _number(COVERAGE), space=SI)
        _add(expanded, "distribution", "normal", space=SI)


def _administrative(root: ET.Element, c: Certificate) -> None:
    country, language = c.facts.get(COUNTRY, "ZZ").upper(), c.facts.get(LANGUAGE, "en").lower()
    for code, length in ((country, 2), (language, 2)):
        if not (len(code) == length and code.isascii() and code.isalpha()):
            raise InputError(f"[certificates] of the project file: {code!r} is not a code of two letters")
    data = _add(root, "administrativeData")
    software = _add(_add(data, "dccSoftware"), "software")
    _content(software, "name", "tomopose")
    _add(software, "release", c.version)
    core = _add(data, "coreData")
    _add(core, "countryCodeISO3166_1", country)
    _add(core, "usedLangCodeISO639_1", language)
    _add(core, "mandatoryLangCodeISO639_1", language)
    _add(core, "uniqueIdentifier", c.number)
    if c.facts.get("order"):
        _identification(_add(core, "identifications"), "customer", c.facts["order"], "order")
    day = c.date[:10]
    _add(core, "beginPerformanceDate", day)
    _add(core, "endPerformanceDate", day)
    _add(core, "performanceLocation", "laboratory")
    item = _add(_add(data, "items"), "item")
    _content(item, "name", c.fact("machine"))
    _identification(_add(item, "identifications"), "manufacturer", c.fact("serial"), "serial number")
    laboratory = _add(data, "calibrationLaboratory")
    _contact(laboratory, "contact", c.facts.get("laboratory", NOT_STATED), place=True, country=country)
    person = _add(_add(data, "respPersons"), "respPerson")
    _contact(person, "person", c.fact("operator"), place=False, country=country)
    _add(person, "mainSigner", "true")
    _contact(data, "customer", c.fact("customer"), place=True, country=country)
    statements = _add(data, "statements")
    for name, words in (("decision rule", DECISION_RULE), ("valid until", c.fact("valid_until"))):
        statement = _add(statements, "statement")
        _content(statement, "name", name)
        _content(statement, "declaration", words)


def _results(root: ET.Element, c: Certificate) -> None:
    results = _add(root, "measurementResults")
    result = _add(results, "measurementResult")
    _content(result, "name", "Pose calibration")
    _content(_add(_add(result, "usedMethods"), "usedMethod"), "name", METHOD)
    equipment = _add(_add(result, "measuringEquipments"), "measuringEquipment")
    _content(equipment, "name", "Ball")
    _identification(_add(equipment, "identifications"), "other", c.fact("ball_certificate"), "certificate")
    conditions = _add(result, "influenceConditions")
    condition = _add(conditions, "influenceCondition")
    _content(condition, "name", "Temperature")
    _temperature(_add(condition, "data"), c.facts.get("temperature_C", ""))
    if c.assumed:
        condition = _add(conditions, "influenceCondition")
        _content(condition, "name", "Assumed, not measured")
        _content(_add(condition, "data"), "text", *c.assumed)
    one = _add(_add(result, "results"), "result")
    _content(one, "name", "Values with U (k = 2)")
    data = _add(one, "data")
    for line in c.results:
        _quantity(data, line)
    _content(data, "text", f"Verdict of the method's own checks: {c.verdict}.", *c.reasons)


def _temperature(data: ET.Element, text: str) -> None:
    """The temperature as a quantity where it is a number, else as it was written."""
    quantity = _add(data, "quantity")
    _content(quantity, "name", "temperature")
    try:
        value = float(text)
    except ValueError:
        _content(quantity, "noQuantity", text or NOT_STATED)
        return
    real = _add(quantity, "real", space=SI)
    _add(real, "value", _number(value), space=SI)
    _add(real, "unit", r"\degreecelsius", space=SI)


def dcc_xml(certificate: Certificate) -> str:
    """The certificate as DCC XML.  InputError where a code or a unit of it has no place in the schema."""
    ET.register_namespace("dcc", DCC)
    ET.register_namespace("si", SI)
    root = ET.Element(f"{{{DCC}}}digitalCalibrationCertificate", {"schemaVersion": VERSION})
    _administrative(root, certificate)
    _results(root, certificate)
    ET.indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
