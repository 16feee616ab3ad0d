"""Study section6 at a size between its two scales: page, JSON and pictures as `tomopose study` writes them.

    python benchmarks/section6/run.py --out OUT --binning 5 4 --views 360 500 --edge 0.35 --runs 1

An interrupted run continues where it stopped when it is called again with the same folder and numbers.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from tomopose.provenance import provenance
from tomopose.studies.parts.result import DEFAULT_SEED, StudyResult
from tomopose.studies.parts.steps import Steps
from tomopose.studies.parts.writing import write_study
from tomopose.studies.registry import PAPER
from tomopose.studies.section6 import study as section6
from tomopose.studies.section6.scan import Numbers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--binning", type=int, nargs=2, default=(5, 4), help="of specimen and standard")
    parser.add_argument("--views", type=int, nargs=2, default=(360, 500), help="of specimen and standard")
    parser.add_argument("--edge", type=float, default=0.35, help="longest side of a triangle, mm")
    parser.add_argument("--runs", type=int, nargs="+", default=(1, 2), help="calibration runs used")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED)
    given = parser.parse_args()
    numbers = Numbers(
        binning=dict(zip(section6.THINGS, given.binning, strict=True)),
        views=dict(zip(section6.THINGS, given.views, strict=True)),
        runs=dict.fromkeys(section6.THINGS, tuple(given.runs)),
        edge=given.edge,
        samples=2,
        radiographs=True,
    )
    begin, cpu = time.perf_counter(), time.process_time()
    steps = Steps(folder=given.out / "steps", key={"study": "section6", "seed": given.seed})
    shown = -1

    def progress(done: int, total: int) -> None:
        nonlocal shown
        if 100 * done // total > shown:
            shown = 100 * done // total
            print(f"{shown} %, {time.process_time() - cpu:.0f} s of processor time", flush=True)

    rows, checks, figures, notes = section6.run_with(numbers, given.seed, steps, progress)
    scale = f"{given.binning[0]} x and {given.binning[1]} x binned, {given.views[0]} and {given.views[1]} views"
    result = StudyResult(
        name="section6",
        title=section6.TITLE,
        paper=PAPER["section6"],
        question=section6.QUESTION,
        scale=scale,
        seed=given.seed,
        rows=tuple(rows),
        checks=tuple(checks),
        figures=tuple(figures),
        notes=tuple(notes),
        seconds=time.perf_counter() - begin,
        provenance=provenance(arguments=vars(given), seed=given.seed),
    )
    write_study(given.out, result, force=True)
    for check in checks:
        print(f"{'holds' if check.holds else 'DOES NOT HOLD'}: {check.statement}: {check.found}")


if __name__ == "__main__":
    main()
