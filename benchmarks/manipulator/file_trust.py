"""What believing a hexapod's file costs and gains: right files and wrong ones, three ways.

Usage: python benchmarks/manipulator/file_trust.py [--seeds 24]

189 poses, then a scan of 8 deg; rms over seeds of the scan's error at the corners of the box, px, with what is stated
in brackets: the file doubted by its 5 % alone, the file believed, and the average by evidence, which `calibrate` gives.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from unittest import mock

import numpy as np
from manipulator_cases import Experiment, hexapod_experiment, scan_error

from tomopose.calibration.identified.calibrate import calibrate_kinematic
from tomopose.calibration.solve import calibrate
from tomopose.manipulator.hexapod import Hexapod
from tomopose.manipulator.virtual import typical_hexapod

HEXAPOD = typical_hexapod()


def errors(e: Experiment) -> list[float]:
    """Error and what is stated: doubted, believed, averaged."""
    rigid = calibrate(e.scanner, e.poses, e.observations, model="rigid", hypotheses=False)

    def found(machine: Hexapod) -> list[float]:
        cal = calibrate_kinematic(
            e.scanner, e.poses, e.observations, rigid=rigid, manipulator=machine, model="kinematic"
        )
        x = scan_error(cal, e)
        return [x.shared, x.u_shared]

    with mock.patch("tomopose.calibration.identified.geometry_prior.SHARES", (1.0,)):
        doubted = found(e.machine)
    return [*doubted, *found(replace(e.machine, scale_sigma=0.0, geometry_sigma=0.0)), *found(e.machine)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=24)
    seeds = range(parser.parse_args().seeds)
    for kind in ("paper", "mixed"):
        for factor in (1.0, 1.04, 1.08):
            rows = [errors(hexapod_experiment(HEXAPOD, kind, s, geometry=factor, wide=True)) for s in seeds]
            rms = np.sqrt(np.mean(np.square(rows), axis=0))
            ways = zip(("doubted", "believed", "averaged"), rms[::2], rms[1::2], strict=True)
            told = [f"{name} {a:.4f} ({b:.4f})" for name, a, b in ways]
            print(f"{kind} poses, file {100 * (factor - 1):.0f} % wrong: {', '.join(told)}", flush=True)


if __name__ == "__main__":
    main()
