"""CTSimU scenarios as scanners: the geometry of frame 0, as a reconstruction knows it."""

from __future__ import annotations

import numpy as np

from tomopose.exports.ctsimu import from_ctsimu
from tomopose.exports.panel import Given
from tomopose.io.foreign.foreign_file import ForeignFile
from tomopose.io.foreign.kind import Kind
from tomopose.io.foreign.scanner_draft import ScannerDraft, sensible
from tomopose.reading import parse_json


def recognise(file: ForeignFile) -> bool:
    """JSON that calls itself a CTSimU scenario."""
    return file.is_text and '"CTSimU Scenario"' in file.text


def read(file: ForeignFile) -> ScannerDraft:
    """Distances, pitch, size and piercing point of a scenario."""
    content = parse_json(file.text, file.path)
    matrices = from_ctsimu(content, Given(folder=file.path.parent), where=str(file.path))
    g = matrices.decompose()
    d_SR = float(np.einsum("i,i->", -g.source[0], g.normal[0]))
    moved = [k for k, v in (("d_SD", g.d_SD), ("u_0", g.u_0), ("v_0", g.v_0)) if np.ptp(v) > 1e-6]
    return ScannerDraft(
        path=file.path,
        kind="a CTSimU scenario",
        maker="CTSimU",
        values=sensible(
            {
                "d_SD_mm": float(g.d_SD[0]),
                "d_SR_mm": d_SR,
                "p_u_mm": matrices.p_u,
                "p_v_mm": matrices.p_v,
                "n_u_px": float(matrices.n_u),
                "n_v_px": float(matrices.n_v),
                "u_0_px": float(g.u_0[0]),
                "v_0_px": float(g.v_0[0]),
            },
            str(file.path),
        ),
        notes=tuple(f"{k} changes during the scan; that of the first frame is taken" for k in moved),
        image_rows="top-first",
    )


KIND = Kind(
    name="ctsimu",
    maker="CTSimU",
    what="a scenario (JSON)",
    recognise=recognise,
    read_scanner=read,
    holds_geometry=True,
)
