"""A simulated run to files: 16-bit TIFF or HDF5, poses.csv, scanner.json, truth.json; resumable, several at once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

from tomopose.cli.common import Progress

RADIOGRAPHS, STACK = "radiographs", "radiographs.h5"


def run_of(scene: Any, path: Path) -> Any:
    """The run of the scene that was read from that path, its poses from the table that it names, if it names one."""
    import tomopose as tp

    table = scene.poses.file
    return tp.simulate(scene, poses=tp.read_poses(path.parent / table) if table else None)


def image_names(pose_ids: Iterable[str]) -> list[str]:
    """pose_0000.tif ...: numbered so that every sorting gives the acquisition's order."""
    return [f"pose_{k:04d}.tif" for k, _ in enumerate(pose_ids)]


def frames(run: Any, wanted: Sequence[int], *, workers: int = 1, client: Any = None) -> Iterator[tuple[int, Any]]:
    """(number, image) of the wanted frames, in order, made by threads here or by a dask client's workers."""
    from tomopose.detection.run.executors import ordered_map

    if client is not None:
        # The run travels once to each worker, not with every frame.
        there = client.scatter(run, broadcast=True, hash=False)
        for (_, k), image in ordered_map(_image, [(there, k) for k in wanted], executor=client):
            yield k, image
        return
    # Threads, not processes: the kernels release the interpreter, and nothing has to be compiled or loaded twice.
    with ThreadPoolExecutor(max_workers=workers) as pool:
        tasks = [(run, k) for k in wanted]
        for (_, k), image in ordered_map(_image, tasks, workers=workers, executor=pool if workers > 1 else None):
            yield k, image


def _image(run: Any, k: int) -> Any:
    return run.image(k)


def write_run(
    out: Path,
    run: Any,
    *,
    inputs: Iterable[Path] = (),
    form: str = "tiff",
    workers: int = 1,
    client: Any = None,
    resume: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> None:
    """Tables first, then the images one by one: TIFF files, each whole or absent, or the stack of one HDF5 file, which
    bears another name until it is whole.  Both can be resumed."""
    import tomopose as tp
    from tomopose.errors import InputError
    from tomopose.files import require_absent, write_json
    from tomopose.io.images.stack import append_hdf5, frames_kept
    from tomopose.provenance import provenance

    n, rows = len(run), run.scanner.image_rows
    stack = out / STACK
    names = image_names(run.poses.pose_id) if form == "tiff" else [f"{STACK}[{k}]" for k in range(n)]
    paths = [out / RADIOGRAPHS / name for name in names] if form == "tiff" else [stack]
    tables = [out / name for name in ("scanner.json", "poses.csv", "truth.json")]
    for path in (*tables, *(paths if not resume else ())):
        require_absent(path, force=force or resume)
    tp.write_scanner(tables[0], run.scanner, force=True)
    tp.write_poses(tables[1], replace(run.poses, image=tuple(names)), force=True)
    made = provenance(inputs=inputs, seed=run.seed)
    write_json(tables[2], "truth", {**run.truth(), "provenance": made.to_json()})

    def told(finished: int) -> None:
        if progress is not None:
            progress(finished, n)

    if form == "hdf5":
        kept = frames_kept(stack) if resume else 0
        if resume and stack.exists() and kept != n:
            raise InputError(f"{stack} is whole with {kept} frames; this scene has {n}: it cannot be gone on with")
        told(kept)
        if kept < n:
            made_now = frames(run, range(kept, n), workers=workers, client=client)
            append_hdf5(stack, _told(made_now, kept, told), kept, rows)
        return
    missing = [k for k, path in enumerate(paths) if not (resume and path.exists())]
    done = n - len(missing)
    told(done)
    for k, image in _told(frames(run, missing, workers=workers, client=client), done, told):
        tp.write_tiff(paths[k], image, rows=rows, force=True)


def _told(made: Iterator[tuple[int, Any]], done: int, told: Callable[[int], None]) -> Iterator[tuple[int, Any]]:
    """The same frames; each is told of once the next is asked for, when it is written."""
    for finished, frame in enumerate(made, start=done + 1):
        yield frame
        told(finished)
