"""What the first commands need compiled: small jobs that call every kernel once, and a note of those that are done."""

from __future__ import annotations

import contextlib
import hashlib
import json
import multiprocessing
import platform
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import numpy as np

from tomopose import kernel_cache
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import ProjectionMatrices, eq5_matrices, project_ball
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.observations import BallObservations
from tomopose.studies.demo import DemoSetup, demo_setup
from tomopose.volume import Volume, VoxelGrid

PACKAGE = Path(__file__).resolve().parents[1]
NOTE = "tomopose-warmup.json"
REHEARSAL_PX = 128


def simulate_ball() -> None:
    """One radiograph of a ball."""
    from tomopose.simulation.run import simulate_ball_run

    setup = demo_setup(small=True)
    run = simulate_ball_run(
        setup.scanner, T_HT=setup.T_HT, t=setup.t, poses=setup.poses, ball_diameter=setup.ball_diameter, seed=setup.seed
    )
    run.image(0)


def detect_ball(setup: DemoSetup | None = None) -> None:
    """A ball found in a small image."""
    from tomopose.detection.run.detect import detect

    setup = demo_setup(small=True) if setup is None else setup
    tiny = setup.scanner.cropped(u=0, v=0, n_u=REHEARSAL_PX, n_v=REHEARSAL_PX)
    middle = (REHEARSAL_PX - 1) / 2
    v, u = np.mgrid[:REHEARSAL_PX, :REHEARSAL_PX]
    ball = 1 / (1 + np.exp(20.0 - np.hypot(u - middle, v - middle)))
    noise = np.random.default_rng(setup.seed).normal(scale=100.0, size=ball.shape)
    detect([(20000 * ball + noise + 1000).astype(np.uint16)], tiny, ball_diameter=setup.ball_diameter)


def calibrate_rigid(setup: DemoSetup | None = None) -> None:
    """A calibration from calculated centres, and the matrices of one view of a scan."""
    from tomopose.calibration.projection_matrices import projection_matrices
    from tomopose.calibration.solve import calibrate

    setup = demo_setup(small=True) if setup is None else setup
    poses = setup.poses
    x_D = project_ball(setup.scanner, T_HT=setup.T_HT, T_MH=poses.T_MH, t=setup.t, alpha=poses.alpha)
    calibration = calibrate(setup.scanner, poses, BallObservations.from_sigma(x_D, 0.01, pose_id=poses.pose_id))
    projection_matrices(calibration, setup.scan.select([0]))


def reconstruct_all() -> None:
    """The CPU engine's algorithms on a few small views of a disc that stays where it is."""
    from tomopose.reconstruction.run import reconstruct

    matrices, grid = circle(40), VoxelGrid.cube(n=12, spacing=0.3)
    v, u = np.mgrid[: matrices.n_v, : matrices.n_u] - 15.5
    images = [np.where(np.hypot(u, v) < 8.0, 1.0, 0.0).astype(np.float32)] * len(matrices.P)
    for algorithm in ("fdk", "sart", "ossart", "cgls"):
        reconstruct(
            images, matrices, grid, images_are="line-integrals", algorithm=algorithm, engine="cpu", consistency="off"
        )


def find_surface() -> None:
    """The surface of a ball in a small volume."""
    from tomopose.measurement.surface.surface import surface

    grid = VoxelGrid.cube(n=32, spacing=0.1)
    z, y, x = np.mgrid[:32, :32, :32] - 15.5
    values = (1 / (1 + np.exp(2.0 * (np.sqrt(x * x + y * y + z * z) - 9.3)))).astype(np.float32)
    surface(Volume(values=values, grid=grid))


def judge_scan() -> None:
    """The completeness of a circle."""
    from tomopose.trajectory.completeness import source_path, tuy_completeness

    tuy_completeness(source_path(circle(12).P), np.zeros((1, 3)), n_planes=20)


