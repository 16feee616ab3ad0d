"""One border: whatever another library raises while a file is read becomes a FileError with the file and the cause.

    @reader("pose table")
    def read_poses(path, ...): ...          # the first argument is the file

    with reading(path, "radiograph"): ...   # where a part of a function reads

Errors of this package pass unchanged.  Errors that no file can cause (a misspelt name, a wrong call, an assertion) pass
too: they are faults of this package and end with exit code 70.
"""

from __future__ import annotations

import contextlib
import functools
import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import ParamSpec, TypeVar

from tomopose.errors import FileError, InputError, TomoposeError

P = ParamSpec("P")
R = TypeVar("R")

LONGEST_CAUSE = 200
OUR_FAULTS = (NameError, ImportError, AssertionError, SyntaxError)
OPEN_STREAMS = ("/dev/fd/", "/dev/stdin", "/proc/self/fd/")
"""Streams that a shell hands over, as in `--poses <(command)`."""

CAUSES: tuple[tuple[type[BaseException], str], ...] = (
    (RecursionError, "its parts are nested too deeply"),
    (MemoryError, "it asks for more memory than is free"),
    (KeyError, "the entry {error} is missing"),
    (StopIteration, "it ends too early"),
    (EOFError, "it ends too early"),
    (ZeroDivisionError, "a size or step in it is zero"),
    (OverflowError, "a number in it is too large ({error})"),
    (TypeError, "a value in it is of the wrong kind ({error})"),
    (AttributeError, "a value in it is of the wrong kind ({error})"),
    (IndexError, "a list in it is too short ({error})"),
)
"""What the exceptions of other libraries mean to somebody who looks at the file."""


def reader(what: str, *, folder: bool = False) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator of a function whose first argument is the file that it reads.

    what:   the kind of file, as messages name it ("pose table").
    folder: whether a folder may be given, too.
    """

    def wrap(read: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(read)
        def guarded(*args: P.args, **kwargs: P.kwargs) -> R:
            if not args and "path" not in kwargs:
                return read(*args, **kwargs)  # Python names the missing argument
            place = as_path(args[0] if args else kwargs["path"], what)
            require_file(place, what, folder=folder)
            with reading(place, what):
                return read(*args, **kwargs)

        return guarded

    return wrap


def as_path(path: object, what: str) -> Path:
    """The path; InputError for anything that is not a path, FileError for an empty one."""
    if not isinstance(path, (str, os.PathLike)):
        raise InputError(f"the {what} is read from a file; a {type(path).__name__} was given instead of its path")
    if os.fspath(path) == "":
        raise FileError(f"the path of the {what} is empty")
    if "\0" in str(path):
        raise FileError(f"the path of the {what} holds a zero byte", path=str(path))
    return Path(os.fsdecode(os.fspath(path)))


@contextlib.contextmanager
def reading(path: Path | str, what: str) -> Iterator[None]:
    """Turns what other libraries raise inside into FileError; `what` names the kind of file."""
    try:
        yield
    except (TomoposeError, Warning, *OUR_FAULTS):  # a warning is raised where the caller forbids it
        raise
    except FileNotFoundError as error:
        raise FileError(f"{error.filename or path} does not exist", path=path) from error
    except OSError as error:
        fault = f"cannot be read: {error.strerror}" if error.errno else f"is no readable {what}: {in_words(error)}"
        raise FileError(f"{path} {fault}", path=path) from error
    except Exception as error:
        if isinstance(error, TypeError) and _is_a_wrong_call(error):
            raise
        raise FileError(f"{path} is no readable {what}: {in_words(error)}", path=path) from error


def in_words(error: BaseException) -> str:
    """The cause in one line, with the exception's own name for those who look for it."""
    text = " ".join(str(error).split())[:LONGEST_CAUSE]
    for kind, words in CAUSES:
        if isinstance(error, kind):
            if kind is KeyError and " " in text:  # a sentence of its own, as h5py writes
                return text.strip("'\"")
            said = words.format(error=text or type(error).__name__)
            return said if "(" in said else f"{said} ({type(error).__name__})"
    return f"{text} ({type(error).__name__})" if text else type(error).__name__


def _is_a_wrong_call(error: TypeError) -> bool:
    """Whether the reader was called with arguments that it does not take: the error then comes from the border."""
    trace = error.__traceback__
    frames = []
    while trace is not None:
        frames.append(trace.tb_frame.f_code.co_filename)
        trace = trace.tb_next
    return bool(frames) and frames[-1] == __file__


def require_file(path: Path, what: str, *, folder: bool = False) -> None:
    """FileError unless the path is a regular file (or a folder, where that may be given).

    Devices and named pipes are refused, since reading them need not end.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError as error:
        missing = f"{path} is a link to nothing" if path.is_symlink() else f"{path} does not exist"
        raise FileError(missing, path=path) from error
    except (OSError, ValueError) as error:
        raise FileError(f"{_short(path)} cannot be read: {in_words(error)}", path=path) from error
    if stat.S_ISREG(mode) or str(path).startswith(OPEN_STREAMS):
        return
    if stat.S_ISDIR(mode):
        if folder:
            return
        raise FileError(f"{path} is a folder; a {what} is needed", path=path)
    raise FileError(f"{path} is a device or pipe; a {what} is read from a regular file", path=path)


def _short(path: Path) -> str:
    text = str(path)
    return text if len(text) <= LONGEST_CAUSE else f"{text[:60]}... ({len(text)} characters)"


def require_inside(folder: Path, name: object, where: str) -> Path:
    """The file `name` in `folder`; FileError where the name leads out of the folder or is no name.

    where: the file that names it, for the message.
    """
    text = str(name)
    parts = {*PureWindowsPath(text).parts, *PurePosixPath(text).parts}
    leaves = not isinstance(name, str) or ".." in parts or PureWindowsPath(text).anchor or text.startswith("/")
    if leaves or not text.strip() or "\0" in text:
        raise FileError(f"{where} names {text[:100]!r}, which is no file inside its own folder", path=where)
    path = folder / PureWindowsPath(text).as_posix()
    if not path.resolve().is_relative_to(folder.resolve()):
        raise FileError(f"{where} names {text[:100]!r}, a link that leaves its folder", path=where)
    return path
