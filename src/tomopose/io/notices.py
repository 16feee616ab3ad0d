"""What was accepted although it is doubtful: a warning class of its own, so that callers can collect or forbid it."""

from __future__ import annotations

from tomopose.errors import InputWarning

__all__ = ["InputWarning"]
