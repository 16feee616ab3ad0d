"""Reviewing and reporting in figures: new solves, first paint with large radiographs, sizes and times of pages.

    python benchmarks/review/run.py [solve] [paint] [pages] [--images N] [--folder FOLDER]

`paint` writes N (189) radiographs of 4096 x 4096 pixels, sparse on disk (about 1.5 MB each), and removes them; it and
`pages` need a Chromium and Playwright.  Times are of the process's own processor where they say CPU, else of the clock.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import ndtr

import tomopose as tp
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import eq5_matrices, project_ball
from tomopose.geometry.silhouette import silhouette_ellipse
from tomopose.report import calibration_report, matrices_report, observations_report
from tomopose.review.app import Desk, as_json
from tomopose.review.session import Review, begin, decision_about

BALL, DIAMETER, NOISE_PX, SIDE = np.array([3.0, -2.0, 21.0]), 8.0, 0.0146, 4096
ADDRESS = re.compile(r"http://127\.0\.0\.1:\d+/[\w-]+/")


def row(name: str, *values: str) -> None:
    print(f"{name:<64}" + "  ".join(values), flush=True)


def spread(ms: list[float]) -> str:
    return f"median {np.median(ms):.0f}, least {min(ms):.0f}, most {max(ms):.0f} ms"


def run_of(poses: tp.PoseSequence, *, n: int = 2048, spoilt: int = 0) -> tuple[tp.Scanner, tp.BallObservations]:
    """A scanner with n x n pixels, and the centres that it sees, `spoilt` of them off by 1.5 px."""
    p = 0.2 * 2048 / n
    scanner = tp.Scanner(d_SD=1500.0, d_SR=283.5, p_u=p, p_v=p, u_0=n / 2 - 2.6, v_0=n / 2 + 2.8, n_u=n, n_v=n)
    rng = np.random.default_rng(1)
    x = project_ball(scanner, T_HT=mount(), T_MH=poses.T_MH, t=BALL, alpha=poses.alpha)
    x = x + rng.normal(scale=NOISE_PX, size=x.shape)
    x[3 : 3 + 17 * spoilt : 17] += 1.5
    gamma = float(np.arcsin(DIAMETER / 2 / scanner.d_SR))
    found = [silhouette_ellipse(scanner, c, gamma) for c in x]
    centre, a, b, angle = (np.array([e[k] for e in found]) for k in range(4))
    return scanner, tp.BallObservations.from_sigma(
        x, NOISE_PX, pose_id=poses.pose_id, image=tuple(f"{p}.tif" for p in poses.pose_id), x_ellipse=centre,
        semi_major=a, semi_minor=b, angle=angle, ball_diameter=DIAMETER,
    )  # fmt: skip


def mount() -> tp.RigidTransform:
    return tp.RigidTransform.from_angles([0.02, -0.03, 3.05], [2.0, -1.5, 4.0], source=Frame.H, target=Frame.T)


def plans() -> dict[str, tp.PoseSequence]:
    """189 poses: the paper's grid, and the same with the table at two angles."""
    paper = tp.pose_grid(3)
    ids = [f"p{k:03d}" for k in range(len(paper))]
    parts = {"R": paper.T_MH.R, "t": paper.T_MH.t, "source": Frame.M, "target": Frame.H}
    alpha = np.where(np.arange(len(paper)) % 2, np.pi / 2, 0.0)
    return {
        "table still": tp.PoseSequence(T_MH=tp.RigidTransform(**parts), pose_id=ids, alpha=np.zeros(len(paper))),
        "two table angles": tp.PoseSequence(T_MH=tp.RigidTransform(**parts), pose_id=ids, alpha=alpha),
    }


def cpu_ms(work: Callable[[], object]) -> float:
    begun = time.process_time()
    work()
    return 1000.0 * (time.process_time() - begun)


