"""The border through which every reader goes: what comes from a file is checked here before anything trusts it."""

from tomopose.reading.border import reader, reading, require_file, require_inside
from tomopose.reading.memory import available_bytes, require_plausible
from tomopose.reading.text import parse_json, parse_toml, read_bytes, read_text

__all__ = [
    "available_bytes",
    "parse_json",
    "parse_toml",
    "read_bytes",
    "read_text",
    "reader",
    "reading",
    "require_file",
    "require_inside",
    "require_plausible",
]
