"""The study of ref. [8]: its standard is in view along the path."""

from __future__ import annotations

import numpy as np

from tomopose.geometry.projection import eq5_matrices, project
from tomopose.geometry.rotations import R_y
from tomopose.studies import multi_sphere
from tomopose.studies.demo import demo_setup, paper_scanner
from tomopose.studies.parts.virtual_hexapod import real_T_MH, scan_of


def test_the_standard_is_in_view_along_the_path_and_has_an_identity():
    made, fine = multi_sphere.standard(), paper_scanner(multi_sphere.MAGNIFICATION)
    made.require_asymmetric(0.3)
    poses = scan_of(multi_sphere.MAGNIFICATION, 126)
    T_MH = real_T_MH(poses, multi_sphere.MAGNIFICATION)
    P = eq5_matrices(fine, T_HT=demo_setup(paper=True).T_HT, T_MH=T_MH, alpha=poses.alpha)
    x = np.stack([project(p[None], made.centres @ R_y(0.2).T + [0.4, -0.7, 1.0])[0] for p in P])
    radius = 60.0
    assert (x > radius).all()
    assert (x < np.array([fine.n_u, fine.n_v]) - radius).all()
