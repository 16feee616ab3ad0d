"""Kill programs that write at random moments: what they leave is the whole old result or the whole new one.

    python benchmarks/fuzz/kills.py --kills 200 --seed 1 [--only calibrate,export] [--log kills.jsonl]

Four writers of the library and the verbs of `verbs.py` take turns.  A program writes two states of a result in turn,
over and over, until a signal (KILL, TERM or INT) ends it.  Then the result must be one of the two, the next run must
succeed, and nothing of the killed one may stay beside it.  Each kill has a generator of its own, and its row is printed
as it is found: with --log, an interrupted run continues after the last row.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from verbs import essence, prepare, verbs

import tomopose as tp
from tomopose.exports.folder import export
from tomopose.files import atomic_folder, write_json, write_text
from tomopose.io.volume_files import write_volume

LONGEST = 0.4
"""Latest moment of a kill after both states were written once, s."""
RESUMED = ("simulate",)
"""Verbs that write a file at a time and continue where they stopped: a next run must come to the whole result."""
GOOD = ("old", "new", "resumed")
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def geometry(state: int) -> tp.ProjectionMatrices:
    """Five views about 300 + state mm from the source."""
    P = np.tile(np.array([[1000.0, 0, 10, 1e5], [0, 1000.0, 20, 1e5], [0, 0, 1.0, 300.0 + state]]), (5, 1, 1))
    return tp.ProjectionMatrices(P=P, n_u=101, n_v=103, p_u=0.2, p_v=0.2, pose_id=tuple("abcde"))


def write_exports(folder: Path, state: int) -> None:
    formats = ["leap", "cil", "pyronn"] if state else ["leap", "cil", "cera"]
    export(geometry(state), folder / "out", formats=formats, force=True)


def write_results(folder: Path, state: int) -> None:
    with atomic_folder(folder / "out", force=True, stale=("only-0.csv", "only-1.csv")) as made:
        write_json(made / "study.json", "study", {"state": state, "values": list(range(2000))})
        write_text(made / "table.csv", f"{state}\n" * 2000)
        write_text(made / f"only-{state}.csv", f"{state}\n")


def write_matrices(folder: Path, state: int) -> None:
    tp.write_matrices(folder / "out.npz", geometry(state), force=True)


def write_hdf5_volume(folder: Path, state: int) -> None:
    grid = tp.VoxelGrid(shape=(20, 60, 60), spacing=0.1)
    write_volume(folder / "out.h5", tp.Volume(values=np.full(grid.shape, state, np.float32), grid=grid), force=True)


WRITERS: dict[str, Callable[[Path, int], None]] = {
    "exports": write_exports,
    "results": write_results,
    "matrices": write_matrices,
    "volume": write_hdf5_volume,
}

INPUTS = Path(tempfile.gettempdir()) / f"tomopose-kills-{os.getuid()}"
"""What the verbs read; made once, before the first kill."""
WRITERS |= verbs(INPUTS)

PROGRAM = """
import itertools, signal, sys
sys.path[:0] = [sys.argv[1]]
from pathlib import Path
import kills
from tomopose.cli.main import Terminated
def end(number, frame):
    raise Terminated
signal.signal(signal.SIGTERM, end)
signal.signal(signal.SIGINT, signal.default_int_handler)  # a program in the background inherits that it is ignored
write, folder = kills.WRITERS[sys.argv[2]], Path(sys.argv[3])
try:
    for k in itertools.count():
        print(k, file=sys.__stdout__, flush=True)
        write(folder, k % 2)
except KeyboardInterrupt:
    pass
"""


def content(folder: Path) -> dict[str, str]:
    """SHA-256 of what every file says, by name; the manifest's digests follow from the files beside it."""
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p.name != "manifest.json")
    return {p.relative_to(folder).as_posix(): _digest(p) for p in files}


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(essence(path).encode()).hexdigest()
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:  # part of a file, which no state is
        return f"unreadable: {error}"


def visible(folder: Path) -> dict[str, str]:
    """Without files and folders under temporary names."""
    return {name: digest for name, digest in content(folder).items() if not name.startswith(".") and "/." not in name}


