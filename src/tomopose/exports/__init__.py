"""Geometry for and from other packages: one foreign format a file, both directions.

`to_NAME` makes what the format holds, `from_NAME` takes it back; `export` writes a folder of all of them and
`read_geometry` reads any of them.
"""

from __future__ import annotations

from tomopose.exports.folder import FORMATS, Exported, export
from tomopose.exports.reading import read_geometry

__all__ = ["FORMATS", "Exported", "export", "read_geometry"]
