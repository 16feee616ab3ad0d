"""Makes tomopose-sample.zip: simulated radiographs of a ball in the layout of a project, small enough to download.

python docs/downloads/make_sample.py

A ball of 8 mm on a hexapod at M 5.3, 21 poses at two table angles, on a panel binned to 1.6 mm of which a window is
read out.  truth.json says what was simulated.
"""

from __future__ import annotations

import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import tomopose as tp
from tomopose.cli.simulated import write_run
from tomopose.studies.demo import demo_setup, paper_scanner

TARGET = Path(__file__).with_name("tomopose-sample.zip")
BINNING, WINDOW, SNR, SEED = 8, {"u": 20, "v": 112, "n_u": 212, "n_v": 142}, 180.0, 20261130
POSES = 21
FOLDER = "tomopose-sample"
LONG_AGO = (1980, 1, 1, 0, 0, 0)
"""The time of every file in the archive, so that the same content has the same bytes."""

PROJECT = """# What every verb needs, stated once.  In this folder: tomopose calibrate --out cal
scanner = "scanner.json"
poses = "poses.csv"
images = "radiographs"
ball_diameter_mm = 8.0
machine = "simulated scanner"
"""

README = """# A sample for tomopose

Simulated radiographs of one metal ball (8 mm) at 21 poses of a hexapod, as a project is laid out:

    tomopose.toml   what every verb needs
    scanner.json    what is known of the scanner
    poses.csv       the poses, one row a radiograph
    radiographs/    16-bit TIFF
    truth.json      what was simulated, to compare with

In this folder:

    tomopose calibrate --out cal
    tomopose review cal

cal/report.html is the report.  The data are in the public domain (CC0).
"""


def main() -> None:
    setup = demo_setup()
    scanner = replace(paper_scanner().binned(BINNING).cropped(**WINDOW), sigma={})
    chosen = np.unique(np.linspace(0, len(setup.poses) - 1, POSES).round().astype(int))
    run = tp.simulate_ball_run(
        scanner, T_HT=setup.T_HT, t=setup.t, poses=setup.poses.select(chosen), ball_diameter=setup.ball_diameter,
        snr=SNR, seed=SEED,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_run(folder, run)
        (folder / "tomopose.toml").write_text(PROJECT, encoding="utf-8")
        (folder / "README.md").write_text(README, encoding="utf-8")
        with zipfile.ZipFile(TARGET, "w") as archive:
            for path in sorted(p for p in folder.rglob("*") if p.is_file()):
                entry = zipfile.ZipInfo(f"{FOLDER}/{path.relative_to(folder).as_posix()}", LONG_AGO)
                entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
                archive.writestr(entry, path.read_bytes())
    print(TARGET, f"{TARGET.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
