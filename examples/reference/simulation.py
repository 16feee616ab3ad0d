"""A scene file becomes radiographs: the same scene and seed give the same bytes."""

from pathlib import Path

import numpy as np

import tomopose as tp

scene = tp.read_scene(Path(__file__).parents[1] / "scenes" / "small.toml")
run = tp.simulate(scene)
print(len(run), "radiographs of", run.scanner.shape)
assert np.array_equal(run.image(0), run.image(0))
