"""Declared sizes against what there is: nothing is allocated for a size that a file only claims."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from tomopose.errors import FileError

MOST_UNPROVEN = 128 * 2**20
"""Bytes that a file may claim whatever its own length: a blank radiograph, well compressed."""
LARGEST_RATIO = 2000
"""Claimed bytes for each byte in the file beyond that; deflate reaches 1032, LZW 1365, PackBits 64."""
SHARE_OF_FREE = 0.8


def available_bytes() -> int | None:
    """Memory that is free for this process, in bytes, where the system reports it; None elsewhere.

    The least of the machine's free memory, the control group's and this process's own limit.
    """
    found = [_free_memory(), _free_in_group(), _free_in_limit()]
    known = [n for n in found if n is not None]
    return min(known) if known else None


def _free_memory() -> int | None:
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return None


def _free_in_group() -> int | None:
    """What a container may still use, by version 2 of Linux control groups."""
    group = Path("/sys/fs/cgroup")
    with contextlib.suppress(OSError, ValueError):
        most = (group / "memory.max").read_text(encoding="ascii").strip()
        if most != "max":
            used = int((group / "memory.current").read_text(encoding="ascii"))
            stats = (group / "memory.stat").read_text(encoding="ascii").split()
            cache = int(stats[stats.index("inactive_file") + 1])
            return max(int(most) - used + cache, 0)
    return None


def _free_in_limit() -> int | None:
    """What `ulimit -v` leaves."""
    with contextlib.suppress(ImportError, OSError, ValueError, AttributeError):
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[0]
        if most != resource.RLIM_INFINITY:
            pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            return max(most - pages * os.sysconf("SC_PAGE_SIZE"), 0)
    return None


def require_plausible(path: Path | str, what: str, claimed: int, stored: int) -> None:
    """FileError where something claims a size that its bytes in the file cannot hold, or that memory cannot.

    what: names it ("a frame of 60000 x 60000 uint16").  claimed, stored: bytes in memory, and in the file.
    """
    require_held(path, what, claimed, stored)
    require_memory(path, what, claimed)


def require_held(path: Path | str, what: str, claimed: int, stored: int) -> None:
    """FileError where something claims a size that its bytes in the file cannot hold."""
    if claimed > MOST_UNPROVEN and claimed > LARGEST_RATIO * max(stored, 1):
        raise FileError(
            f"{path}: {what} would take {in_gigabytes(claimed)}, but only {stored} bytes of the file belong to it; the "
            "file is damaged",
            path=path,
        )


def require_memory(path: Path | str, what: str, claimed: int) -> None:
    """FileError where memory for that many bytes is not free."""
    free = available_bytes()
    if claimed > MOST_UNPROVEN and free is not None and claimed > SHARE_OF_FREE * free:
        raise FileError(
            f"{path}: {what} would take {in_gigabytes(claimed)} of memory; {in_gigabytes(free)} are free", path=path
        )


def in_gigabytes(count: int) -> str:
    """Bytes for people."""
    return f"{count / 1e9:.3g} GB" if count >= 1e8 else f"{count / 1e6:.3g} MB"
