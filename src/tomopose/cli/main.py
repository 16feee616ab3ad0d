"""The front door: `tomopose VERB`.  Exit codes: 0 done; 1 bad input; 2 usage; 3 finished but not trustworthy; 4 an
engine or extra is missing; 70 internal.  One module a verb; a verb reads files, makes one library call, writes files.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Sequence
from types import FrameType
from typing import Annotated, Any

import typer

from tomopose.cli.common import (
    BAD_INPUT,
    INTERNAL,
    INTERRUPTED,
    MISSING,
    OK,
    TERMINATED,
    USAGE,
    as_line,
    speak_any_terminal,
    tell,
)
from tomopose.cli.project import default_map, project_for, without_project
from tomopose.errors import EngineMissingError, TomoposeError

OF_THE_SYSTEM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EMFILE, errno.ENFILE})
"""Faults of disks and limits, which no command line causes."""

VERBS = (
    "init",
    "demo",
    "simulate",
    "detect",
    "calibrate",
    "diagnose",
    "plan",
    "import_scanner",
    "import_poses",
    "matrices",
    "export",
    "import_geometry",
    "refine",
    "reconstruct",
    "measure",
    "compare",
    "monitor",
    "report",
    "review",
    "study",
    "warmup",
    "doctor",
)
"""The modules of this folder that hold a verb each, in the order of --help; each has `register(app)`."""

# typer brings its own copy of click, or uses an installed one, by version: its exceptions are reached through typer.
CommandLineError: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

app = typer.Typer(
    name="tomopose",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    epilog="Example: tomopose demo --out demo   then open demo/report.html",
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from tomopose.provenance import package_version

        print(f"tomopose {package_version()}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and stop.")
    ] = False,
    project: Annotated[
        str | None,
        typer.Option(
            "--project", help="Project file, before or after the verb; default: tomopose.toml of the working folder."
        ),
    ] = None,
) -> None:
    """Pose calibration for X-ray tomography: from radiographs of one ball to exact projection matrices."""


for _verb in VERBS:
    importlib.import_module(f"tomopose.cli.{_verb}").register(app)


def _show_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    tell(f"tomopose: warning: {message}")


def _fail(error: BaseException, code: int, *, as_json: bool) -> int:
    message = " ".join(str(error).split()).replace("force=True", "--force") or type(error).__name__
    if isinstance(error, EngineMissingError) and error.install_line and error.install_line not in message:
        message += f"; install it with: {error.install_line}"
    if as_json:
        print(as_line({"error": {"kind": type(error).__name__, "message": message, "exit_code": code}}))
    tell(f"tomopose: {message}")
    return code


def _usage(error: Any, *, as_json: bool) -> int:
    """A command line that cannot be understood; with --json one object, as every other error."""
    if as_json:
        message = " ".join(error.format_message().split())
        print(as_line({"error": {"kind": type(error).__name__, "message": message, "exit_code": USAGE}}))
    with contextlib.suppress(OSError):
        error.show()
    return USAGE


def _empty_option(words: Sequence[str]) -> str | None:
    """The first option whose value is the empty text, which a path would silently take for the working folder."""
    for word, following in zip(words, [*words[1:], None], strict=True):
        if word.startswith("--") and (word.endswith("=") or (following == "" and "=" not in word)):
            return word.removesuffix("=")
    return None


def run(argv: Sequence[str] | None = None) -> int:
    """One command line; returns the exit code and never raises."""
    words = list(sys.argv[1:] if argv is None else argv)
    as_json = "--json" in words
    warnings.simplefilter("default", UserWarning)
    warnings.showwarning = _show_warning
    try:
        code = _carried_out(words, as_json=as_json)
        sys.stdout.flush()
        return code
    except (BrokenPipeError, SystemExit):  # click and rich exit where the reader of a pipe has left
        return _reader_left()
    except OSError as error:  # standard output itself: a full disk, a closed terminal
        _reader_left()
        tell(f"tomopose: the result cannot be printed: {error.strerror or error}")
        return BAD_INPUT


def _carried_out(words: list[str], *, as_json: bool) -> int:
    """The verb, and what its errors mean as an exit code."""
    try:
        empty = _empty_option(words)
        if empty is not None:
            raise typer.BadParameter("the value is empty", param_hint=empty)
        words, named = without_project(words)
        command, project = typer.main.get_command(app), project_for(words, named)
        defaults = default_map(command, project, words)
        code = command.main(args=words, prog_name="tomopose", standalone_mode=False, default_map=defaults, obj=project)
        return code if isinstance(code, int) else OK
    except CommandLineError as error:
        return _usage(error, as_json=as_json)
    except Terminated:
        tell("tomopose: terminated; no partial file was left")
        return TERMINATED
    except (typer.Abort, KeyboardInterrupt):
        tell("tomopose: interrupted; no partial file was left")
        return INTERRUPTED
    except EngineMissingError as error:
        return _fail(error, MISSING, as_json=as_json)
    except TomoposeError as error:
        return _fail(error, BAD_INPUT, as_json=as_json)
    except MemoryError as error:
        return _fail(MemoryError(f"memory is not enough: {error}"), BAD_INPUT, as_json=as_json)
    except BrokenPipeError:
        raise
    except Exception as error:  # the last net: whatever is not foreseen is our fault, and says so
        if isinstance(error, OSError) and (error.filename is not None or error.errno in OF_THE_SYSTEM):
            where = "" if error.filename is None else f"{str(error.filename)[:300]}: "
            return _fail(OSError(f"{where}{error.strerror}"), BAD_INPUT, as_json=as_json)
        if os.environ.get("TOMOPOSE_DEBUG"):
            traceback.print_exc()
        last = traceback.extract_tb(error.__traceback__)[-1]
        note = RuntimeError(
            f"internal error, {type(error).__name__}: {error} ({os.path.basename(last.filename)}:{last.lineno}); "
            "set TOMOPOSE_DEBUG=1 to see where"
        )
        return _fail(note, INTERNAL, as_json=as_json)


def _reader_left() -> int:
    """Standard output leads nowhere any more: what Python still holds for it must not raise at the end."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
    return OK


class Terminated(KeyboardInterrupt):
    """SIGTERM: as Ctrl-C, so that every temporary file is removed on the way out."""


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated


def main() -> None:
    """The program: `run` with the terminal's limits and SIGTERM taken care of."""
    speak_any_terminal()
    signal.signal(signal.SIGTERM, _terminate)
    sys.exit(run())
