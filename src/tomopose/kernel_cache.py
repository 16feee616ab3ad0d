"""Where compiled kernels are kept: beside the package, else in the user's cache folder, a temporary one, or nowhere.

numba keeps them in the package's own folders and ends the import where it cannot write them: in a container with a
read-only file system, or for a service without a home.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import stat
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

VARIABLE = "NUMBA_CACHE_DIR"
"""numba's own: a folder that the user names in it is used wherever it can be written."""


def choose_cache_folder(package: Path, environment: Mapping[str, str] = os.environ) -> None:
    """Sets numba's folder for this process and its children; leaves numba's own choice where that works."""
    named = environment.get(VARIABLE)
    if named is None and _writable(package):
        return
    for folder in candidates(environment):
        if _usable(folder):
            os.environ[VARIABLE] = str(folder)
            return
    os.environ.pop(VARIABLE, None)
    compile_each_time()


def kept_in(package: Path, environment: Mapping[str, str] = os.environ) -> Path | None:
    """The folder that compiled kernels are kept in, after `choose_cache_folder`; None where nothing is kept."""
    named = environment.get(VARIABLE)
    if named:
        return Path(named)
    return package / "__pycache__" if _writable(package) else None


def candidates(environment: Mapping[str, str]) -> Iterator[Path]:
    """Folders to try, in this order."""
    if environment.get(VARIABLE):
        yield Path(environment[VARIABLE])
    if sys.platform == "win32":
        homes = [environment.get("LOCALAPPDATA")]
    elif sys.platform == "darwin":
        homes = [f"{environment['HOME']}/Library/Caches" if environment.get("HOME") else None]
    else:
        homes = [
            environment.get("XDG_CACHE_HOME"),
            f"{environment['HOME']}/.cache" if environment.get("HOME") else None,
        ]
    for home in homes:
        if home and os.path.isabs(home):
            yield Path(home) / "tomopose" / "kernels"
    user = os.getuid() if hasattr(os, "getuid") else "user"
    with contextlib.suppress(OSError):
        yield Path(tempfile.gettempdir()) / f"tomopose-kernels-{user}"
    if sys.platform == "linux":
        yield Path("/dev/shm") / f"tomopose-kernels-{user}"


def _writable(folder: Path) -> bool:
    """Whether files can be made in a folder; asked without making one."""
    try:
        return os.access(folder, os.W_OK | os.X_OK)
    except OSError:
        return False


def _usable(folder: Path) -> bool:
    """Whether the folder is there, or can be made, for this user alone: what lies in it is run as code."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        facts = folder.stat()
        if hasattr(os, "getuid") and (facts.st_uid != os.getuid() or facts.st_mode & (stat.S_IWGRP | stat.S_IWOTH)):
            return False
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def compile_each_time() -> None:
    """Nothing can be written anywhere: kernels are compiled in each process and kept in its memory alone."""
    from numba.core.dispatcher import Dispatcher

    setattr(Dispatcher, "enable_caching", lambda self: None)  # noqa: B010  (a method is replaced)


if TYPE_CHECKING:
    import numba

    njit = numba.njit
else:

    def njit(**options):
        """`numba.njit` as every kernel here uses it: without the wrapper by which C would call the kernel, with numpy's
        rule for a division by zero (inf or NaN, no exception and nothing to compile for it), and compiled while the
        garbage collector rests.
        """
        import numba

        _let_collector_rest()
        return numba.njit(no_cfunc_wrapper=True, error_model="numpy", **options)


@functools.cache
def _let_collector_rest() -> None:
    """No garbage collection from the start of the outermost compilation to its end.

    A compilation makes some hundred thousand objects beside all that scipy and numba hold.  The collector would go
    through them again and again and find little to free.
    """
    was_on = False

    def told(now: bool) -> None:
        nonlocal was_on
        if now:
            was_on = gc.isenabled()
            gc.disable()
        elif was_on:
            gc.enable()

    _listen_to_compiling(told)


@contextlib.contextmanager
def reporting_compiling(told: Callable[[bool], None]) -> Iterator[None]:
    """Calls told(True) when this process begins to compile a kernel and told(False) when it ends; not for kernels that
    are loaded from the cache.
    """
    stop = _listen_to_compiling(told)
    try:
        yield
    finally:
        stop()


def _listen_to_compiling(told: Callable[[bool], None]) -> Callable[[], None]:
    """Calls told(True) when the outermost compilation begins and told(False) when it ends, in whichever threads they
    are; what it returns ends that.
    """
    from numba.core import event as untyped_event
    from numba.core.event import Event, Listener

    events: Any = untyped_event

    class Compiling(Listener):
        """Kernels that call others are compiled one inside the other: only the outermost counts."""

        depth = 0
        lock = threading.RLock()

        def on_start(self, event: Event) -> None:
            with self.lock:
                self.depth += 1
                if self.depth == 1:
                    told(True)

        def on_end(self, event: Event) -> None:
            with self.lock:
                self.depth -= 1
                if self.depth == 0:
                    told(False)

    listener = Compiling()
    events.register("numba:compile", listener)
    return lambda: events.unregister("numba:compile", listener)
