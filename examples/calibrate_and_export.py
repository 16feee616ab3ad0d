"""From radiographs of one ball to the geometry files of a scan.

    python examples/calibrate_and_export.py FOLDER

FOLDER holds scanner.json, poses.csv, radiographs/ and scan.csv, as `tomopose demo --out FOLDER` lays them out.
"""

from __future__ import annotations

import sys
from pathlib import Path

# -- begin
import tomopose as tp


def main(folder: Path) -> tp.Calibration:
    scanner = tp.read_scanner(folder / "scanner.json")
    poses = tp.read_poses(folder / "poses.csv")
    images = tp.open_images(folder / "radiographs", scanner)
    observations = tp.detect(images, scanner, ball_diameter=8.0, pose_id=poses.pose_id)

    calibration = tp.calibrate(scanner, poses, observations)
    print(calibration.verdict, *calibration.reasons, sep="\n  ")
    print(f"d_rms {calibration.d_rms:.4f} px, {calibration.d_rms_um:.2f} um at the object")

    matrices = tp.projection_matrices(calibration, tp.read_poses(folder / "scan.csv"))
    tp.export(matrices, folder / "exported", formats=["astra", "rtk"])
    return calibration


# -- end


if __name__ == "__main__":
    main(Path(sys.argv[1]))
