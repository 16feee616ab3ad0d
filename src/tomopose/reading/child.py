"""Ask a library that can hang, crash or fill the memory in a process of its own, with limits on time and memory."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import pickle
import select
import signal
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from tomopose.errors import FileError, TomoposeError
from tomopose.reading.border import reading

T = TypeVar("T")

MOST_CPU_SECONDS = 3
"""Processor time: a sound file of a thousand datasets is listed in 0.1 s."""
MOST_SECONDS = 30.0
"""By the clock: a file server may be slow."""
MOST_BYTES = 300 * 2**20
"""Memory that listing a file may take beyond what the process has."""


def asked_apart(ask: Callable[[Path], T], path: Path, what: str) -> T:
    """`ask(path)` in a forked process; its result, or FileError where it fails, crashes or does not end.

    The result must be picklable.  Where the system cannot fork (Windows), the call is made here, without the limits.
    """
    if not hasattr(os, "fork"):
        with reading(path, what):
            return ask(path)
    receive, send = os.pipe()
    with warnings.catch_warnings():
        # Python warns of forks beside threads: the child uses nothing but the file and its pipe, and takes no lock.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        _answer(ask, path, what, send)
    os.close(send)
    try:
        content = _received(receive)
    finally:
        os.close(receive)
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    ended = status & 0x7F
    if content is None or ended == signal.SIGXCPU:
        raise FileError(f"{path} is damaged: its structure leads in circles; reading it does not end", path=path)
    if not content:
        raise FileError(f"{path} is damaged: it ends the program that looks at it (signal {ended})", path=path)
    answer = pickle.loads(content)
    if isinstance(answer, TomoposeError):
        raise answer
    found: T = answer
    return found


def _answer(ask: Callable[[Path], T], path: Path, what: str, send: int) -> None:
    """In the child: the result or the error into the pipe; never returns."""
    try:
        faulthandler.disable()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        _limit()
        answer: object
        try:
            with reading(path, what):
                answer = ask(path)
        except TomoposeError as error:
            error.__cause__ = error.__context__ = None
            answer = error
        content = pickle.dumps(answer)
        while content:
            content = content[os.write(send, content) :]
    finally:
        os._exit(0)


def _limit() -> None:
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        most = pages * os.sysconf("SC_PAGE_SIZE") + MOST_BYTES
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (most if hard < 0 else min(most, hard), hard))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (MOST_CPU_SECONDS, MOST_CPU_SECONDS + 1))


def _received(receive: int) -> bytes | None:
    """What the child wrote; None where it did not end in time."""
    deadline = time.monotonic() + MOST_SECONDS
    content = b""
    while True:
        left = deadline - time.monotonic()
        if left <= 0:
            return None
        ready, _, _ = select.select([receive], [], [], left)
        if not ready:
            return None
        piece = os.read(receive, 1 << 20)
        if not piece:
            return content
        content += piece
