"""Section 6 of the paper: its 3D scan, its specimen and its multi-sphere standard."""

from tomopose.studies.section6.study import NOTES, QUESTION, TITLE, run

__all__ = ["NOTES", "QUESTION", "TITLE", "run"]