def solve() -> None:
    """CPU time of a calibration with all checks, and of a decision with the new solve and the answer to the page."""
    loop = [cpu_ms(lambda: sum(k * k for k in range(1_000_000))) for _ in range(9)]
    row("a loop of a million squares, for the speed of the machine", spread(loop))
    for name, poses in plans().items():
        for spoilt in (0, 6):
            scanner, seen = run_of(poses, spoilt=spoilt)

            def calibrated(o: tp.BallObservations, scanner: tp.Scanner = scanner, poses: Any = poses) -> tp.Calibration:
                return tp.calibrate(scanner, poses, o)

            calibrated(seen)
            each = [cpu_ms(partial(calibrated, seen)) for _ in range(25)]
            row(f"calibrate, all checks, 189 poses, {name}, {spoilt} spoilt", spread(each))
            with tempfile.TemporaryDirectory() as folder:
                review = begin(seen, poses, (), calibrated)
                desk = Desk(review=review, journal=Path(folder) / "review.jsonl", who="N. Sato", save=lambda r: [])
                each = [cpu_ms(partial(decided, desk, k)) for k in range(5, 30)]
            row("  leave one out: journal, new solve, all checks, answer", spread(each))


def decided(desk: Desk, k: int) -> str:
    decision = decision_about(desk.review, k, "leave-out", who=desk.who)

    def changed(review: Review) -> Review:
        return review.with_decision(decision)

    return bytes(as_json(desk.take(changed)).body).decode()


def write_sparse(path: Path, centre: np.ndarray, radius: float, rng: np.random.Generator) -> None:
    """A TIFF of SIDE x SIDE uint16 of which the rows of the ball alone are on the disk, the others are a hole."""
    half = int(radius) + 40
    u0, v0 = (round(float(c)) - half for c in centre)
    v, u = np.mgrid[v0 : v0 + 2 * half, u0 : u0 + 2 * half]
    level = 40_000 - 30_000 * ndtr((radius - np.hypot(u - centre[0], v - centre[1])) / 0.8)
    crop = np.clip(rng.normal(level, 200.0), 0, 65_535).astype("<u2")
    entries = [(256, 4, SIDE), (257, 4, SIDE), (258, 3, 16), (259, 3, 1), (262, 3, 1), (273, 4, 512), (277, 3, 1),
               (278, 4, SIDE), (279, 4, 2 * SIDE * SIDE)]  # fmt: skip
    head = b"II*\0" + (8).to_bytes(4, "little") + len(entries).to_bytes(2, "little")
    for tag, kind, value in entries:
        head += b"".join(x.to_bytes(k, "little") for x, k in ((tag, 2), (kind, 2), (1, 4), (value, 4)))
    with path.open("wb") as stream:
        stream.write(head + bytes(4))
        stream.truncate(512 + 2 * SIDE * SIDE)
        for k in range(max(0, -v0), min(2 * half, SIDE - v0)):
            part = crop[k, max(0, -u0) : SIDE - u0]
            stream.seek(512 + 2 * ((SIDE - 1 - (v0 + k)) * SIDE + max(u0, 0)))  # rows from the top
            stream.write(part.tobytes())


@contextlib.contextmanager
def reviewing(words: list[str]) -> Iterator[tuple[str, float]]:
    """The address of a review in a process of its own, and the seconds until it was printed."""
    begun = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "tomopose", "review", *words, "--no-browser"], stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        found = ADDRESS.search(process.stdout.readline())
        assert found is not None
        yield found[0], time.perf_counter() - begun
    finally:
        process.terminate()
        process.wait(timeout=60)


@contextlib.contextmanager
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield opened
        opened.close()


DRAWN = """new MutationObserver(() => {
  if (document.querySelector("#picture[data-drawn]") && !window.seen) window.seen = performance.now();
}).observe(document, { subtree: true, childList: true, attributes: true });"""


