"""Real portal images: a faint ball of about 9 px inside a field that is darker than its surroundings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tomopose import Scanner
from tomopose.detection import detect

BY_EYE = {
    "coll0": (254.4, 193.8), "coll270": (254.4, 193.8), "coll315": (254.4, 193.8), "coll45": (254.4, 193.8),
    "coll90": (254.4, 193.8), "couch0": (254.7, 194.1), "couch270": (254.5, 191.6), "couch315": (254.6, 193.4),
    "couch45": (255.4, 194.3), "couch90": (255.5, 195.9), "gantry0": (254.4, 193.8), "gantry135": (255.7, 193.2),
    "gantry225": (255.1, 193.0), "gantry270": (254.1, 193.3), "gantry315": (254.3, 193.6), "gantry45": (254.7, 193.6),
    "gantry90": (255.8, 193.4),
}  # fmt: skip
"""Middle of the ball in each image, from half-height crossings of its rows and columns, to 0.5 px."""


def test_every_ball_is_found_and_none_is_wrong(shared_data: Path) -> None:
    import pydicom

    files = sorted((shared_data / "ball-radiographs-epid").glob("*.dcm"))
    assert len(files) == 17
    images = []
    for file in files:
        dataset = pydicom.dcmread(file, force=True)
        dataset.file_meta.TransferSyntaxUID = pydicom.uid.ImplicitVRLittleEndian
        images.append(dataset.pixel_array[::-1])
    scanner = Scanner(d_SD=1500.0, d_SR=1000.0, p_u=0.784, p_v=0.784, u_0=255.5, v_0=191.5, n_u=512, n_v=384)
    observations = detect(images, scanner, ball_diameter=5.0)
    assert observations.seen.all()
    truth = np.array([BY_EYE[f.stem] for f in files])
    assert np.abs(observations.x_D - truth).max() < 0.5
    assert all("bright ball" in s for s in observations.status or ())
    assert observations.sigma.max() < 0.1
