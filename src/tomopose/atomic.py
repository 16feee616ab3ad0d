"""Files and folders that are whole, old or new, whatever ends the program: written beside, flushed, and renamed.

Temporary names say which process writes them (`.NAME-HOST-PID-START-...`), so that the next run removes what a killed
one left and nothing that is still being written.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import re
import shutil
import signal
import socket
import tempfile
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import FrameType

from tomopose.errors import FileError

EXCHANGE = 2
"""RENAME_EXCHANGE of Linux's renameat2: two folders swap their names in one step."""
AT_WORKING_FOLDER = -100


def require_absent(path: str | Path, *, force: bool = False) -> Path:
    """The path, if nothing is there or `force` allows to overwrite it; FileError otherwise."""
    path = Path(path)
    try:
        os.lstat(path)
        there = True
    except (FileNotFoundError, NotADirectoryError):
        there = False
    except (OSError, ValueError) as error:
        raise FileError(f"{str(path)[:200]} is no path that can be written: {error}", path=path) from error
    if there and path.is_symlink() and not path.exists():
        raise FileError(f"{path} is a link to nothing; remove it or give another name", path=path)
    _require_place(path)
    if there and not force:
        raise FileError(f"{path} exists already; give another name, or force=True to overwrite it", path=path)
    return path


def _require_place(path: Path) -> None:
    """FileError for a device, pipe or socket, which a file renamed to its name would take away from every program, and
    for a folder on the way that is a link to nothing.
    """
    if os.path.exists(path) and not (os.path.isfile(path) or os.path.isdir(path)):
        raise FileError(f"{path} is a device, a pipe or a socket; give the name of a file", path=path)
    for folder in path.parents:
        if os.path.islink(folder) and not os.path.exists(folder):
            raise FileError(f"{str(path)[:300]}: the folder {folder} is a link to nothing; remove it", path=path)


@contextlib.contextmanager
def atomic_file(path: str | Path) -> Iterator[Path]:
    """A temporary path in the same folder (same suffix); on leaving without error it takes the place of `path`.

    A link stays: what it leads to is replaced.

    Raises FileError where the folder cannot be made or written, or the disk is full.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        _require_place(path)
        if path.is_symlink():
            path = path.resolve()
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers_once(path.parent.absolute())
        handle, name = tempfile.mkstemp(prefix=_prefix(path), suffix=path.suffix, dir=path.parent)
        os.close(handle)
        temporary = Path(name)
        yield temporary
        _sync(temporary)
        temporary.chmod(0o666 & ~_umask())
        os.replace(temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        raise FileError(f"{str(path)[:300]} cannot be written: {error.strerror or error}", path=path) from error
    finally:
        if temporary is not None:
            with deferred_signals():
                temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_folder(path: str | Path, *, force: bool = False, stale: Iterable[str] = ()) -> Iterator[Path]:
    """A temporary folder beside `path`; on leaving without error its files are those of `path`, all or none.

    stale: names of an earlier result in `path` that go where this one does not have them.  All other files stay.
    Files of the same name are overwritten only with `force`; FileError says which is in the way, before anything moved.
    A second writer of the same folder is refused.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        if path.exists():
            path = path.resolve()
        if os.path.lexists(path) and not path.is_dir():
            raise FileError(f"{path} is a file or a link to nothing; a folder is needed", path=path)
        with only_writer(path):
            place = _beside(path)
            remove_leftovers(place)
            temporary = Path(tempfile.mkdtemp(prefix=_prefix(path), dir=place))
            yield temporary
            made = sorted(p.relative_to(temporary) for p in temporary.rglob("*") if p.is_file())
            for name in made:
                require_absent(path / name, force=force)
            for name in made:
                _sync(temporary / name)
            temporary.chmod(0o777 & ~_umask())
            with deferred_signals():
                _take_the_place(path, temporary, made, {Path(name) for name in stale})
            sync_folder(place)
    except OSError as error:
        raise FileError(f"{str(path)[:300]} cannot be written: {error.strerror or error}", path=path) from error
    finally:
        if temporary is not None:
            with deferred_signals():
                shutil.rmtree(temporary, ignore_errors=True)


def _beside(folder: Path) -> Path:
    """Where temporary names of a folder are made: beside it, or in it where only that can be written."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    return folder if folder.is_dir() and not os.access(folder.parent, os.W_OK) else folder.parent


def _take_the_place(path: Path, new: Path, made: list[Path], stale: set[Path]) -> None:
    """Rename the new folder to the old one's name, in one step where the system can."""
    if not path.exists():
        os.rename(new, path)
        return
    kept = [p.relative_to(path) for p in path.rglob("*") if not p.is_dir() or p.is_symlink()]
    if _may_be_swapped(path):
        with contextlib.suppress(OSError):
            for name in kept:
                if name not in stale and name not in made:
                    (new / name).parent.mkdir(parents=True, exist_ok=True)
                    os.link(path / name, new / name, follow_symlinks=False)
            for folder in (p for p in path.rglob("*") if p.is_dir() and not p.is_symlink()):
                if not any(folder.iterdir()):
                    (new / folder.relative_to(path)).mkdir(parents=True, exist_ok=True)
            shutil.copymode(path, new)
            sync_folder(new)
            if _exchanged(new, path):
                return
    for name in made:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(new / name, path / name)
    for name in stale.difference(made):
        (path / name).unlink(missing_ok=True)
    sync_folder(path)


