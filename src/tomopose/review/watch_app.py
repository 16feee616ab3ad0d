"""The page of a run that is being taken: it asks for the state every second."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tomopose.errors import EngineMissingError
from tomopose.review.app import INSTALL, as_json, as_text, page, static
from tomopose.review.guard import Guard
from tomopose.review.watch import Watcher

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response


def make_watch_app(watcher: Watcher, *, token: str) -> Guard:
    """The application.  EngineMissingError where starlette is not installed."""
    try:
        from starlette.applications import Starlette
        from starlette.routing import Route
    except ImportError as error:
        raise EngineMissingError("a review needs starlette and uvicorn", install_line=INSTALL) from error

    def index(request: Request) -> Response:
        return page("watch.html")

    def state(request: Request) -> Response:
        with watcher.lock:
            return as_json(watcher.state)

    async def unknown(request: Request) -> Response:
        return as_text("there is no such page", 404)

    routes = [
        Route("/", index),
        Route("/static/{name}", static),
        Route("/state", state),
        Route("/{rest:path}", unknown),
    ]
    return Guard(Starlette(routes=routes), token)
