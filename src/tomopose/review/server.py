"""The application on the loopback address: nothing outside this machine can reach it."""

from __future__ import annotations

import socket
from collections.abc import Callable

from tomopose.errors import EngineMissingError, InputError
from tomopose.review.app import INSTALL
from tomopose.review.guard import Guard

ADDRESS = "127.0.0.1"
PATIENCE = 3
"""Seconds that an answer under way may still take when the review is ended."""


def loopback_socket(port: int) -> socket.socket:
    """A listening socket on the loopback address; port 0 takes a free one.  InputError where the port is in use."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((ADDRESS, port))
        listening.listen()  # from now on a browser that is early waits and is not refused
    except OSError as error:
        listening.close()
        raise InputError(
            f"port {port} of {ADDRESS} cannot be used ({error.strerror}); choose another with --port"
        ) from error
    return listening


def address_of(listening: socket.socket, token: str) -> str:
    """What is typed into a browser."""
    return f"http://{ADDRESS}:{listening.getsockname()[1]}/{token}/"


def serve(app: Guard, listening: socket.socket, *, ready: Callable[[], object] = lambda: None) -> None:
    """Answer requests until the process is interrupted.  EngineMissingError where uvicorn is not installed."""
    try:
        import uvicorn
    except ImportError as error:
        raise EngineMissingError("a review needs starlette and uvicorn", install_line=INSTALL) from error

    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        date_header=False,
        timeout_graceful_shutdown=PATIENCE,
    )
    ready()
    uvicorn.Server(config).run(sockets=[listening])
