"""`tomopose review`: look at detections in a browser, decide by keyboard, and see the calibration follow."""

from __future__ import annotations

import getpass
import math
import sys
import threading
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tomopose.cli.common import OK
from tomopose.cli.options import SpokenOptions, add_command
from tomopose.errors import FileError

if TYPE_CHECKING:
    import socket

    from tomopose import BallObservations, Calibration
    from tomopose.calibration.records.decisions import Decision
    from tomopose.cli.calibrate import Inputs
    from tomopose.cli.calibration_options import Options as CalibrateOptions
    from tomopose.review.guard import Guard
    from tomopose.review.session import Review

EPILOG = (
    "Example: tomopose review cal/\n\n"
    "On another machine: ssh -L 8000:localhost:8000 scanner-pc, there tomopose review cal/ --port 8000 --no-browser, "
    "and open the printed address here.\n\n"
    "While measuring: tomopose review --watch radiographs/ --scanner scanner.json --poses poses.csv "
    "--ball-diameter-mm 8\n\n"
    "Replay: tomopose calibrate ... --review cal/review.jsonl --out again/"
)
JOURNAL, REVIEWED = "review.jsonl", "reviewed"


@dataclass(frozen=True, kw_only=True)
class Options(SpokenOptions):
    """The options of `tomopose review`."""

    folder: Annotated[
        Path | None, typer.Argument(help="Folder that `tomopose calibrate` wrote.", show_default=False)
    ] = None
    watch: Annotated[
        Path | None,
        typer.Option("--watch", help="Instead of DIR: a folder into which radiographs of --poses are arriving."),
    ] = None
    commands: Annotated[str, typer.Option("--commands", help="With --watch: language of the machine's commands.")] = (
        "pi-gcs"
    )
    table_angles: Annotated[
        str, typer.Option("--table-angles", help="With --watch: table angles that are possible, degrees.")
    ] = "0,90"
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port on 127.0.0.1; 0: a free one.")] = 0
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the address and open no browser.")] = False
    who: Annotated[str | None, typer.Option("--who", help="Name that decisions carry; default: the login.")] = None
    scanner: Annotated[Path | None, typer.Option("--scanner", help="scanner.json, where job.json does not say.")] = None
    poses: Annotated[Path | None, typer.Option("--poses", help="poses.csv, where job.json does not say.")] = None
    images: Annotated[str | None, typer.Option("--images", help="Radiographs, where job.json does not say.")] = None
    ball_diameter: Annotated[
        float | None, typer.Option("--ball-diameter-mm", min=0.0, help="Diameter of the ball, mm, to measure again.")
    ] = None


def register(app: typer.Typer) -> None:
    add_command(app, "review", review, epilog=EPILOG)


def inputs_of(o: CalibrateOptions, folder: Path, pictures: str | None) -> Inputs:
    """The inputs of the calibration under review, with the detections of its folder instead of new ones.

    pictures: the radiographs, also where the calibration itself was made from observations.
    """
    from tomopose.cli.calibrate import read_inputs
    from tomopose.cli.job import image_source, open_for

    given = read_inputs(replace(o, images=None, observations=folder / "observations.csv"))
    if pictures is None:
        return given
    images = open_for(
        o.say, image_source(pictures), given.scanner, given.poses,
        dark=o.dark, flat=o.flat, dataset=o.dataset, rows=o.rows, raw=o.raw,
    )  # fmt: skip
    return replace(given, images=images)


def solver(o: CalibrateOptions, given: Inputs) -> Callable[[BallObservations], Calibration]:
    """The calibration of observations by the options of the run under review."""
    from tomopose.cli.calibrate import solve

    return lambda observations: solve(o, replace(given, observations=observations))


def saver(o: CalibrateOptions, folder: Path, given: Inputs) -> Callable[[Review], list[str]]:
    """Writes the calibration as it is reviewed, as `tomopose calibrate --review` does."""
    from tomopose.cli.calibrate import after_review, made_by, write_result
    from tomopose.cli.project import current_facts

    facts = current_facts()  # here and not when it saves: a thread of the server knows no running verb
    out = folder / REVIEWED
    own = replace(o, review=folder / JOURNAL, force=True)

    def save(review: Review) -> list[str]:
        decisions: Sequence[Decision] = review.decisions
        now = after_review(given, decisions)
        shown = now if o.images is not None else replace(now, images=None)
        write_result(own, out, made_by(own, now, review.calibration, decisions, facts), shown, decisions)
        return [f"{REVIEWED}/{name}" for name in ("calibration.json", "observations.csv", "report.html")]

    return save


