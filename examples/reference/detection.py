"""One simulated radiograph of a ball, and the projection of its centre with an uncertainty."""

import numpy as np

import tomopose as tp
from tomopose.geometry.projection import project_ball

scanner = tp.Scanner(d_SD=1200.0, d_SR=310.0, p_u=0.4, p_v=0.4, u_0=201.3, v_0=150.6, n_u=401, n_v=303)
T_HT = tp.RigidTransform.from_angles([0.0, 0.0, 3.1], [0.5, -0.4, 0.6], source=tp.Frame.H, target=tp.Frame.T)
run = tp.simulate_ball_run(
    scanner, T_HT=T_HT, t=np.array([1.0, -0.8, 1.6]), poses=tp.pose_grid(1)[:1], ball_diameter=8.0, snr=100.0, seed=1
)
found = tp.detect_image(run.image(0), scanner, ball_diameter=8.0)
truth = project_ball(scanner, T_HT=run.T_HT, T_MH=run.T_MH, t=run.t)[0]
print(f"centre {found.x_D.round(3)} px, {1000 * np.linalg.norm(found.x_D - truth):.1f} thousandths of a pixel off")
