"""The error tree.  Every message says what was found, the measured value, and what to do.

TomoposeError
├ InputError(ValueError)        a value, table or file content that cannot be used
│   ├ ShapeError                an array of the wrong shape
│   ├ UnitError                 a unit missing, or a magnitude that belongs to another unit
│   ├ FrameMismatchError        two transforms that do not chain (source, target)
│   └ ConventionError           an unknown or contradictory convention
├ DetectionError                one image (index)
│   ├ BallNotFoundError
│   ├ BallTruncatedError
│   └ AmbiguousBallError
├ CalibrationError              carries the calibration as far as it came
│   ├ NotObservableError        (direction, singular_values)
│   └ NotConvergedError
├ TrajectoryError               (indices) of the views concerned
│   ├ OutOfReachError           (limits)
│   └ OutOfViewError
├ EngineError
│   ├ EngineMissingError        (install_line)
│   └ EngineFailedError
├ ExportError
│   └ NotRepresentableError     (format, indices)
└ FileError                     (path)
    ├ UnknownKindError          also a ConventionError
    └ SchemaVersionError
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any


class InputWarning(UserWarning):
    """A file was read, but something in it should be looked at."""


class TomoposeError(Exception):
    """Root of all errors that tomopose raises on purpose."""


class InputError(TomoposeError, ValueError):
    """A value, a table or a file's content that cannot be used."""


class ShapeError(InputError):
    """An array has the wrong shape."""


class UnitError(InputError):
    """A unit is missing, or a magnitude belongs to another unit."""


class FrameMismatchError(InputError):
    """Two transforms do not chain, or a transform joins other frames than it should."""

    def __init__(self, message: str, *, source: object = None, target: object = None) -> None:
        super().__init__(message)
        self.source = source
        self.target = target


class ConventionError(InputError):
    """A convention is unknown, missing or contradicts another."""


class DetectionError(TomoposeError):
    """The ball could not be measured in one image."""

    def __init__(self, message: str, *, index: int | None = None) -> None:
        super().__init__(message)
        self.index = index


class BallNotFoundError(DetectionError):
    """No ball in the image."""


class BallTruncatedError(DetectionError):
    """Less than half of the ball's rim is inside the image."""


class AmbiguousBallError(DetectionError):
    """More than one shape could be the ball."""


class CalibrationError(TomoposeError):
    """The calibration failed; `calibration` holds it as far as it came, or None."""

    def __init__(self, message: str, *, calibration: Any = None) -> None:
        super().__init__(message)
        self.calibration = calibration


class NotObservableError(CalibrationError):
    """The poses cannot determine a direction of the parameter space."""

    def __init__(
        self,
        message: str,
        *,
        direction: str = "",
        singular_values: Sequence[float] = (),
        calibration: Any = None,
    ) -> None:
        super().__init__(message, calibration=calibration)
        self.direction = direction
        self.singular_values = tuple(singular_values)


class NotConvergedError(CalibrationError):
    """The solver stopped before it reached an optimum."""


class TrajectoryError(TomoposeError):
    """Poses of a trajectory cannot be used; `indices` names them."""

    def __init__(self, message: str, *, indices: Sequence[int] = ()) -> None:
        super().__init__(message)
        self.indices = tuple(indices)


class OutOfReachError(TrajectoryError):
    """The manipulator cannot reach a pose; `limits` says which limit binds."""

    def __init__(self, message: str, *, indices: Sequence[int] = (), limits: Any = None) -> None:
        super().__init__(message, indices=indices)
        self.limits = limits


class OutOfViewError(TrajectoryError):
    """The ball or the object leaves the field of view."""


class EngineError(TomoposeError):
    """An engine or an optional package failed or is missing."""


class EngineMissingError(EngineError):
    """An optional package is not installed; `install_line` is the command that installs it."""

    def __init__(self, message: str, *, install_line: str = "") -> None:
        super().__init__(message)
        self.install_line = install_line


class EngineFailedError(EngineError):
    """An engine ran and failed."""


class ExportError(TomoposeError):
    """A geometry could not be written."""


class NotRepresentableError(ExportError):
    """A foreign format cannot hold this geometry; nothing is rounded to make it fit."""

    def __init__(self, message: str, *, format: str = "", indices: Sequence[int] = ()) -> None:
        super().__init__(message)
        self.format = format
        self.indices = tuple(indices)


class FileError(TomoposeError):
    """A file cannot be read or written."""

    def __init__(self, message: str, *, path: str | Path | None = None) -> None:
        super().__init__(message)
        self.path = path


class UnknownKindError(FileError, ConventionError):
    """What kind of file this is cannot be determined."""


class SchemaVersionError(FileError):
    """A file's schema is unknown or newer than this version reads."""
