"""Reconstruction from any projection matrices: `reconstruct` and what it is made of."""

from tomopose.reconstruction.consistency import Consistency, check_consistency
from tomopose.reconstruction.fdk.path import SourcePath, source_path
from tomopose.reconstruction.line_integrals import (
    Correction,
    LineIntegrals,
    beam_hardening_polynomial,
    ring_offset,
)
from tomopose.reconstruction.run import reconstruct
from tomopose.reconstruction.settings import CGLS, FDK, OSSART, PAPER, SART, Execution

__all__ = [
    "CGLS",
    "FDK",
    "OSSART",
    "PAPER",
    "SART",
    "Consistency",
    "Correction",
    "Execution",
    "LineIntegrals",
    "SourcePath",
    "beam_hardening_polynomial",
    "check_consistency",
    "reconstruct",
    "ring_offset",
    "source_path",
]
