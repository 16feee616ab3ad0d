"""The web application of a review: a page, its state, crops of radiographs, and decisions."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tomopose.calibration.records.decisions import Decision, append_decision, write_decisions
from tomopose.errors import EngineMissingError, InputError, TomoposeError
from tomopose.files import plain
from tomopose.io.images import ImageSequence
from tomopose.report.page import plots_script
from tomopose.review.crops import crop
from tomopose.review.guard import Guard
from tomopose.review.session import Review, decision_about, measured_again
from tomopose.review.view import changes_view, figures_view, state_view, worst_first

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response

INSTALL = 'pip install "tomopose[review]"'
STATIC = {
    "app.js": "text/javascript", "picture.js": "text/javascript", "app.css": "text/css", "tokens.css": "text/css",
    "plots.css": "text/css", "plots.js": "text/javascript", "watch.js": "text/javascript",
}  # fmt: skip
"""The files that may be asked for, by their whole names: nothing else is ever read from a disk for a request."""
OF_REPORT = ("tokens.css", "plots.css")
LONGEST_REASON = 2000


def static_file(name: str) -> str:
    """The text of one of the STATIC files, or of a page."""
    if name == "plots.js":
        return plots_script()
    if name in OF_REPORT:
        return (files("tomopose.report") / "templates" / name).read_text(encoding="utf-8")
    return (files("tomopose.review") / "static" / name).read_text(encoding="utf-8")


@dataclass
class Desk:
    """What a running review works on: the one place that changes.  One decision is taken at a time.

    journal: review.jsonl;  save: writes the reviewed calibration and returns the names of what it wrote.
    written, length: the decisions that this review last wrote into the journal, and its bytes then.
    """

    review: Review
    journal: Path
    who: str
    save: Callable[[Review], list[str]]
    images: ImageSequence | None = None
    ball_diameter: float | None = None
    order: list[int] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)
    written: tuple[Decision, ...] | None = None
    length: int = -1

    def __post_init__(self) -> None:
        self.order = self.order or worst_first(self.review)

    def take(self, changed: Callable[[Review], Review]) -> dict[str, Any]:
        """Change the review and its journal together, or neither; returns what the page must change, with the time that
        it took to solve again, ms."""
        with self.lock:
            begun, before = time.perf_counter(), self.review
            review = changed(before)
            seconds = time.perf_counter() - begun
            self._write(review.decisions)
            self.review = review
            return {**changes_view(before, review), "solve_ms": 1000 * seconds}

    def _write(self, decisions: tuple[Decision, ...]) -> None:
        """A new decision is one more line of a journal that is as this review left it; else it is written anew."""
        kept = self.journal.exists() and self.journal.stat().st_size == self.length
        if kept and self.written is not None and decisions[:-1] == self.written:
            append_decision(self.journal, decisions[-1])
        else:
            write_decisions(self.journal, decisions)
        self.written, self.length = decisions, self.journal.stat().st_size

    def decision(self, content: Mapping[str, object]) -> Decision:
        """The decision that a page asks for.  InputError where it is not one; DetectionError where no ball is found."""
        row, action, why = content.get("row"), content.get("action"), content.get("why", "")
        n = len(self.review.detected)
        if isinstance(row, bool) or not isinstance(row, int) or not 0 <= row < n:
            raise InputError(f"row is {row!r}; a number from 0 to {n - 1} is needed")
        if not isinstance(why, str) or len(why) > LONGEST_REASON:
            raise InputError(f"the reason must be text of at most {LONGEST_REASON} characters")
        if action not in ("accept", "leave-out", "measure-again"):
            raise InputError(f"action {action!r} is unknown")
        start = measured = None
        if action == "measure-again":
            start = self._start(content.get("start"))
            if self.images is None or self.ball_diameter is None:
                raise InputError("to measure again, the review needs the radiographs and the ball's diameter")
            scanner = self.review.calibration.scanner
            measured = measured_again(self.images, row, scanner, ball_diameter=self.ball_diameter, start=start)
        return decision_about(self.review, row, action, who=self.who, why=why.strip(), start=start, measured=measured)

    def _start(self, value: object) -> tuple[float, float]:
        numbers = [float(x) for x in value if isinstance(x, (int, float))] if isinstance(value, list) else []
        if len(numbers) != 2 or value != numbers or not all(math.isfinite(x) for x in numbers):
            raise InputError(f"start is {value!r}; [u, v] in px is needed")
        return numbers[0], numbers[1]


def make_app(desk: Desk, *, token: str) -> Guard:
    """The application.  EngineMissingError where starlette is not installed."""
    try:
        from starlette.applications import Starlette
        from starlette.routing import Route
    except ImportError as error:
        raise EngineMissingError("a review needs starlette and uvicorn", install_line=INSTALL) from error

    def state(request: Request) -> Response:
        more = {"order": desk.order, "who": desk.who, "pictures": desk.images is not None}
        return as_json({**state_view(desk.review), **more})

    def figures(request: Request) -> Response:
        return as_json({"figures": figures_view(desk.review)})

    def picture(request: Request) -> Response:
        return _picture(desk.images, request)

    async def change(request: Request) -> Response:
        return await _change(desk, request)

    async def unknown(request: Request) -> Response:
        return as_text("there is no such page", 404)

    routes = [
        Route("/", _index),
        Route("/static/{name}", static),
        Route("/state", state),
        Route("/figures", figures),
        Route("/crop/{row:int}", picture),
        *(Route(f"/{what}", change, methods=["POST"]) for what in ("decide", "undo", "save")),
        Route("/{rest:path}", unknown),
    ]
    return Guard(Starlette(routes=routes), token)


def as_json(content: Mapping[str, object], status: int = 200) -> Response:
    """An answer of JSON; numbers that are not finite become null."""
    from starlette.responses import Response

    try:
        text = json.dumps(content, allow_nan=False, default=plain)
    except ValueError:  # a number that is not finite somewhere: looked for in all of it
        text = json.dumps(plain(content), allow_nan=False)
    return Response(text, status, media_type="application/json")


def as_text(words: str, status: int) -> Response:
    """An answer in words."""
    from starlette.responses import PlainTextResponse

    return PlainTextResponse(words, status)


def page(name: str) -> Response:
    """One of the pages, index.html or watch.html."""
    from starlette.responses import Response

    return Response(static_file(name), media_type="text/html")


def _index(request: Request) -> Response:
    return page("index.html")


def static(request: Request) -> Response:
    """One of the STATIC files."""
    from starlette.responses import Response

    name = request.path_params["name"]
    return (
        Response(static_file(name), media_type=STATIC[name])
        if name in STATIC
        else as_text("there is no such file", 404)
    )


def _picture(images: ImageSequence | None, request: Request) -> Response:
    """The crop of a row about (u, v): its pixels as bytes, what they are in the header x-crop."""
    from starlette.responses import Response

    if images is None:
        return as_text("this review has no radiographs", 404)
    k, n = request.path_params["row"], len(images)
    if k >= n:
        return as_text(f"there are {n} radiographs", 404)
    try:
        u, v = (float(request.query_params[name]) for name in ("u", "v"))
        half = int(request.query_params["half"])
    except (KeyError, ValueError):
        return as_text("u, v and half are needed", 400)
    if not (math.isfinite(u) and math.isfinite(v)):
        return as_text("u and v must be finite", 400)
    found = crop(images, k, (u, v), half)
    return Response(found.pixels, media_type="application/octet-stream", headers={"x-crop": found.head})


async def _body(request: Request) -> dict[str, object]:
    """The JSON object of a request.  InputError where it is not one, or not declared as one."""
    if request.headers.get("content-type", "").split(";")[0] != "application/json":
        raise InputError("application/json is needed")
    try:
        content = json.loads(await request.body() or b"{}")
    except (ValueError, RecursionError) as error:
        raise InputError(f"not JSON: {error}") from error
    if not isinstance(content, dict):
        raise InputError("a JSON object is needed")
    return content


async def _change(desk: Desk, request: Request) -> Response:
    """A decision, undo or save; what cannot be done is answered with the reason and changes nothing."""
    from starlette.concurrency import run_in_threadpool

    def work(content: dict[str, object]) -> dict[str, Any]:
        what = request.url.path.rpartition("/")[2]
        if what == "save":
            with desk.lock:
                return {"written": desk.save(desk.review)}
        if what == "undo":
            return desk.take(lambda review: review.without_last())
        decision = desk.decision(content)
        return desk.take(lambda review: review.with_decision(decision))

    try:
        return as_json(await run_in_threadpool(work, await _body(request)))
    except TomoposeError as error:
        return as_json({"error": str(error)}, 400)