def paint(folder: Path, count: int) -> None:
    """The review's page with `count` radiographs of 16 megapixels: first paint, first radiograph, all keys' crops."""
    poses = plans()["two table angles"]
    poses = poses.select(np.arange(min(count, len(poses))))
    scanner, seen = run_of(poses, n=SIDE)
    pictures, rng = folder / "radiographs", np.random.default_rng(2)
    pictures.mkdir(parents=True)
    assert seen.semi_major is not None
    for name, centre, radius in zip(seen.image or (), seen.x_D, seen.semi_major, strict=True):
        write_sparse(pictures / name, centre, float(radius), rng)
    on_disk = sum(p.stat().st_blocks for p in pictures.iterdir()) * 512
    whole = sum(p.stat().st_size for p in pictures.iterdir())
    row(f"{len(poses)} radiographs of {SIDE} x {SIDE}", f"{whole / 1e9:.2f} GB, {on_disk / 1e9:.2f} GB on the disk")
    tp.write_scanner(folder / "scanner.json", scanner)
    tp.write_poses(folder / "poses.csv", poses)
    tp.write_observations(folder / "observations.csv", seen)
    given = [f"--{n}={folder / f}" for n, f in (("scanner", "scanner.json"), ("poses", "poses.csv"))]
    cal = folder / "cal"
    subprocess.run(
        [sys.executable, "-m", "tomopose", "calibrate", *given, f"--observations={folder / 'observations.csv'}",
         f"--out={cal}", "--ball-diameter-mm=8", "--quiet"], check=False,
    )  # fmt: skip
    with reviewing([str(cal), f"--images={pictures}"]) as (address, seconds), browser() as opened:
        row("from the command to the address (imports, reading, first solve)", f"{seconds:.2f} s")
        firsts, pictures_at, moves = [], [], []
        for _ in range(5):
            page = opened.new_context(viewport={"width": 1400, "height": 900}).new_page()
            page.add_init_script(DRAWN)
            page.goto(address)
            page.wait_for_selector("#picture[data-drawn]")
            firsts.append(page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime"))
            pictures_at.append(page.evaluate("window.seen"))
            for _ in range(20):
                before, begun = page.locator("#picture").get_attribute("data-drawn"), time.perf_counter()
                page.keyboard.press("j")
                page.wait_for_selector(f"#picture[data-drawn]:not([data-drawn='{before}'])")
                moves.append(1000 * (time.perf_counter() - begun))
            page.close()
        row("first paint", spread(firsts))
        row("first radiograph drawn with its silhouette", spread(pictures_at))
        row("next detection by key, its radiograph drawn", spread(moves))


def pages(folder: Path) -> None:
    """Sizes of reports, and the time until the DOM is ready and until the first paint."""
    poses = plans()["two table angles"]
    scanner, seen = run_of(poses, spoilt=3)
    cal = tp.calibrate(scanner, poses, seen)
    alpha = np.linspace(0, 2 * np.pi, 900, endpoint=False)
    tilted = np.column_stack([4 * np.cos(7 * alpha), 4 * np.sin(7 * alpha), 0 * alpha])
    scan = tp.PoseSequence.from_table(np.zeros((900, 3)), tilted, alpha=alpha)
    matrices = tp.projection_matrices(cal, scan)
    assert matrices.P.shape == eq5_matrices(scanner, T_HT=mount(), T_MH=scan.T_MH, alpha=alpha).shape
    made = {
        "calibration, 189 poses, scan of 900 views": calibration_report(
            cal, observations=seen, poses=poses, scan=matrices
        ),
        "observations, 189": observations_report(seen),
        "matrices, 900 views": matrices_report(matrices),
    }
    with browser() as opened:
        for name, html in made.items():
            path = folder / "page.html"
            path.write_text(html, encoding="utf-8")
            ready, first = [], []
            for _ in range(5):
                page = opened.new_page()
                page.goto(path.as_uri())
                page.wait_for_timeout(300)
                ready.append(page.evaluate("performance.getEntriesByType('navigation')[0].domContentLoadedEventEnd"))
                first.append(page.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime"))
                page.close()
            row(f"report: {name}", f"{path.stat().st_size / 1e6:.2f} MB")
            row("  DOM ready", spread(ready))
            row("  first paint", spread(first))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", choices=("solve", "paint", "pages"), default=("solve", "paint", "pages"))
    parser.add_argument("--images", type=int, default=189)
    parser.add_argument("--folder", type=Path, help="where `paint` writes; default: a temporary one")
    given = parser.parse_args()
    if "solve" in given.what:
        solve()
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        if "paint" in given.what:
            paint(Path(folder) / "paint", given.images)
        if "pages" in given.what:
            pages(Path(folder))


if __name__ == "__main__":
    main()
