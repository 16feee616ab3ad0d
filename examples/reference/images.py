"""Radiographs are opened lazily, and an image is image[v, u], whatever the row order of its file."""

import tempfile
from pathlib import Path

import numpy as np

import tomopose as tp

with tempfile.TemporaryDirectory() as folder:
    picture = np.arange(12, dtype=np.uint16).reshape(3, 4)
    tp.write_tiff(Path(folder) / "pose_0.tif", picture, rows="top-first")
    images = tp.open_images(folder, rows="top-first")
    print(len(images), "image of", images[0].shape)
    assert np.array_equal(images[0], picture)
