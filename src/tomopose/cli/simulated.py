"""A simulated run to files: 16-bit TIFF, poses.csv, scanner.json, truth.json; resumable, several at once."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

from tomopose.cli.common import Progress

RADIOGRAPHS = "radiographs"


def _write_one(run: Any, index: int, path: Path, rows: str) -> None:
    import tomopose as tp

    tp.write_tiff(path, run.image(index), rows=rows)


def image_names(pose_ids: Iterable[str]) -> list[str]:
    """pose_0000.tif ...: numbered so that every sorting gives the acquisition's order."""
    return [f"pose_{k:04d}.tif" for k, _ in enumerate(pose_ids)]


def write_run(
    out: Path,
    run: Any,
    *,
    inputs: Iterable[Path] = (),
    workers: int = 1,
    resume: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> None:
    """Tables first, then the images one by one; each file is whole or absent, so a later run can resume."""
    import tomopose as tp
    from tomopose.files import require_absent, write_json
    from tomopose.provenance import provenance

    names = image_names(run.poses.pose_id)
    paths = [out / RADIOGRAPHS / name for name in names]
    tables = [out / name for name in ("scanner.json", "poses.csv", "truth.json")]
    for path in (*tables, *(paths if not resume else ())):
        require_absent(path, force=force or resume)
    tp.write_scanner(tables[0], run.scanner, force=True)
    tp.write_poses(tables[1], replace(run.poses, image=tuple(names)), force=True)
    made = provenance(inputs=inputs, seed=run.seed)
    write_json(tables[2], "truth", {**run.truth(), "provenance": made.to_json()})
    missing = [(k, path) for k, path in enumerate(paths) if not (resume and path.exists())]
    done = len(paths) - len(missing)

    def told(finished: int) -> None:
        if progress is not None:
            progress(finished, len(paths))

    told(done)
    rows = run.scanner.image_rows
    # Threads, not processes: the kernels release the interpreter, and nothing has to be compiled or loaded twice.
    with ThreadPoolExecutor(max_workers=workers) as pool:
        jobs = [pool.submit(_write_one, run, k, path, rows) for k, path in missing]
        try:
            for job in as_completed(jobs):
                job.result()
                done += 1
                told(done)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