def circle(views: int) -> ProjectionMatrices:
    """A small circular scan."""
    scanner = Scanner(d_SD=500.0, d_SR=100.0, p_u=1.0, p_v=1.0, u_0=15.5, v_0=15.5, n_u=32, n_v=32)
    alpha = np.linspace(0.0, 2.0 * np.pi, views, endpoint=False)
    T_MH = RigidTransform(R=np.tile(np.eye(3), (views, 1, 1)), t=np.zeros((views, 3)), source=Frame.M, target=Frame.H)
    T_HT = RigidTransform.from_angles([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], source=Frame.H, target=Frame.T)
    return ProjectionMatrices(
        P=eq5_matrices(scanner, T_HT=T_HT, T_MH=T_MH, alpha=alpha), n_u=32, n_v=32, p_u=1.0, p_v=1.0,
        pose_id=tuple(str(k) for k in range(views)), scanner=scanner,
    )  # fmt: skip


JOBS: dict[str, Callable[[], None]] = {
    "simulate": simulate_ball,
    "detect": detect_ball,
    "calibrate": calibrate_rigid,
    "reconstruct": reconstruct_all,
    "measure": find_surface,
    "plan": judge_scan,
}
"""What a command of that name calls."""
NEEDS = {"measure": "vtk"}
"""Optional packages without which a job has nothing to compile."""


def compile_jobs(
    jobs: Sequence[str] = tuple(JOBS), *, workers: int = 2, progress: Callable[[int, int], None] | None = None
) -> None:
    """Run jobs of `JOBS` in processes of their own, so that their kernels lie in the cache, and note them.

    workers: processes at a time.  progress: called with (jobs done, jobs in all).  Jobs share a few kernels; two that
    begin at once compile those twice.
    """
    told = progress or (lambda done, total: None)
    told(0, len(jobs))
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=max(1, min(workers, len(jobs))), mp_context=spawn) as pool:
        waiting = {pool.submit(run_job, name): name for name in jobs}
        for done, future in enumerate(as_completed(waiting), start=1):
            future.result()
            note_done([waiting[future]])
            told(done, len(jobs))


@contextlib.contextmanager
def compiled_while(here: str, *, beside: Sequence[str]) -> Iterator[None]:
    """Runs the jobs `beside` in one more process while the caller's own work compiles the kernels of job `here`.

    Nothing is started where they are compiled already, or where no folder keeps what another process compiles.
    """
    missing = [name for name in beside if name not in compiled_jobs()]
    if not missing or kernel_cache.kept_in(PACKAGE) is None:
        yield
        return
    other = multiprocessing.get_context("spawn").Process(target=run_jobs, args=(tuple(missing),), daemon=True)
    other.start()
    try:
        yield
        other.join()
    finally:
        other.terminate()  # nobody waits for it where the caller's work has failed or was interrupted
    if other.exitcode == 0:
        note_done([here, *missing])


def run_jobs(names: Sequence[str]) -> None:
    """Jobs one after the other."""
    for name in names:
        run_job(name)


def run_job(name: str) -> None:
    """One job, in the process that it was sent to; a job whose optional package is missing has nothing to compile."""
    import importlib.util
    import warnings

    if name in NEEDS and importlib.util.find_spec(NEEDS[name]) is None:
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the little that the job works on
        JOBS[name]()


def compiled_jobs() -> set[str]:
    """The jobs that were run since the package, numba or the processor changed, by the note in the cache's folder."""
    folder = kernel_cache.kept_in(PACKAGE)
    if folder is None:
        return set()
    try:
        note = json.loads((folder / NOTE).read_text("utf-8"))
        return set(note["jobs"]) & set(JOBS) if note["key"] == _key() else set()
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def note_done(jobs: Iterable[str]) -> None:
    """Adds jobs to the note; without a folder that is kept nothing is noted."""
    from tomopose.files import write_text

    folder = kernel_cache.kept_in(PACKAGE)
    if folder is not None:
        document = {"key": _key(), "jobs": sorted(compiled_jobs() | set(jobs))}
        write_text(folder / NOTE, json.dumps(document))


def _key() -> str:
    """Digest of what numba looks at before it uses a kept kernel: sources, its own version, the processor."""
    import llvmlite.binding
    import numba

    digest = hashlib.sha256()
    for part in (numba.__version__, platform.python_version(), llvmlite.binding.get_host_cpu_name()):
        digest.update(part.encode())
    for path in sorted(PACKAGE.rglob("*.py")):
        facts = path.stat()
        digest.update(f"{path.relative_to(PACKAGE)} {facts.st_mtime_ns} {facts.st_size}".encode())
    return digest.hexdigest()
