"""The front door: `tomopose VERB`.  Exit codes: 0 done; 1 bad input; 2 usage; 3 finished but not trustworthy; 4 an
engine or extra is missing; 70 internal.  One module a verb; a verb reads files, makes one library call, writes files.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from tomopose.cli.common import BAD_INPUT, INTERNAL, MISSING, OK, USAGE
from tomopose.errors import EngineMissingError, TomoposeError

VERBS = (
    "demo",
    "simulate",
    "detect",
    "calibrate",
    "diagnose",
    "plan",
    "import_poses",
    "matrices",
    "export",
    "import_geometry",
    "reconstruct",
    "measure",
    "compare",
    "monitor",
    "report",
    "study",
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
) -> None:
    """Pose calibration for X-ray tomography: from radiographs of one ball to exact projection matrices."""


for _verb in VERBS:
    importlib.import_module(f"tomopose.cli.{_verb}").register(app)


def _show_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    print(f"tomopose: warning: {message}", file=sys.stderr)


def _fail(error: BaseException, code: int, *, as_json: bool) -> int:
    message = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, EngineMissingError) and error.install_line and error.install_line not in message:
        message += f"; install it with: {error.install_line}"
    if as_json:
        print(json.dumps({"error": {"kind": type(error).__name__, "message": message, "exit_code": code}}))
    print(f"tomopose: {message}", file=sys.stderr)
    return code


def run(argv: Sequence[str] | None = None) -> int:
    """One command line; returns the exit code and never raises."""
    words = list(sys.argv[1:] if argv is None else argv)
    as_json = "--json" in words
    warnings.simplefilter("default", UserWarning)
    warnings.showwarning = _show_warning
    try:
        code = typer.main.get_command(app).main(args=words, prog_name="tomopose", standalone_mode=False)
        return code if isinstance(code, int) else OK
    except CommandLineError as error:
        error.show()
        return USAGE
    except (typer.Abort, KeyboardInterrupt):
        print("tomopose: interrupted; no partial file was left", file=sys.stderr)
        return 130
    except EngineMissingError as error:
        return _fail(error, MISSING, as_json=as_json)
    except TomoposeError as error:
        return _fail(error, BAD_INPUT, as_json=as_json)
    except Exception as error:  # the last net: whatever is not foreseen is our fault, and says so
        if os.environ.get("TOMOPOSE_DEBUG"):
            traceback.print_exc()
        where = traceback.extract_tb(error.__traceback__)[-1]
        note = RuntimeError(
            f"internal error, {type(error).__name__}: {error} ({os.path.basename(where.filename)}:{where.lineno}); "
            "set TOMOPOSE_DEBUG=1 to see where"
        )
        return _fail(note, INTERNAL, as_json=as_json)


def main() -> None:
    sys.exit(run())
