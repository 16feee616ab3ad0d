"""A scan of 360 views of 512^2 px on 256^3 voxels through `tp.refine`: processor time, memory and what is reached.

    python benchmarks/refine/large.py --folder large                       # continues after a stop
    python benchmarks/refine/large.py --folder small --views 90 --pixels 256 --voxels 128

Balls, seven periods of tilt, white scatter of 1 px and 0.4 degrees a view, noise 0.5 %.  Every stage that is done is
written to FOLDER/log.jsonl with the processor time and the largest memory of the process so far.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path

import numpy as np
import objects
from numba import njit, prange
from run import matrices_of

import tomopose as tp


@njit(parallel=True)
def chords(M_inv: np.ndarray, s: np.ndarray, balls: np.ndarray, out: np.ndarray) -> None:
    """Line integrals of balls (m, 5: x, y, z, radius, mu) into out (n_v, n_u), each the mean over 2 x 2 rays."""
    for v in prange(out.shape[0]):
        for u in range(out.shape[1]):
            total = 0.0
            for part in range(4):
                a, b = u - 0.25 + 0.5 * (part % 2), v - 0.25 + 0.5 * (part // 2)
                d = M_inv[:, 0] * a + M_inv[:, 1] * b + M_inv[:, 2]
                d /= np.sqrt(np.sum(d**2))
                for k in range(len(balls)):
                    x, y, z = balls[k, 0] - s[0], balls[k, 1] - s[1], balls[k, 2] - s[2]
                    along = x * d[0] + y * d[1] + z * d[2]
                    inside = balls[k, 3] ** 2 - (x * x + y * y + z * z - along * along)
                    if inside > 0:
                        total += 2 * balls[k, 4] * np.sqrt(inside)
            out[v, u] = total / 4


def scan(folder: Path, n: int, pixels: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, objects.Panel]:
    """Transmissions (n, n_v, n_u), kept in the folder; P as calibrated and true; the panel."""
    scale = 105 / pixels
    panel = objects.Panel(
        n_u=pixels, n_v=pixels, p_u=1.2 * scale, p_v=1.1 * scale, u_0=pixels / 2 + 1.3, v_0=pixels / 2 - 2.2
    )
    P = objects.matrices(objects.path("seven", n), np.zeros((n, 3)), panel)
    truth = objects.moved(P, objects.errors("white", n, 0, panel))
    file = folder / "transmissions.npy"
    if not file.exists():
        balls = np.array([[*b.centre, b.half[0], b.mu] for b in objects.balls()])
        images, rng = np.empty((n, pixels, pixels), dtype=np.float32), np.random.default_rng(1000)
        p, count = np.empty((pixels, pixels)), 1 / 0.005**2
        for j in range(n):
            M_inv = np.linalg.inv(truth[j, :, :3])
            chords(M_inv, -M_inv @ truth[j, :, 3], balls, p)
            images[j] = np.maximum(rng.poisson(np.exp(-p) * count), 1) / count
        np.save(file, images)
    return np.load(file, mmap_mode="r"), P, truth, panel


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--views", type=int, default=360)
    parser.add_argument("--pixels", type=int, default=512)
    parser.add_argument("--voxels", type=int, default=256)
    parser.add_argument("--threads", type=int, default=2)
    a = parser.parse_args()
    a.folder.mkdir(exist_ok=True)
    images, P, truth, panel = scan(a.folder, a.views, a.pixels)
    used, begin = time.process_time(), time.time()

    def note(**more: object) -> None:
        row = {
            "processor minutes": (time.process_time() - used) / 60,
            "minutes": (time.time() - begin) / 60,
            "memory GiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
            **more,
        }
        with (a.folder / "log.jsonl").open("a") as file:
            file.write(json.dumps(row, default=float) + "\n")
        print(row, flush=True)

    note(stage="images are there", views=a.views, pixels=a.pixels, voxels=a.voxels)
    result = tp.refine(
        images,
        matrices_of(P, panel),
        tp.VoxelGrid.cube(n=a.voxels, spacing=0.28 * 72 / a.voxels),
        images_are="transmission",
        settings=tp.RefineSettings(threads=a.threads, memory_gib=6.0),
        checkpoint=a.folder / "kept",
        progress=lambda done, total: note(stage=f"{done} of {total}"),
    )
    note(
        stage="done",
        before=objects.error_px(P, truth),
        after=objects.error_px(np.asarray(result.matrices), truth),
        stated=result.stated_px,
        halves=result.halves_px,
        verdict=result.verdict,
        chi=result.chi,
        levels=result.provenance.arguments["levels"] if result.provenance else None,
        blur=(result.edge_blur_before_mm, result.edge_blur_after_mm),
    )


if __name__ == "__main__":
    main()
