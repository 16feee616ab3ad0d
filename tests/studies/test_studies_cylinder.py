"""The cylinder's line integrals and surface, against what is known of them."""

from __future__ import annotations

import numpy as np
import pytest

from tomopose import Scanner, Volume, VoxelGrid
from tomopose.errors import InputError
from tomopose.geometry.projection import eq5_matrices
from tomopose.studies import cylinder
from tomopose.studies.demo import demo_setup
from tomopose.trajectory.scan import circular_scan

SCANNER = Scanner(d_SD=1200.0, d_SR=310.0, p_u=2.0, p_v=2.5, u_0=75.0, v_0=41.0, n_u=151, n_v=83)


def test_the_central_ray_crosses_the_diameter():
    scan = circular_scan(3)
    P = eq5_matrices(SCANNER, T_HT=demo_setup(paper=True).T_HT, T_MH=scan.T_MH, alpha=scan.alpha)
    for view in P:
        image = cylinder.cylinder_integrals(view, SCANNER)
        assert image[41, 75] == pytest.approx(2 * cylinder.RADIUS * cylinder.ATTENUATION, rel=1e-12)
        assert image[0].max() == 0.0  # above the cylinder
        assert image[:, 0].max() == 0.0  # beside it


def drawn(waves_mm: float, side: float = 0.25) -> Volume:
    """A cylinder whose radius has seven waves, its rim smooth over one voxel."""
    grid = VoxelGrid(shape=(60, 150, 150), spacing=side)
    z, y, x = np.meshgrid(*(side * (np.arange(n) - (n - 1) / 2) for n in grid.shape), indexing="ij")
    radius = cylinder.RADIUS + waves_mm * np.cos(7 * np.arctan2(y, x))
    values = np.clip((radius - np.hypot(x, y)) / side + 0.5, 0, 1) * (np.abs(z) < cylinder.HALF_HEIGHT)
    return Volume(values=values.astype(np.float32), grid=grid)


def test_waves_of_the_surface_are_measured():
    found = cylinder.surface_deviation(drawn(0.02))
    assert cylinder.periodic_part(found) == pytest.approx(20.0, rel=0.05)
    assert cylinder.periodic_part(cylinder.surface_deviation(drawn(0.0))) < 1.0


def test_an_empty_volume_is_refused():
    volume = drawn(0.0)
    empty = Volume(values=np.ones_like(volume.values), grid=volume.grid)
    with pytest.raises(InputError, match="no edge"):
        cylinder.surface_deviation(empty)
