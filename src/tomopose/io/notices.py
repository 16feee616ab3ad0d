"""What was accepted although it is doubtful: a warning class of its own, so that callers can collect or forbid it."""

from __future__ import annotations


class InputWarning(UserWarning):
    """A file was read, but something in it should be looked at."""