def _may_be_swapped(path: Path) -> bool:
    """Not where somebody works inside it or a disk is mounted on it: their folder would be another one afterwards."""
    here = Path.cwd()
    return not (here == path or path in here.parents or os.path.ismount(path)) and _beside(path) == path.parent


def _exchanged(new: Path, old: Path) -> bool:
    """Swap two folders' names in one step; False where the system cannot."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    ends = AT_WORKING_FOLDER, os.fsencode(new), AT_WORKING_FOLDER, os.fsencode(old)
    return int(rename(ends[0], ends[1], ends[2], ends[3], EXCHANGE)) == 0


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Holds a folder for one writer; FileError names the process that holds it already.

    The lock is a file beside the folder that the system frees when its process ends, however it ends.
    """
    try:
        import fcntl
    except ImportError:  # not a POSIX system
        yield
        return
    _require_place(folder)
    folder = folder.resolve()
    lock = _beside(folder) / f".{folder.name[:100]}.writing"
    while True:
        try:
            handle = os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
        except OSError as error:
            raise FileError(f"{str(folder)[:300]} cannot be written: {error.strerror}", path=folder) from error
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            who = os.read(handle, 200).decode(errors="replace").strip() or "another process"
            os.close(handle)
            raise FileError(
                f"{folder} is being written by {who}; wait until it ends, or give another folder", path=folder
            ) from error
        except OSError:  # a file system without locks
            os.close(handle)
            handle = -1
            break
        with contextlib.suppress(FileNotFoundError):
            if os.fstat(handle).st_ino == os.stat(lock).st_ino:
                break
        os.close(handle)  # the file was removed between: another writer has just ended
    try:
        if handle >= 0:
            os.ftruncate(handle, 0)
            os.pwrite(handle, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)
        yield
    finally:
        if handle >= 0:
            lock.unlink(missing_ok=True)
            os.close(handle)


@contextlib.contextmanager
def deferred_signals() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait until the block is left, so that a swap of several names is not cut in two."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, FrameType | None]] = []
    before = {int(s): signal.signal(s, lambda number, frame: came.append((number, frame))) for s in _INTERRUPTS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number, frame in came[:1]:
            handler = before[number]
            if callable(handler):
                handler(number, frame)
            elif handler == signal.SIG_DFL:
                os.kill(os.getpid(), number)


_INTERRUPTS = (signal.SIGINT, signal.SIGTERM)


def _prefix(path: Path) -> str:
    return f".{path.stem[:40]}-{_host()}-{os.getpid()}-{_start_of(os.getpid())}-"


def _host() -> str:
    return "".join(c if c.isalnum() else "_" for c in socket.gethostname())[:32]


def _start_of(process: int) -> str:
    """When a process began, in the system's ticks: its number alone is given again.  "0" where the system does not
    say."""
    try:
        return (
            Path(f"/proc/{process}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()[19]
        )
    except (OSError, IndexError):
        return "0"


def remove_leftovers(folder: Path) -> None:
    """Remove what killed runs left in a folder under temporary names; what a living process writes stays."""
    name = re.compile(rf"\..*-{re.escape(_host())}-(\d+)-(\d+)-[^-]*")
    with contextlib.suppress(OSError):
        for found in folder.iterdir():
            known = name.fullmatch(found.name)
            if known is None or _lives(int(known[1]), known[2]):
                continue
            if found.is_dir() and not found.is_symlink():
                shutil.rmtree(found, ignore_errors=True)
            else:
                found.unlink(missing_ok=True)


@functools.lru_cache(maxsize=1000)
def _remove_leftovers_once(folder: Path) -> None:
    """For folders of a thousand images: once a process is enough."""
    remove_leftovers(folder)


def _lives(process: int, start: str) -> bool:
    if start == "0":
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return False
        except OSError:
            return True
        return True
    return _start_of(process) == start


def _umask() -> int:
    umask = os.umask(0)
    os.umask(umask)
    return umask


def _sync(file: Path) -> None:
    with open(file, "rb+") as stream:
        os.fsync(stream.fileno())


def sync_folder(folder: Path) -> None:
    """Flush a folder's list of names to the disk, so that a rename outlives a power cut; where the system allows it."""
    with contextlib.suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