def differences(found: dict[str, str], states: list[dict[str, str]]) -> list[str]:
    """The files in which something found differs from each state, at most four of each."""
    return [str(sorted(dict(found.items() ^ state.items()))[:4]) for state in states]


def kill_once(name: str, folder: Path, rng: random.Random) -> tuple[str, str]:
    """One kill: the signal, and "old" or "new" whole, "resumed", or what is wrong with what was left."""
    states = []
    for state in (0, 1):
        fresh = folder / f"fresh-{state}"  # as deep as `killed`: a result may name its inputs relative to itself
        fresh.mkdir()
        WRITERS[name](fresh, state)
        states.append(visible(fresh))
    place = folder / "killed"
    place.mkdir()
    command = [sys.executable, "-c", PROGRAM, str(Path(__file__).parent), name, str(place)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        while program.stdout.readline().strip() != b"2":  # both states were written once
            assert program.poll() is None, "the program ended before it was killed"
        time.sleep(rng.uniform(0, LONGEST))
        number = rng.choice(SIGNALS)
        program.send_signal(number)
        begun = [int(line) for line in program.stdout.read().split() if line.isdigit()]
        program.wait()
    return number.name, left_by(name, place, states, number, max(begun, default=2) % 2)


def left_by(name: str, place: Path, states: list[dict[str, str]], number: signal.Signals, writing: int) -> str:
    """What a program left that was killed while it wrote states[writing]."""
    found = visible(place)
    if name not in RESUMED and found not in states:
        return f"a mixture: {differences(found, states)}"
    if name in ("exports", "export"):
        tp.read_geometry(place / "out")
    if number != signal.SIGKILL and set(content(place)) != set(found):
        return f"temporary files after {number.name}: {sorted(set(content(place)) - set(found))}"
    WRITERS[name](place, 1)
    left = sorted(p.name for p in place.rglob(".*"))
    if left or visible(place) != states[1]:
        return f"the next run left {left}, or another result: {differences(visible(place), states[1:])}"
    return "resumed" if found not in states else "new" if found == states[writing] else "old"


def read_log(path: Path | None) -> list[dict[str, object]]:
    """The kills of an interrupted run.  A line that was cut off is taken out of the log, and its kill is repeated."""
    rows: list[dict[str, object]] = []
    if path is not None and path.exists():
        for line in path.read_text().splitlines():
            with contextlib.suppress(ValueError):
                rows.append(json.loads(line))
        path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="writers by name, as a,b; default: all")
    parser.add_argument("--log", type=Path, help="a line for each kill; those in it are not repeated")
    args = parser.parse_args()
    wanted = [name for name in WRITERS if not args.only or name in args.only.split(",")]
    done = read_log(args.log)
    prepare(INPUTS)
    found: dict[str, Counter[str]] = {name: Counter() for name in wanted}
    signals: Counter[str] = Counter()
    for k in range(args.kills):
        row = {"seed": args.seed, "kill": k, "writer": wanted[k % len(wanted)]}
        before = next((r for r in done if row.items() <= r.items()), None)
        if before is None:
            began = time.monotonic()
            with tempfile.TemporaryDirectory() as root:
                number, what = kill_once(str(row["writer"]), Path(root), random.Random(f"{args.seed} {k}"))
            before = {**row, "signal": number, "left": what, "s": round(time.monotonic() - began, 1)}
            print(json.dumps(before), flush=True)
            if args.log:
                with args.log.open("a") as log:
                    log.write(json.dumps(before) + "\n")
        found[str(row["writer"])][str(before["left"])] += 1
        signals[str(before["signal"])] += 1
    print(f"{'writer':14s} whole old  whole new    resumed  a mixture or worse")
    found["all"] = sum(found.values(), Counter())
    for name, count in found.items():
        wrong = sum(n for what, n in count.items() if what not in GOOD)
        print(f"{name:14s}{count['old']:10d}{count['new']:11d}{count['resumed']:11d}{wrong:20d}")
    print(", ".join(f"{n} {name}" for name, n in sorted(signals.items())))
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
