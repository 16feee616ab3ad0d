"""Mutants of every kind of file through their readers: exceptions that are not ours, hangs, and growth of memory.

    python benchmarks/fuzz/run.py --minutes 10 --seed 1 [--kinds scanner,tiff] [--keep FOLDER]

Each kind of file is read in forked processes, a batch of mutants each, so that a hang or a crash costs one mutant and
is counted.  What fails is kept in --keep as KIND--EXCEPTION--NN with the place that raised it in index.json.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from corpus import GROUPS, Seed, corpus
from mutants import mutant

from tomopose.errors import TomoposeError

BATCH = 100
HANG_SECONDS, STILL_SECONDS = 60.0, 900.0
"""A mutant hangs after so many processor seconds, or so many by the clock: other work may hold the processors."""
GROWTH = 2**30


@dataclass
class Count:
    """What became of the mutants of all kinds."""

    mutants: int = 0
    read: int = 0
    refused: int = 0
    foreign: Counter[str] = field(default_factory=Counter)
    hangs: Counter[str] = field(default_factory=Counter)
    crashes: Counter[str] = field(default_factory=Counter)
    grown: Counter[str] = field(default_factory=Counter)


def one(seed: Seed, content: bytes, folder: Path) -> tuple[str, str]:
    """What a reader makes of one mutant: ("read" | "refused" | "foreign" | "grown", what and where)."""
    path = folder / seed.path.name
    path.write_bytes(content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        seed.read(path)
        found = ("read", "")
    except TomoposeError as error:
        found = ("refused", str(error))
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        found = ("foreign", f"{type(error).__name__} {Path(last.filename).name}:{last.lineno} {str(error)[:100]}")
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    return ("grown", f"{grown / 1e9:.2f} GB") if grown > GROWTH else found


def batch(seed: Seed, numbers: range, name: str, folder: Path, send: int) -> None:
    """In a forked process: each mutant's number before it is read, and what became of it afterwards."""
    warnings.simplefilter("ignore")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    for k in numbers:
        os.write(send, json.dumps((k, "begun", "")).encode() + b"\n")
        content = mutant(seed.path.read_bytes(), random.Random(f"{name} {seed.kind} {k}"))
        os.write(send, json.dumps((k, *one(seed, content, folder))).encode() + b"\n")


def processor_seconds(process: int) -> float:
    """What a process has used so far; 0 where the system does not say."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        fields = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return 0.0


def run_batch(seed: Seed, numbers: range, name: str, folder: Path) -> dict[int, tuple[str, str]]:
    """What became of each mutant of a batch; one that hangs or crashes ends it."""
    receive, send = os.pipe()
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            batch(seed, numbers, name, folder, send)
        os._exit(0)
    os.close(send)
    found: dict[int, tuple[str, str]] = {}
    left = b""
    since, used = time.monotonic(), 0.0
    while True:
        ready, _, _ = select.select([receive], [], [], 5.0)
        if not ready:
            if processor_seconds(child) - used < HANG_SECONDS and time.monotonic() - since < STILL_SECONDS:
                continue
            os.kill(child, signal.SIGKILL)
            found[max((k for k, (what, _) in found.items() if what == "begun"), default=numbers[0])] = ("hang", "")
            break
        since, used = time.monotonic(), processor_seconds(child)
        piece = os.read(receive, 1 << 16)
        if not piece:
            break
        *lines, left = (left + piece).split(b"\n")
        for line in lines:
            k, what, why = json.loads(line)
            found[k] = (what, why)
    os.close(receive)
    _, status = os.waitpid(child, 0)
    for k, (what, _) in found.items():
        if what == "begun":
            found[k] = ("crash", f"signal {status & 0x7F}")
    return found


def keep(
    seed: Seed, k: int, name: str, what: str, why: str, kept: Path | None, index: dict[str, dict[str, str]]
) -> None:
    """Store a mutant that failed, once for each kind and place."""
    place = " ".join(why.split()[:2])
    if kept is None or any((e["kind"], e["place"]) == (seed.kind, place) for e in index.values()):
        return
    kept.mkdir(parents=True, exist_ok=True)
    label = f"{seed.kind.replace(' ', '-')}--{(why.split() or [what])[0]}--{len(index):02d}{seed.path.suffix}"
    content = mutant(seed.path.read_bytes(), random.Random(f"{name} {seed.kind} {k}"))
    (kept / label).write_bytes(content)
    index[label] = {"kind": seed.kind, "what": what, "place": place, "why": why}
    (kept / "index.json").write_text(json.dumps(index, indent=1))


def fuzz(
    *,
    minutes: float,
    name: str,
    kinds: tuple[str, ...] = (),
    kept: Path | None = None,
    most: int = 0,
    groups: tuple[str, ...] = GROUPS,
) -> Count:
    """Mutants of all kinds in turn until the time is over, or `most` of each kind are read."""
    count, index = Count(), {}
    end = time.monotonic() + 60 * minutes
    with tempfile.TemporaryDirectory() as root:
        seeds = [s for s in corpus(Path(root) / "seeds", groups) if not kinds or s.kind.startswith(kinds)]
        for number, seed in enumerate(seeds):
            place = Path(root) / str(number)
            place.mkdir()
            for path in seed.beside:
                if path.is_file():
                    shutil.copy(path, place / path.name)
            one(seed, seed.path.read_bytes(), place)  # what is compiled or imported once is not the mutants' growth
        begun, first = dict.fromkeys(range(len(seeds)), 0), 0
        while time.monotonic() < end and (not most or first < most):
            for number, seed in enumerate(seeds):
                start = begun[number]
                size = min(BATCH, most - start) if most else BATCH
                if size <= 0 or time.monotonic() > end:
                    continue
                numbers = range(start, start + size)
                while numbers:
                    found = run_batch(seed, numbers, name, Path(root) / str(number))
                    for k, (what, why) in found.items():
                        count.mutants += 1
                        if what in ("read", "refused"):
                            setattr(count, what, getattr(count, what) + 1)
                            continue
                        counter = {"foreign": count.foreign, "hang": count.hangs, "crash": count.crashes}.get(
                            what, count.grown
                        )
                        counter[f"{seed.kind}: {why}"] += 1
                        keep(seed, k, name, what, why, kept, index)
                    numbers = range(max(found, default=numbers[0]) + 1, numbers.stop)
                begun[number] = start + size
            first = min(begun.values())
    return count


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", default="1")
    parser.add_argument("--kinds", default="")
    parser.add_argument("--most", type=int, default=0, help="mutants of each kind; 0: until the time is over")
    parser.add_argument("--keep", type=Path)
    args = parser.parse_args()
    kinds = tuple(k for k in args.kinds.split(",") if k)
    count = fuzz(minutes=args.minutes, name=args.seed, kinds=kinds, kept=args.keep, most=args.most)
    print(f"{count.mutants} mutants: {count.read} read, {count.refused} refused by name")
    for title, found in (
        ("foreign exceptions", count.foreign),
        ("hangs", count.hangs),
        ("crashes", count.crashes),
        ("grown by more than 1 GiB", count.grown),
    ):
        print(f"{sum(found.values())} {title}, {len(found)} different")
        for why, times in found.most_common(60):
            print(f"  {times:5d}  {why}")
    return int(bool(count.foreign or count.hangs or count.crashes or count.grown))


if __name__ == "__main__":
    sys.exit(main())