def review(options: Options) -> int:
    """Review the detections of a calibration in a browser: accept, leave out, measure again, undo; solved at once.

    The page is served on this machine's loopback address alone, and its address holds a token.  Each decision is a
    line of DIR/review.jsonl; Save writes DIR/reviewed.  Ctrl-C ends the review; nothing is lost.
    """
    if (options.folder is None) == (options.watch is None):
        raise typer.BadParameter("give either the folder of a calibration or --watch", param_hint="DIR / --watch")
    return watch_run(options, options.watch) if options.watch is not None else review_folder(options, options.folder)


def open_address(options: Options, app: Guard, token: str, listening: socket.socket, *, more: Mapping[str, str]) -> int:
    """Print the address, open it, and answer until Ctrl-C."""
    from tomopose.review.server import address_of, serve

    address = address_of(listening, token)
    options.say.result({"address": address, **more}, [f"review: {address}", "Ctrl-C ends it."])
    sys.stdout.flush()
    serve(app, listening, ready=lambda: None if options.no_browser else webbrowser.open(address))
    return OK


def watch_run(options: Options, folder: Path) -> int:
    """The page of a run whose radiographs are arriving in a folder."""
    import tomopose as tp
    from tomopose.planning.limits import PlanLimits
    from tomopose.review.guard import new_token
    from tomopose.review.server import loopback_socket
    from tomopose.review.watch import Setup, Watcher
    from tomopose.review.watch_app import make_watch_app

    needed = {"--scanner": options.scanner, "--poses": options.poses, "--ball-diameter-mm": options.ball_diameter}
    missing = [name for name, given in needed.items() if given is None]
    if missing:
        raise typer.BadParameter(f"--watch needs {', '.join(missing)}", param_hint=missing[0])
    if not folder.is_dir():
        raise FileError(f"{folder} is not a folder; --watch needs the one into which the radiographs come", path=folder)
    assert options.scanner is not None
    assert options.poses is not None
    assert options.ball_diameter is not None
    try:
        angles = tuple(math.radians(float(a)) for a in options.table_angles.split(","))
    except ValueError:
        raise typer.BadParameter(f"{options.table_angles!r} is not numbers", param_hint="--table-angles") from None
    setup = Setup(
        scanner=tp.read_scanner(options.scanner),
        poses=tp.read_poses(options.poses),
        folder=folder,
        ball_diameter=options.ball_diameter,
        limits=PlanLimits(table_angles=angles, ball_radius=options.ball_diameter / 2),
        language=options.commands,
    )
    watcher, stop, token = Watcher(setup=setup), threading.Event(), new_token()
    app, listening = make_watch_app(watcher, token=token), loopback_socket(options.port)
    thread = threading.Thread(target=watcher.run, args=(stop,), daemon=True)
    thread.start()
    try:
        return open_address(options, app, token, listening, more={"watched": folder.name})
    finally:
        stop.set()


def review_folder(options: Options, folder: Path | None) -> int:
    """The page of a calibration's folder."""
    assert folder is not None
    from tomopose.calibration.records.decisions import read_decisions
    from tomopose.cli.calibration_job import options_of
    from tomopose.review.app import Desk, make_app
    from tomopose.review.guard import new_token
    from tomopose.review.server import loopback_socket
    from tomopose.review.session import begin

    journal = folder / JOURNAL
    o = options_of(folder, {k: getattr(options, k) for k in ("scanner", "poses", "ball_diameter")})
    given = inputs_of(o, folder, options.images if o.images is None else o.images)
    decisions = read_decisions(journal) if journal.exists() else ()
    begun = begin(given.observations, given.poses, decisions, solver(o, given))
    desk = Desk(
        review=begun,
        journal=journal,
        who=options.who or getpass.getuser(),
        save=saver(o, folder, given),
        images=given.images,
        ball_diameter=o.ball_diameter or given.observations.ball_diameter,
    )
    token = new_token()
    app, listening = make_app(desk, token=token), loopback_socket(options.port)
    return open_address(options, app, token, listening, more={"journal": str(journal)})
