"""The grid is the only one who knows the order of the axes."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose.errors import InputError, ShapeError
from tomopose.volume import Volume, VoxelGrid

GRID = VoxelGrid(shape=(3, 4, 6), spacing=np.array([0.1, 0.2, 0.5]), centre=np.array([1.0, 2.0, 3.0]))


def test_every_index_grows_with_its_coordinate():
    assert np.allclose(GRID.origin, [1 - 0.25, 2 - 0.3, 3 - 0.5])
    assert np.allclose(GRID.points([2, 3, 5]), [1.25, 2.3, 3.5])
    assert np.allclose(GRID.points([[0, 0, 1], [1, 0, 0]]) - GRID.origin, [[0.1, 0, 0], [0, 0, 0.5]])
    x_W = np.array([[0.9, 2.05, 3.3], [1.0, 2.0, 3.0]])
    assert np.allclose(GRID.points(GRID.indices(x_W)), x_W)
    assert np.allclose(GRID.index_to_W @ [5, 3, 2, 1], [1.25, 2.3, 3.5, 1])


def test_a_cube_is_centred_on_the_origin():
    cube = VoxelGrid.cube(n=5, spacing=0.2)
    assert np.allclose(cube.points([2, 2, 2]), 0)
    assert np.allclose(cube.corners.max(axis=0), 0.5)
    assert np.allclose(cube.corners.min(axis=0), -0.5)
    assert VoxelGrid(shape=(2, 2, 2), spacing=0.3).spacing.tolist() == [0.3, 0.3, 0.3]


def test_slabs_lie_where_they_lay():
    slab = GRID.slab(1, 3)
    assert slab.shape == (2, 4, 6)
    assert np.allclose(slab.points([0, 2, 4]), GRID.points([1, 2, 4]))
    with pytest.raises(InputError, match="slab 2 to 4"):
        GRID.slab(2, 4)


@pytest.mark.parametrize(
    "bad", [{"shape": (3, 3)}, {"shape": (3, 0, 3)}, {"spacing": 0.0}, {"spacing": np.nan}, {"centre": [0, 0]}]
)
def test_bad_grids_are_refused(bad):
    with pytest.raises(InputError):
        VoxelGrid(**{"shape": (3, 3, 3), "spacing": 0.1, **bad})


def test_volumes_show_their_slices(rng):
    values = rng.random(GRID.shape).astype(np.float32)
    volume = Volume(values=values, grid=GRID)
    z, y, x = volume.slices()
    assert np.array_equal(z, values[1])
    assert np.array_equal(y, values[:, 2])
    assert np.array_equal(x, values[:, :, 3])
    assert np.array_equal(volume.slices((0, 1, 2))[0], values[0])
    assert np.array_equal(volume.maximum_projection("x"), values.max(axis=2))
    assert np.array_equal(volume.maximum_projection("z"), values.max(axis=0))
    for wrong in (lambda: volume.slices((3, 0, 0)), lambda: volume.maximum_projection("w")):
        with pytest.raises(InputError):
            wrong()
    with pytest.raises(ShapeError):
        Volume(values=values[1:], grid=GRID)
    with pytest.raises(ShapeError):
        Volume(values=values.astype(float), grid=GRID)
