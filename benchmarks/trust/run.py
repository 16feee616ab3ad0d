"""Can a calibration be trusted?  python benchmarks/trust/run.py [--small] [--shared DIR]

Prints: convergence from no start over random mounts; coverage of the stated regions; the residual that each mistake
leaves, by pose plan; images needed against accuracy, grid and optimal; outliers; wrong conventions by the command
line; the speed of the Monte Carlo; and the spread of mounts of a real robot.  Noise is 0.0207 px of d_rms (0.0146 px a
coordinate), M 5.3, unless said.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from conventions import conventions
from robot_camera import described, study
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from tomopose.calibration.checks.conventions.diagnose import ranked
from tomopose.calibration.model.covariance import inverse_information
from tomopose.calibration.model.parameters import free_parameters
from tomopose.calibration.model.problem import Problem, pair
from tomopose.calibration.rigid.estimate import best_fit, solve
from tomopose.calibration.rigid.fit import Fit, blocks, jacobian, minimise
from tomopose.calibration.rigid.pose_noise import PoseNoise, total_covariance
from tomopose.calibration.solve import calibrate
from tomopose.calibration.uncertainty.monte_carlo import draw
from tomopose.calibration.uncertainty.propagation import length_sigma, matrix_point_jacobian
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project_ball
from tomopose.geometry.rotations import log_rotation
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform
from tomopose.least_squares import Status
from tomopose.manipulator.poses import PoseSequence
from tomopose.observations import BallObservations
from tomopose.planning.design import SIGMA_PX, nominal_mount, plan_poses, predicted_covariance
from tomopose.planning.limits import PlanLimits
from tomopose.planning.target import scan_target
from tomopose.trajectory.pose_grid import pose_grid

SCANNER = Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.2, u_0=1021.37, v_0=1026.81, n_u=2048, n_v=2048).exact()
FAR = replace(SCANNER, d_SR=555.0)
MOUNT = RigidTransform.from_angles([0.007, -0.005, 3.126], [2.0, -1.5, 1.0], source=Frame.H, target=Frame.T)
BALL, NEAR = np.array([8.0, -6.0, 17.0]), np.array([0.6, -0.5, 0.6])
TURNS = (0.0, np.pi / 2, np.pi, 3 * np.pi / 2)


def mixed(n: int, *, seed: int = 1, alphas: tuple[float, ...] = TURNS, tilt_deg: float = 5.0) -> PoseSequence:
    """Random positions within +-10 mm, compound rotations, table angles."""
    rng = np.random.default_rng(seed)
    return PoseSequence.from_table(
        rng.uniform(-10, 10, (n, 3)), rng.uniform(-tilt_deg, tilt_deg, (n, 3)), alpha=rng.choice(alphas, n)
    )


def observe(
    poses: PoseSequence,
    *,
    T_HT: RigidTransform = MOUNT,
    t: np.ndarray = BALL,
    scanner: Scanner = SCANNER,
    sigma: float = SIGMA_PX,
    seed: int | None = 0,
) -> BallObservations:
    x = project_ball(scanner, T_HT=T_HT, T_MH=poses.T_MH, t=t, alpha=poses.alpha)
    if seed is not None:
        x = x + np.random.default_rng(seed).normal(0, sigma, x.shape)
    return BallObservations.from_sigma(x, sigma, pose_id=poses.pose_id)


def convergence(runs: int) -> None:
    print(f"\nConvergence from no start value, {runs} random mounts a plan (any rotation; t_HT +-10 mm, t +-20 mm)")
    print(
        f"{'plan':34s} {'reached':>8s} {'wrong, and said':>16s} {'wrong, unsaid':>14s} "
        f"{'CPU ms, median':>15s} {'99 %':>6s}"
    )
    plans = {
        "paper grid, 189": pose_grid(3),
        "paper grid, 56": pose_grid(2),
        "random, table still, 60": mixed(60, alphas=(0.0,)),
        "random, four table angles, 60": mixed(60),
        "random, any rotation, 40": mixed(40, alphas=(0.0,), tilt_deg=180.0),
    }
    for name, poses in plans.items():
        rng = np.random.default_rng(5)
        reached = said = unsaid = 0
        times = []
        for _ in range(runs):
            T_HT = RigidTransform(
                R=Rotation.random(random_state=rng).as_matrix(),
                t=rng.uniform(-10, 10, 3),
                source=Frame.H,
                target=Frame.T,
            )
            x = project_ball(SCANNER, T_HT=T_HT, T_MH=poses.T_MH, t=rng.uniform(-20, 20, 3), alpha=poses.alpha)
            x = x + rng.normal(0, SIGMA_PX, x.shape)
            problem = pair(SCANNER, poses, BallObservations.from_sigma(x, SIGMA_PX, pose_id=poses.pose_id))
            free = free_parameters((SCANNER,))
            begin = time.process_time()
            fit = best_fit(problem, free)
            times.append(time.process_time() - begin)
            near = np.linalg.norm(log_rotation(fit.R_HT @ T_HT.R.T)) < 0.05
            reached += near
            poor = not fit.converged or fit.chi2 / (2 * len(problem) - 9) > 4
            said += not near and poor
            unsaid += not near and not poor
        print(
            f"{name:34s} {reached:8d} {said:16d} {unsaid:14d} {1e3 * np.median(times):15.2f} "
            f"{1e3 * np.quantile(times, 0.99):6.2f}",
            flush=True,
        )


def _truth(free: object, n: int) -> Fit:
    return Fit(
        R_HT=MOUNT.R,
        t_HT=MOUNT.t,
        t=BALL[None],
        delta=np.zeros(n),
        chi2=0.0,
        status=Status.CONVERGED,
        N=np.zeros((0, 0)),
    )


def coverage(runs: int) -> None:
    print(f"\nCoverage of 95 % regions, {runs} seeded runs")
    print(f"{'case':44s} {'all parameters':>14s} {'each':>7s} {'pixels':>7s} {'lengths':>8s} {'MC u / stated u':>16s}")
    cases = {
        "paper grid, 56": (pose_grid(2), {}, None),
        "compound, four table angles, 40": (mixed(40), {}, None),
        "the same, d_SR u_0 eta pitch with priors": (
            mixed(40),
            {"d_SR": 0.05, "u_0": 0.5, "eta": 1e-3, "pitch_ratio": 1e-3},
            None,
        ),
        "the same, pose noise 0.5 um, 12 urad": (mixed(40), {}, PoseNoise(translation=5e-4, rotation=12e-6)),
        "the same, pose noise 5 um, 0.1 mrad": (mixed(40), {}, PoseNoise(translation=5e-3, rotation=1e-4)),
    }
    scan, x = mixed(12, seed=9), np.array([[15.0, -12, 20], [-14.0, 10, -25]])
    for name, (poses, priors, noise) in cases.items():
        observed = observe(poses)
        problem = pair(SCANNER, poses, observed)
        free = free_parameters((SCANNER,), priors=priors)
        truth = _truth(free, len(free))
        mc = draw(problem, free, truth, runs, seed=3, noise=noise)
        weighted = (
            problem
            if noise is None
            else problem.with_covariance(total_covariance(problem.covariance, blocks(problem, free, truth), noise))
        )
        C = inverse_information(minimise(weighted, free, truth).N)
        q = np.einsum("bi,ij,bj->b", mc.errors, np.linalg.inv(C), mc.errors)
        each = np.abs(mc.errors) < 1.96 * np.sqrt(np.diag(C))
        cal = calibrate(SCANNER, poses, observed, priors=priors, hypotheses=False, pose_noise=None)
        cal = replace(cal, T_HT=MOUNT, scanner=SCANNER, covariance=C)
        J = matrix_point_jacobian(cal, scan, x)
        d = np.einsum("nmic,bc->bnmi", J, mc.errors)
        pixels = np.abs(d) < 1.96 * np.sqrt(np.einsum("nmic,cd,nmid->nmi", J, C, J))
        lengths = _length_errors(cal, scan, x, mc.errors)
        inside = np.abs(lengths) < 1.96 * length_sigma(cal, scan, x[:1], x[1:])[0]
        ratio = mc.u / np.sqrt(np.diag(C))
        print(
            f"{name:44s} {(q < chdtri(len(C), 0.05)).mean():14.3f} {each.mean():7.3f} {pixels.mean():7.3f} "
            f"{inside.mean():8.3f} {ratio.min():8.3f}-{ratio.max():.3f}",
            flush=True,
        )


def _length_errors(cal: object, scan: PoseSequence, x: np.ndarray, errors: np.ndarray) -> np.ndarray:
    from tomopose.calibration.uncertainty.propagation import apparent_displacement

    B = apparent_displacement(cal, scan, x)  # type: ignore[arg-type]
    along = (x[1] - x[0]) / np.linalg.norm(x[1] - x[0])
    return errors @ (along @ (B[1] - B[0]))


def alternatives() -> None:
    print("\nResidual d_rms (px) that each mistake leaves, by plan (M 2.7, noise 0.0207 px)  [same: indistinguishable]")
    plans = {
        "paper 189, ball 20 mm off": (pose_grid(3), BALL),
        "paper 189, ball 1 mm off": (pose_grid(3), NEAR),
        "compound 56, four table angles": (mixed(56), BALL),
        "optimal, table 0 and 90": (
            plan_poses(FAR, T_HT=MOUNT, t=BALL, limits=PlanLimits(table_angles=TURNS[:2])).poses,
            BALL,
        ),
    }
    columns: dict[str, dict[str, str]] = {}
    for plan, (poses, t) in plans.items():
        problem = pair(FAR, poses, observe(poses, scanner=FAR, t=t))
        free = free_parameters((FAR,))
        cells = {
            h.name: f"{h.d_rms:.4f}{' same' if h.outcome == 'same' else ''}"
            for h in ranked(problem, free, best_fit(problem, free)).hypotheses
        }
        columns[plan] = cells | _scanner_mistakes(poses, t)
    names = list(columns["compound 56, four table angles"])
    print(f"{'mistake':44s} " + " ".join(f"{plan:>31s}" for plan in plans))
    for name in names:
        print(f"{name:44s} " + " ".join(f"{columns[plan].get(name, '-'):>31s}" for plan in plans))


def _scanner_mistakes(poses: PoseSequence, t: np.ndarray) -> dict[str, str]:
    """What wrong values of the scanner leave."""
    wrong = {
        "u_0 + 1 px": {"u_0": FAR.u_0 + 1},
        "u_0 + 20 px": {"u_0": FAR.u_0 + 20},
        "d_SR + 1 %": {"d_SR": 1.01 * FAR.d_SR},
        "d_SR + 0.05 %": {"d_SR": 1.0005 * FAR.d_SR},
        "d_SD + 1 %": {"d_SD": 1.01 * FAR.d_SD},
        "both pitches + 0.5 %": {"p_u": 1.005 * FAR.p_u, "p_v": 1.005 * FAR.p_v},
        "pitch p_u alone + 0.5 %": {"p_u": 1.005 * FAR.p_u},
        "detector roll 0.5 deg": {"eta": np.radians(0.5)},
        "detector roll 0.05 deg": {"eta": np.radians(0.05)},
        "detector tilt 0.5 deg": {"theta": np.radians(0.5)},
    }
    cells = {}
    observed = observe(poses, scanner=FAR, t=t)
    for name, change in wrong.items():
        scanner = replace(FAR, **change)
        cells[name] = _left(pair(scanner, poses, observed))
    stretched = replace(poses, T_MH=replace(poses.T_MH, t=1.001 * poses.T_MH.t))
    cells["translation scale 1.001"] = _left(pair(FAR, stretched, observed))
    return cells


def _left(problem: Problem) -> str:
    free = free_parameters(problem.scanners)
    r = problem.x_D - blocks(problem, free, best_fit(problem, free)).x_D
    return f"{np.sqrt((r**2).sum(axis=1).mean()):.4f}"


def images_needed() -> None:
    print(
        "\nImages and predicted scan reprojection error (px rms; tilted scan of eq. (11), +-15, +-15, +-30 mm, "
        "object's pose removed)"
    )
    target = scan_target(SCANNER, T_HT=nominal_mount())
    print(f"{'plan':34s} {'images':>7s} {'px':>8s} {'alternatives not distinguished':s}")
    for n in (2, 3, 4, 5):
        grid = pose_grid(n)
        C = predicted_covariance(SCANNER, grid, T_HT=nominal_mount(), t=BALL)
        print(f"{f'paper grid {n}x{n}x{n}x7':34s} {len(grid):7d} {target.rms(C):8.5f}")
    for words, alphas, numbers in (
        ("optimal, table still", TURNS[:1], (27, 40, 63, 72)),
        ("optimal, table 0, 90", TURNS[:2], (16, 20, 27, 30, 63)),
        ("optimal, table 0, 90, 180, 270", TURNS, (16, 24, 30)),
    ):
        for n in numbers:
            begin = time.process_time()
            plan = plan_poses(SCANNER, t=BALL, n=n, limits=PlanLimits(table_angles=alphas))
            assert plan.resolved is not None
            told = ", ".join(h.name for h in plan.resolved.unresolved) or "the true symmetries only"
            print(
                f"{words:34s} {len(plan):7d} {plan.predicted:8.5f} {told} [{time.process_time() - begin:.1f} s CPU]",
                flush=True,
            )


def _change(a: Fit, b: Fit) -> float:
    """Largest change of a coordinate from b to a, in standard uncertainties of b."""
    d = np.concatenate([log_rotation(a.R_HT @ b.R_HT.T), a.t_HT - b.t_HT, (a.t - b.t).ravel()])
    return float(np.abs(d / np.sqrt(np.diag(inverse_information(b.N)))).max())


def outliers(runs: int) -> None:
    """Against the clean data, and against the fit that knows which centres are bad: the first cannot be better than
    what the lost centres would have said, the second is what the search adds."""
    print(f"\nOutliers in 8 % of the centres, {runs} runs; changes in standard uncertainties, largest coordinate")
    print(
        f"{'plan, size of the errors':44s} {'found':>12s} {'others':>7s} {'change from clean':>18s} "
        f"{'the same, given':>15s} {'from given':>10s}  (each: median, largest)"
    )
    free = free_parameters((SCANNER,))
    for name, poses, low, high in (
        ("paper grid, 189, to 30 px", pose_grid(3), 0.0, 30.0),
        ("compound, 60, to 30 px", mixed(60), 0.0, 30.0),
        ("paper grid, 189, 0.05 to 0.5 px", pose_grid(3), 0.05, 0.5),
    ):
        n = len(poses)
        n_bad = round(0.08 * n)
        found = others = 0
        changes = []
        for seed in range(runs):
            clean = observe(poses, seed=seed)
            rng = np.random.default_rng([seed, 1])
            bad = rng.choice(n, size=n_bad, replace=False)
            a = rng.uniform(0, 2 * np.pi, n_bad)
            x = clean.x_D.copy()
            x[bad] += np.column_stack([np.cos(a), np.sin(a)]) * rng.uniform(low, high, (n_bad, 1))
            problem = pair(SCANNER, poses, clean)
            fit = best_fit(problem, free)
            told = minimise(problem, free, fit, weight=np.isin(np.arange(n), bad, invert=True).astype(float))
            robust = solve(pair(SCANNER, poses, replace(clean, x_D=x)), free).robust
            found += int((~robust.keep[bad]).sum())
            others += int((~robust.keep).sum() - (~robust.keep[bad]).sum())
            changes.append((_change(robust.fit, fit), _change(told, fit), _change(robust.fit, told)))
        c = np.array(changes)
        cells = " ".join(f"{np.median(v):8.2f} {v.max():6.2f}" for v in c.T)
        above = ", ".join(f"{v:.1f}" for v in 100 * (c > 1).mean(axis=0))
        print(f"{name:44s} {found:6d}/{runs * n_bad:5d} {others:7d} {cells}   above 1: {above} %", flush=True)
    one_outlier(runs // 3)


def one_outlier(runs: int) -> None:
    """One bad image among 56, where it pulls most: the pose and direction of largest leverage."""
    free = free_parameters((SCANNER,))
    for name, poses in (("paper grid, 56", pose_grid(2)), ("compound, 56", mixed(56))):
        exact = pair(SCANNER, poses, observe(poses, seed=None))
        fit = best_fit(exact, free)
        J = exact.W @ jacobian(exact, free, blocks(exact, free, fit))
        leverage, way = np.linalg.eigh(J @ inverse_information(fit.N) @ np.swapaxes(J, 1, 2))
        k = int(leverage[:, 1].argmax())
        cells = []
        for size in (4, 5, 6, 7, 8, 10, 100, 2000):
            found, worst = 0, 0.0
            for seed in range(runs):
                clean = observe(poses, seed=seed)
                x = clean.x_D.copy()
                x[k] += size * SIGMA_PX * way[k, :, 1]
                told = minimise(pair(SCANNER, poses, clean), free, fit, weight=(np.arange(len(poses)) != k) * 1.0)
                robust = solve(pair(SCANNER, poses, replace(clean, x_D=x)), free).robust
                found += not robust.keep[k]
                worst = max(worst, _change(robust.fit, told))
            cells.append(f"{size} sigma {100 * found / runs:.0f} % {worst:.1f}")
        print(
            f"one bad image, {name}, leverage {leverage[k, 1]:.2f}: found, largest change from the fit without it: "
            + "; ".join(cells),
            flush=True,
        )


def speed(draws: int) -> None:
    poses = pose_grid(3)
    problem, free = pair(SCANNER, poses, observe(poses)), free_parameters((SCANNER,))
    draw(problem, free, _truth(free, 0), 2)
    wall, cpu = time.perf_counter(), time.process_time()
    draw(problem, free, _truth(free, 0), draws, seed=1)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(
        f"\nMonte Carlo: {draws} solves of 189 poses in {wall:.1f} s ({cpu:.1f} s CPU): {1e5 / draws * cpu / 2:.1f} "
        "s for 100,000 on two free cores"
    )
    poses_, observed = pose_grid(3), observe(pose_grid(3))
    for words, options in (("calibrate, alone", {"hypotheses": False}), ("calibrate with quick alternatives", {})):
        times = []
        for _ in range(10):
            begin = time.process_time()
            calibrate(SCANNER, poses_, observed, **options)  # type: ignore[arg-type]
            times.append(time.process_time() - begin)
        print(f"{words}, 189 poses: {1e3 * np.median(times):.1f} ms CPU")


def robot(shared: Path) -> None:
    folder = shared / "data" / "robot-camera-kuka"
    if not folder.is_dir():
        print(f"\nReal robot: no data at {folder}")
        return
    r = study(folder)
    low, middle, high = r["chance"]
    print(
        f"\nReal robot with a camera, {r['corners']} corners, each alone (residual {r['residual_px']:.2f} px): "
        "spread of the mounts over the stated uncertainty, Birge ratio (of medians)"
    )
    print(f"{'uncertainty from':44s} {'rotation':>15s} {'all six':>15s}")
    for words, s in (("J^T J, scaled to the residuals", r["plain"]), ("the robot's errors modelled", r["modelled"])):
        print(f"{words:44s} {s.rotation:7.2f} ({s.median_rotation:5.2f}) {s.mount:7.2f} ({s.median_mount:5.2f})")
    print(
        "Birge ratio by chance, were the model true: "
        f"rotation {low[0]:.2f} to {high[0]:.2f} (median {middle[0]:.2f}), "
        f"all six {low[1]:.2f} to {high[1]:.2f} (median {middle[1]:.2f})"
    )
    print(f"the robot's errors: {described(r['field'])}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true", help="a tenth of the runs")
    parser.add_argument(
        "--shared",
        type=Path,
        default=Path(os.environ.get("TOMOPOSE_SHARED", Path(__file__).resolve().parents[3] / "shared")),
    )
    options = parser.parse_args()
    part = 10 if options.small else 1
    convergence(10_000 // part)
    coverage(1000)
    alternatives()
    images_needed()
    outliers(1000 // part)
    with tempfile.TemporaryDirectory() as folder:
        conventions(Path(folder))
    speed(100_000 // part)
    robot(options.shared)


if __name__ == "__main__":
    main()
