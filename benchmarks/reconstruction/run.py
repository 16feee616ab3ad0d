"""Speed and truth of the reconstruction, beside itk-rtk in the same run.

    python benchmarks/reconstruction/run.py speed accuracy agreement adjoint slabs large [--views 90] [--out F.json]

Peers take turns, view block by view block, so that a busy machine is as unkind to both; process CPU seconds are the
figure to compare, wall seconds are beside them.  "2 idle cores" is CPU seconds divided by two.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "reconstruction"))

from reconstruction_phantom import balls, compare, images_of, line_integrals, scan  # noqa: E402

from tomopose.engines import make_engine  # noqa: E402
from tomopose.engines.rtk import RtkEngine, load_itk, rtk_geometry  # noqa: E402
from tomopose.reconstruction import FDK, PAPER, SART, Execution, reconstruct  # noqa: E402
from tomopose.trajectory.view_order import view_order  # noqa: E402
from tomopose.volume import VoxelGrid  # noqa: E402

Result = dict[str, Any]


class Clock:
    """Sums CPU and wall seconds of what runs under it."""

    def __init__(self) -> None:
        self.cpu = self.wall = 0.0

    def __call__(self, work: Callable[[], Any]) -> Any:
        cpu, wall = time.process_time(), time.perf_counter()
        result = work()
        self.cpu += time.process_time() - cpu
        self.wall += time.perf_counter() - wall
        return result


def rtk_sart(engine: RtkEngine, images: np.ndarray, views: list[int], start: np.ndarray | None = None) -> np.ndarray:
    """One sweep of RTK's own SART filter, relaxation 0.8, one view a subset, in its engine's order [x, z, y]."""
    itk, RTK = load_itk()
    kind = itk.Image[itk.F, 3]
    filtered = RTK.SARTConeBeamReconstructionFilter[kind, kind].New()
    # An ITK view does not keep its array alive.
    state, stack = engine.empty() if start is None else start, np.ascontiguousarray(images, dtype=np.float32)
    filtered.SetInput(0, engine.volume_image(state))
    filtered.SetInput(1, engine.stack_image(stack))
    filtered.SetGeometry(rtk_geometry(engine.matrices, views))
    filtered.SetNumberOfIterations(1)
    filtered.SetLambda(0.8)
    filtered.SetNumberOfProjectionsPerSubset(1)
    filtered.SetDisableDisplacedDetectorFilter(True)
    filtered.Update()
    return np.asarray(itk.array_from_image(filtered.GetOutput()))


def speed(views: int, block: int = 15) -> Result:
    """Back-projection, forward projection and a SART sweep: 256^3, views x 400^2, tilted."""
    grid = VoxelGrid.cube(n=256, spacing=0.1)
    matrices = scan(grid, n=views, n_u=400)
    rng = np.random.default_rng(0)
    volume = rng.random(grid.shape, dtype=np.float32)
    image = rng.random((block, 400, 400), dtype=np.float32)
    cpu, rtk = make_engine("cpu", matrices, grid), RtkEngine(matrices, grid)
    x, y = cpu.put(volume), rtk.put(volume)
    small = VoxelGrid.cube(n=8, spacing=0.1)
    warm = make_engine("cpu", matrices, small)  # compiles or loads the kernels
    warm.back(image[:1], [0], into=warm.empty(), weight="mean")
    warm.forward(warm.empty(), [0])
    warm.lengths([0])
    clocks = {
        name: {"own": Clock(), "rtk": Clock()} for name in ("back-projection", "forward projection", "SART sweep")
    }
    order = view_order(views)
    state, other = cpu.empty(), rtk.empty()
    for first in range(0, views, block):
        chosen = [int(j) for j in order[first : first + block]]
        part = image[: len(chosen)]

        def own_back(chosen: list[int] = chosen, part: np.ndarray = part) -> None:
            for i, j in enumerate(chosen):
                cpu.back(part[i : i + 1], [j], into=x)

        def own_sart(chosen: list[int] = chosen, part: np.ndarray = part) -> None:
            for i, j in enumerate(chosen):
                residual = part[i : i + 1] - cpu.forward(state, [j])
                length = cpu.lengths([j])
                residual *= np.where(length > 0.2, 1 / np.maximum(length, 0.2), 0)
                cpu.back(residual, [j], into=state, weight="mean", scale=0.8)

        clocks["back-projection"]["own"](own_back)
        clocks["back-projection"]["rtk"](
            lambda c=chosen, p=part: rtk.run("BackProjectionImageFilter", volume=y, images=p, views=c, back=True)
        )
        clocks["forward projection"]["own"](lambda c=chosen: cpu.forward(x, c))
        clocks["forward projection"]["rtk"](lambda c=chosen: rtk.forward(y, c))
        clocks["SART sweep"]["own"](own_sart)
        other = clocks["SART sweep"]["rtk"](lambda c=chosen, p=part, o=other: rtk_sart(rtk, p, c, o))
    updates, samples = grid.size * views / 1e9, 256 * 400 * 400 * views / 1e9
    result: Result = {}
    for name, pair in clocks.items():
        own, peer = pair["own"], pair["rtk"]
        work = samples if name.startswith("forward") else updates
        result[name] = {
            "own_cpu_s": own.cpu,
            "own_wall_s": own.wall,
            "rtk_cpu_s": peer.cpu,
            "rtk_wall_s": peer.wall,
            "ratio_cpu": peer.cpu / own.cpu,
            "ratio_wall": peer.wall / own.wall,
            "own_rate_2_idle_cores": 2 * work / own.cpu,
            "unit": "1e9 samples/s" if name.startswith("forward") else "1e9 voxel updates/s",
        }
        print(
            f"{name:20s} own {own.cpu:7.2f} cpu s ({own.wall:6.1f} wall), rtk {peer.cpu:7.2f} cpu s ({peer.wall:6.1f} "
            f"wall), ratio {peer.cpu / own.cpu:5.2f}, own {2 * work / own.cpu:5.2f} {result[name]['unit']}",
            flush=True,
        )
    return result


def accuracy(views: int = 360, n: int = 256) -> Result:
    """Ball centres on the paper's tilted path (eq. 11), noise-free."""
    grid = VoxelGrid.cube(n=n, spacing=0.1)
    objects = balls(grid)
    matrices = scan(grid, n=views, n_u=n * 400 // 256)
    images = images_of(matrices, objects)
    result: Result = {}
    settings = {"default (fdk)": None, "paper": PAPER, "fdk+sart": SART(start=FDK()), "sart, golden order": SART()}
    for name, chosen in settings.items():
        clock = Clock()
        volume = clock(
            lambda c=chosen: reconstruct(
                images, matrices, grid, images_are="line-integrals", consistency="off", engine="cpu", algorithm=c
            )
        )
        found = compare(volume.values, grid, objects)
        result[name] = {
            "centre_mean": float(found.centre_error.mean()),
            "centre_max": float(found.centre_error.max()),
            "centroid_mean": float(found.centroid_error.mean()),
            "radius_mean": float(found.radius_error.mean()),
            "radius_sd": float(found.radius_error.std()),
            "inner": float(found.inner.mean()),
            "background": found.background,
            "cpu_s": clock.cpu,
            "view_residual": float(volume.view_residual.mean()),
        }
        print(
            f"{name:12s} centre of fit {found.centre_error.mean():.4f} mean {found.centre_error.max():.4f} max, of "
            f"mass {found.centroid_error.mean():.4f} voxel, radius {found.radius_error.mean():+.4f} +- "
            f"{found.radius_error.std():.4f}, inner {found.inner.mean():.4f}, background {found.background:.4f}, "
            f"{clock.cpu:.0f} cpu s",
            flush=True,
        )
    return result


def agreement(n: int = 256, views: int = 90) -> Result:
    """Against RTK's own SART filter, fed view by view in our order.

    RTK ends a ray at the centres of the outermost voxels, we at their faces: the outer layers differ for that reason.
    """
    grid = VoxelGrid.cube(n=n, spacing=0.1)
    matrices = scan(grid, n=views, n_u=n * 400 // 256)
    images = images_of(matrices, balls(grid))
    inner = np.s_[2:-2, 2:-2, 2:-2]
    result = {}
    for order in ("golden", "random"):
        own = reconstruct(
            images,
            matrices,
            grid,
            images_are="line-integrals",
            consistency="off",
            engine="cpu",
            algorithm=replace(PAPER, order=order),
        ).values
        engine = RtkEngine(matrices, grid)
        state = engine.empty()
        for j in view_order(views, order):
            state = rtk_sart(engine, images[j : j + 1], [int(j)], state)
        peer = engine.values(state)
        span = float(np.ptp(peer))
        result[order] = {
            "rms_over_range": float(np.sqrt(((own - peer) ** 2).mean())) / span,
            "rms_over_range_without_2_outer_layers": float(np.sqrt(((own - peer)[inner] ** 2).mean())) / span,
        }
    print(f"agreement with RTK's SART filter: {result}", flush=True)
    return result


def adjoint(n: int = 96) -> Result:
    """<A x, y> against <x, A' y>."""
    grid = VoxelGrid.cube(n=n, spacing=0.1)
    matrices = scan(grid, n=8, n_u=150)
    engine = make_engine("cpu", matrices, grid)
    rng = np.random.default_rng(0)
    x, y = rng.random(grid.shape), rng.random((8, 150, 150))
    every = list(range(8))
    left = float((engine.forward(engine.put(x), every).astype(np.float64) * y).sum())
    right = float((engine.values(engine.transpose(y, every)).astype(np.float64) * x).sum())
    looked_up = engine.empty()
    engine.back(y, every, into=looked_up)
    voxel_driven = float((engine.values(looked_up).astype(np.float64) * x).sum())
    result = {
        "transpose": abs(left / right - 1),
        "voxel_driven_back_up_to_scale": "not a transpose: its ratio to <A x, y> is "
        f"{voxel_driven / left:.4f}, where a transpose has 1",
    }
    print(f"adjointness: {result}", flush=True)
    return result


def slabs(n: int = 96) -> Result:
    """Slabs on disk against one piece."""
    grid = VoxelGrid.cube(n=n, spacing=0.1)
    matrices = scan(grid, n=40, n_u=150)
    images = images_of(matrices, balls(grid))
    settings: Result = {"images_are": "line-integrals", "consistency": "off", "engine": "cpu"}
    settings["algorithm"] = SART(start=FDK(), subset_size=5)
    whole = reconstruct(images, matrices, grid, **settings).values
    with tempfile.TemporaryDirectory() as folder:
        cut = np.array(
            reconstruct(images, matrices, grid, **settings, execution=Execution(slabs=4, scratch=folder)).values
        )
    result = {"largest_difference_over_range": float(np.abs(cut - whole).max() / np.ptp(whole))}
    print(f"slabs against one piece: {result}", flush=True)
    return result


def large(views: int = 20) -> Result:
    """512^3 from 1024^2 images: one SART iteration over `views` views, scaled to 900; peak memory of the process."""
    grid = VoxelGrid.cube(n=512, spacing=0.1)
    objects = balls(grid, m=3)
    matrices = scan(grid, n=900, n_u=1024).select([int(j) for j in view_order(900)[:views]])
    images = [line_integrals(matrices, objects, j, fine=1).astype(np.float32) for j in range(views)]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    clock = Clock()
    volume = clock(
        lambda: reconstruct(
            images, matrices, grid, images_are="line-integrals", consistency="off", engine="cpu", algorithm=PAPER
        )
    )
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    bytes_volume, bytes_scan = volume.values.nbytes, 4 * 900 * 1024**2
    bytes_here = sum(i.nbytes for i in images)
    result = {
        "views": views,
        "cpu_s": clock.cpu,
        "wall_s": clock.wall,
        "minutes_900_views_2_idle_cores": clock.cpu / views * 900 / 2 / 60,
        "peak_GiB": peak / 2**30,
        "before_GiB": before / 2**30,
        "peak_without_the_images_held_over_volume": (peak - bytes_here) / bytes_volume,
        "peak_with_all_900_views_in_memory_over_volume_and_projections": (peak - bytes_here + bytes_scan)
        / (bytes_volume + bytes_scan),
    }
    print(f"large: {json.dumps(result, indent=1)}", flush=True)
    return result


PARTS: dict[str, Callable[..., Result]] = {
    "speed": speed,
    "accuracy": accuracy,
    "agreement": agreement,
    "adjoint": adjoint,
    "slabs": slabs,
    "large": large,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=list(PARTS))
    parser.add_argument("--views", type=int, default=90, help="views of the speed part")
    parser.add_argument("--large-views", type=int, default=20, help="views of the large part; 900 runs it in full")
    parser.add_argument("--out", type=Path, default=None)
    options = parser.parse_args()
    results: Result = {}
    for part in options.parts:
        views = {"speed": options.views, "large": options.large_views}.get(part)
        results[part] = PARTS[part]() if views is None else PARTS[part](views)
    if options.out:
        options.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
