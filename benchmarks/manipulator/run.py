"""How far a scan's matrices are off, rigid and with the manipulator's errors identified: the table of the studies.

Usage: python benchmarks/manipulator/run.py [--seeds 10] [--cases NAME ...]

Every case is a virtual machine with seeded errors, 189 or 200 radiographs of a ball at M 5.3 (0.0207 px), and the
paper's tilted scan.  Printed are the rms over seeds of the scan's error at the corners of a box of +-15, +-15, +-30 mm
(the farthest points of the object; inside the box the error is about half), the object's rigid pose removed: of the
matrices, which all views share, in px and in um at the object, with the worst seed, what is left beside the scale of
the object ("less s.") and what is stated; of the single
views as they were executed, with the machine's scatter, wear and warmth, with what is stated and the share of
coordinates that 95 % of it covers; and the CPU time of the identification.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "2")

import numpy as np
from manipulator_cases import (
    ROBOT_BALLS,
    UM_PER_PX,
    Experiment,
    hexapod_experiment,
    robot_experiment,
    scan_error,
)

from tomopose.calibration.identified.calibrate import calibrate_kinematic
from tomopose.calibration.solve import calibrate
from tomopose.manipulator.virtual import Disturbance, typical_hexapod, typical_robot

DISTANCE = {(0, 1): (float(np.linalg.norm(np.subtract(*ROBOT_BALLS[:2]))), 0.0005)}
HEXAPOD = typical_hexapod()
ROBOT = typical_robot()
FIVE = float(np.radians(5.0))
WORN = Disturbance(
    backlash_mm=0.003, growth_mm=(0.001, -0.002, 0.004), growth_rad=(5e-6, -8e-6, 4e-6), time_constant=60.0
)
WORN_LEGS = replace(WORN, backlash_mm=0.0, leg_backlash_mm=0.003)

CASES: dict[str, Callable[[int], Experiment]] = {
    "paper's 189 poses": lambda s: hexapod_experiment(HEXAPOD, "paper", s),
    "paper's poses, scan of 8 deg": lambda s: hexapod_experiment(HEXAPOD, "paper", s, wide=True),
    "189 mixed poses, 4 table angles": lambda s: hexapod_experiment(HEXAPOD, "mixed", s),
    "the same, geometry file 8 % wrong": lambda s: hexapod_experiment(HEXAPOD, "mixed", s, geometry=1.08),
    "mixed poses, scan of 8 deg": lambda s: hexapod_experiment(HEXAPOD, "mixed", s, wide=True),
    "two ball positions": lambda s: hexapod_experiment(HEXAPOD, "mixed", s, balls=2),
    "6R robot, 200 poses, one ball": lambda s: robot_experiment(ROBOT, s),
    "6R robot, +-5 deg only, one ball": lambda s: robot_experiment(ROBOT, s, spin=FIVE, tilt_deg=5.0),
    "6R robot on the table, 4 angles": lambda s: robot_experiment(ROBOT, s, table=True),
    "6R robot on the table, +-5 deg": lambda s: robot_experiment(ROBOT, s, table=True, spin=FIVE, tilt_deg=5.0),
    "6R robot, two balls, known distance": lambda s: robot_experiment(ROBOT, s, balls=2),
    "mixed, backlash 3 um and drift": lambda s: hexapod_experiment(HEXAPOD, "mixed", s, disturbance=WORN),
    "paper's, backlash 3 um and drift": lambda s: hexapod_experiment(HEXAPOD, "paper", s, disturbance=WORN),
    "paper's, leg backlash 3 um and drift": lambda s: hexapod_experiment(HEXAPOD, "paper", s, disturbance=WORN_LEGS),
    "mixed, leg backlash 3 um and drift": lambda s: hexapod_experiment(HEXAPOD, "mixed", s, disturbance=WORN_LEGS),
    "mixed poses, kinematics unknown (slack)": lambda s: hexapod_experiment(HEXAPOD, "mixed", s),
    "nothing wrong, paper's poses": lambda s: hexapod_experiment(HEXAPOD, "paper", s, size=0.0),
    "nothing wrong, mixed poses": lambda s: hexapod_experiment(HEXAPOD, "mixed", s, size=0.0),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    given = parser.parse_args()
    print(
        f"{'case':39s} {'rigid':>7s} | {'auto':>7s} {'worst':>7s} {'less s.':>7s} {'stated':>7s} {'um':>5s} | "
        f"{'view':>6s} {'stated':>6s} {'inside':>7s} | {'CPU s':>5s}  models"
    )
    for name in given.cases:
        rows, models = [], []
        for seed in range(given.seeds):
            e = CASES[name](seed)
            rigid = calibrate(e.scanner, e.poses, e.observations, model="rigid", hypotheses=False)
            begin = time.process_time()
            unknown = "unknown" in name
            found = calibrate_kinematic(
                e.scanner,
                e.poses,
                e.observations,
                rigid=rigid,
                manipulator=None if unknown else e.machine,
                model="slack" if unknown else "auto",
                distances=DISTANCE if "known distance" in name else None,
            )
            cpu = time.process_time() - begin
            x = scan_error(found, e)
            rows.append(
                (scan_error(rigid, e).shared, x.shared, x.but_scale, x.u_shared, x.single, x.u_single, x.inside, cpu)
            )
            models.append(found.model)
        r = np.array(rows)
        rigid_px, px, less, u, view, u_view = np.sqrt(np.mean(r[:, :6] ** 2, axis=0))
        told = ", ".join(f"{m} {models.count(m)}" for m in sorted(set(models)))
        print(
            f"{name:39s} {rigid_px:7.4f} | {px:7.4f} {r[:, 1].max():7.4f} {less:7.4f} {u:7.4f} "
            f"{px * UM_PER_PX:5.2f} | {view:6.4f} {u_view:6.4f} {100 * r[:, 6].mean():6.1f}% | {r[:, 7].mean():5.2f}  "
            f"{told}",
            flush=True,
        )


if __name__ == "__main__":
    main()
