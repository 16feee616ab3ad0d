"""Reconstruction from any projection matrices: `reconstruct` and what it is made of."""

from tomopose.reconstruction.consistency import Consistency, check_consistency
from tomopose.reconstruction.line_integrals import (
    Correction,
    LineIntegrals,
    beam_hardening_polynomial,
    ring_offset,
)
from tomopose.reconstruction.path import SourcePath, source_path
from tomopose.reconstruction.run import PAPER, reconstruct

__all__ = [
    "PAPER",
    "Consistency",
    "Correction",
    "LineIntegrals",
    "SourcePath",
    "beam_hardening_polynomial",
    "check_consistency",
    "reconstruct",
    "ring_offset",
    "source_path",
]
