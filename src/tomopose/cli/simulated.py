"""A simulated run to files: 16-bit TIFF or HDF5, poses.csv, scanner.json, truth.json; resumable, several at once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomopose.cli.common import Progress

if TYPE_CHECKING:
    from dask.distributed import Client

    from tomopose.kept import Key
    from tomopose.simulation.run import SimulatedRun
    from tomopose.simulation.scene.scene import Scene

RADIOGRAPHS, STACK = "radiographs", "radiographs.h5"


def run_of(scene: Scene, path: Path) -> Any:
    """The run of the scene that was read from that path, its poses from the table that it names, if it names one."""
    import tomopose as tp

    table = scene.poses.file
    return tp.simulate(scene, poses=tp.read_poses(path.parent / table) if table else None)


def image_names(pose_ids: Iterable[str]) -> list[str]:
    """pose_0000.tif ...: numbered so that every sorting gives the acquisition's order."""
    return [f"pose_{k:04d}.tif" for k, _ in enumerate(pose_ids)]


def frames(
    run: SimulatedRun, wanted: Sequence[int], *, workers: int = 1, client: Client | None = None
) -> Iterator[tuple[int, Any]]:
    """(number, image) of the wanted frames, in order, made by threads here or by a dask client's workers."""
    from tomopose.detection.run.executors import ordered_map

    if client is not None:
        # The run travels once to each worker, not with every frame.
        there = client.scatter(run, broadcast=True, hash=False)  # type: ignore[no-untyped-call]
        for (_, k), image in ordered_map(_image, [(there, k) for k in wanted], executor=client):
            yield k, image
        return
    # Threads, not processes: the kernels release the interpreter, and nothing has to be compiled or loaded twice.
    with ThreadPoolExecutor(max_workers=workers) as pool:
        tasks = [(run, k) for k in wanted]
        for (_, k), image in ordered_map(_image, tasks, workers=workers, executor=pool if workers > 1 else None):
            yield k, image


def _image(run: SimulatedRun, k: int) -> Any:
    return run.image(k)


def write_run(
    out: Path,
    run: SimulatedRun,
    *,
    inputs: Iterable[Path] = (),
    form: str = "tiff",
    workers: int = 1,
    client: Client | None = None,
    resume: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> None:
    """Tables first, then the images one by one: TIFF files, each whole or absent, or the stack of one HDF5 file, which
    has another name until it is complete.

    truth.json holds the run's key.  Images that are there already stay only where it is this run's (`resume`); those of
    another run are removed before anything of this one is written, so that the folder never mixes two.
    """
    from tomopose.atomic import only_writer

    with only_writer(out):
        _write_run(
            out, run, inputs=inputs, form=form, workers=workers, client=client, resume=resume, force=force,
            told=progress or (lambda finished, n: None),
        )  # fmt: skip


def _write_run(
    out: Path,
    run: SimulatedRun,
    *,
    inputs: Iterable[Path],
    form: str,
    workers: int,
    client: Client | None,
    resume: bool,
    force: bool,
    told: Progress,
) -> None:
    """As `write_run`, once no other process writes the folder."""
    import tomopose as tp
    from tomopose.files import require_absent, write_json
    from tomopose.io.images.stack import append_hdf5, frames_kept
    from tomopose.provenance import provenance
    from tomopose.simulation.run import run_key

    n, rows = len(run), run.scanner.image_rows
    stack = out / STACK
    names = image_names(run.poses.pose_id) if form == "tiff" else [f"{STACK}[{k}]" for k in range(n)]
    paths = [out / RADIOGRAPHS / name for name in names] if form == "tiff" else [stack]
    tables = [out / name for name in ("scanner.json", "poses.csv", "truth.json")]
    for path in (*tables, *(paths if not resume else ())):
        require_absent(path, force=force or resume)
    key = run_key(run, form=form)
    clear_another_run(out, key, force=force)
    tp.write_scanner(tables[0], run.scanner, force=True)
    tp.write_poses(tables[1], replace(run.poses, image=tuple(names)), force=True)
    made = provenance(inputs=inputs, seed=run.seed)
    write_json(tables[2], "truth", {**run.truth(), "key": key.to_json(), "provenance": made.to_json()})

    if form == "hdf5":
        whole = resume and stack.exists()
        kept = n if whole else frames_kept(stack, key) if resume else 0
        told(kept, n)
        if not whole:
            made_now = frames(run, range(kept, n), workers=workers, client=client)
            append_hdf5(stack, _told(made_now, kept, n, told), count=n, key=key, rows=rows, kept=kept)
        return
    missing = [k for k, path in enumerate(paths) if not (resume and path.exists())]
    done = n - len(missing)
    told(done, n)
    for k, image in _told(frames(run, missing, workers=workers, client=client), done, n, told):
        tp.write_tiff(paths[k], image, rows=rows, force=True)


def clear_another_run(out: Path, key: Key, *, force: bool) -> None:
    """Remove the radiographs of another run from a folder; StartsAnewWarning says what differs.

    FileError where there are radiographs without the key of a simulated run and `force` is not given: they may be
    anybody's.
    """
    from tomopose.errors import FileError
    from tomopose.files import read_json
    from tomopose.io.images.stack import partial, remove_stack
    from tomopose.kept import Key, same_key

    stack = out / STACK
    images = sorted((out / RADIOGRAPHS).glob("pose_*.tif"))
    if not images and not stack.exists() and not partial(stack).exists():
        return
    try:
        kept = Key.from_json(read_json(out / "truth.json", "truth").get("key"))
    except FileError:
        kept = None
    if kept is None and not force:
        raise FileError(
            f"{out} holds radiographs, but no truth.json says which simulated run they belong to; give another folder, "
            "or force=True to replace them",
            path=out,
        )
    if same_key(kept, key, what=f"the simulated run in {out}"):
        return
    for image in images:
        image.unlink(missing_ok=True)
    remove_stack(stack)


def _told(made: Iterator[tuple[int, np.ndarray]], done: int, n: int, told: Progress) -> Iterator[tuple[int, Any]]:
    """The same frames; each is reported once the next is asked for, when it is written."""
    for finished, frame in enumerate(made, start=done + 1):
        yield frame
        told(finished, n)
