"""XML of foreign files: read without entities, and with a sentence where it is not whole."""

from __future__ import annotations

import xml.etree.ElementTree as ET

from tomopose.errors import FileError, InputError
from tomopose.io.foreign.foreign_file import ForeignFile


def parse_xml(file: ForeignFile) -> ET.Element:
    """The root element.  InputError for entities, FileError where the text is no whole XML."""
    if "<!ENTITY" in file.text:
        raise InputError(f"{file.path} defines XML entities; a measuring file needs none, it is not read")
    try:
        return ET.fromstring(file.text)
    except ET.ParseError as error:
        raise FileError(f"{file.path} is not whole XML: {error}; is the file truncated?", path=file.path) from error


def local_name(element: ET.Element) -> str:
    """The element's name without its namespace."""
    return str(element.tag).rpartition("}")[2]


def child_text(element: ET.Element, *path: str) -> str | None:
    """The text of a descendant, step by step by local names; None where a step is missing."""
    for step in path:
        found = next((c for c in element if local_name(c) == step), None)
        if found is None:
            return None
        element = found
    return (element.text or "").strip()
