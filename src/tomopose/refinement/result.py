"""What a refinement returns, and refined.json."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tomopose.files import require_absent, write_json
from tomopose.geometry.projection import ProjectionMatrices
from tomopose.provenance import Provenance
from tomopose.refinement.judge import Verdict
from tomopose.units import Array
from tomopose.values import Column, Tabular, require_types, value
from tomopose.volume import Volume

COLUMNS = ("t_x_mm", "t_y_mm", "t_z_mm", "w_x_deg", "w_y_deg", "w_z_deg")


@value
class Refinement(Tabular):
    """Each view's geometry, corrected from the scan's own images.

    matrices:     refined, in the input's order; the input's own where the verdict is not "refined".  `points_sigma` is
                  that of the geometry returned.
    corrections:  (n, 6) motion of the object in each view about the input geometry: translation, mm, then rotation
                  vector, rad, about the middle of the grid, in W.  What was found, also where it was not applied.
    sigma:        (n, 6) their standard uncertainties, the volume unknown.
    verdict:      "refined", "unchanged" (nothing gained) or "undetermined" (the images do not determine a correction).
    reasons:      why, as sentences.
    unobservable: what the images cannot show, as sentences.
    residual_before, residual_after: (n,) rms residual of each view relative to its line integrals, with the input's and
                  with the refined geometry.
    held_out_before, held_out_after: (n,) the same over pixels kept out of the fit, in units of their noise.
    iterations, converged: steps of the joint fit, and whether it ended in a minimum.
    prior_sizes:  name of each part of the prior -> its size by the evidence, relative to what was stated.
    outliers:     indices of views whose correction stands out from the others (a jump).
    held_out_gain: mean gain over those pixels, in its own standard errors; chi: rms residual over noise of the fit.
    widening:     how much larger the uncertainty is than with the volume known.
    halves_px:    standard uncertainty of a view, px per coordinate, by two disjoint sets of views refined apart; NaN
                  for fewer than 16 views.  stated_px: the stated one beside it, rms over views and points.
    volume_before, volume: volumes under both geometries, at the resolution of the comparison.
    edge_blur_before_mm, edge_blur_after_mm: standard deviation, mm, of the blurred step in their mean profile across
                  the edges, on the same lines; NaN where no edge can be measured.
    """

    matrices: ProjectionMatrices
    corrections: Array
    sigma: Array
    verdict: str
    reasons: tuple[str, ...]
    unobservable: tuple[str, ...]
    residual_before: Array
    residual_after: Array
    held_out_before: Array
    held_out_after: Array
    held_out_gain: float
    iterations: int
    converged: bool
    chi: float
    prior_sizes: Mapping[str, float]
    outliers: tuple[int, ...] = ()
    widening: float = 1.0
    halves_px: float = float("nan")
    stated_px: float = float("nan")
    volume_before: Volume | None = None
    volume: Volume | None = None
    edge_blur_before_mm: float = float("nan")
    edge_blur_after_mm: float = float("nan")
    balls: Array | None = None
    balls_misfit: float = float("nan")
    provenance: Provenance | None = None

    def __len__(self) -> int:
        return len(self.matrices)

    @property
    def pose_id(self) -> tuple[str, ...]:
        """Names of the views."""
        return self.matrices.pose_id

    @property
    def trustworthy(self) -> bool:
        """False where the images do not determine the correction; the matrices are the input's then."""
        return Verdict(self.verdict).trustworthy

    @property
    def dof(self) -> int:
        """Numbers estimated for a view."""
        return 6

    def columns(self) -> dict[str, Column]:
        """Corrections, mm and degrees, with their standard uncertainties, and the residuals."""
        unit = np.array([1.0] * 3 + [180 / np.pi] * 3)
        columns: dict[str, Column] = {name: self.corrections[:, k] * unit[k] for k, name in enumerate(COLUMNS)}
        columns |= {f"sigma_{name}": self.sigma[:, k] * unit[k] for k, name in enumerate(COLUMNS)}
        return columns | {"residual_before": self.residual_before, "residual_after": self.residual_after}

    def row_names(self) -> tuple[str, ...]:
        """The views' pose ids."""
        return self.pose_id


@require_types
def write_refinement(path: str | Path, refinement: Refinement, *, force: bool = False) -> None:
    """Write refined.json (`tomopose/refined/1`).  FileError if the file exists and `force` is not given.

    Corrections are motions of the object in W about the middle of the grid: mm, and rotation vectors in degrees.
    """
    write_json(require_absent(path, force=force), "refined", document(refinement))


def document(r: Refinement) -> dict[str, object]:
    """The content of refined.json."""
    degrees = np.array([1.0] * 3 + [180 / np.pi] * 3)
    views = [
        {
            "pose_id": r.pose_id[j],
            "shift_mm": r.corrections[j, :3],
            "turn_deg": r.corrections[j, 3:] * degrees[3:],
            "sigma_shift_mm": r.sigma[j, :3],
            "sigma_turn_deg": r.sigma[j, 3:] * degrees[3:],
            "residual_before": r.residual_before[j],
            "residual_after": r.residual_after[j],
        }
        for j in range(len(r))
    ]
    return {
        "verdict": r.verdict,
        "trustworthy": r.trustworthy,
        "reasons": list(r.reasons),
        "unobservable": list(r.unobservable),
        "dof": r.dof,
        "iterations": r.iterations,
        "converged": r.converged,
        "residual_over_noise": r.chi,
        "held_out_gain": r.held_out_gain,
        "prior_sizes": dict(r.prior_sizes),
        "sigma_over_volume_known": r.widening,
        "halves_px": r.halves_px,
        "stated_px": r.stated_px,
        "edge_blur_before_mm": r.edge_blur_before_mm,
        "edge_blur_after_mm": r.edge_blur_after_mm,
        "balls": None if r.balls is None else [{"place_mm": x} for x in r.balls],
        "balls_residual_over_sigma": r.balls_misfit,
        "jumps": [r.pose_id[j] for j in r.outliers],
        "views": views,
        "provenance": None if r.provenance is None else r.provenance.to_json(),
    }
