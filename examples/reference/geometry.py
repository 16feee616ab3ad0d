"""Where does a ball on the moved plate appear on the panel?"""

import numpy as np

import tomopose as tp

scanner = tp.Scanner(d_SD=1500.0, d_SR=283.5, p_u=0.2, p_v=0.21, u_0=733.4, v_0=512.7, n_u=1501, n_v=1203)
T_HT = tp.RigidTransform.from_angles([0.01, -0.02, 3.1], [2.0, -1.5, 4.0], source=tp.Frame.H, target=tp.Frame.T)
T_MH = tp.RigidTransform.from_angles([0.0, 0.0, 0.1], [5.0, 0.0, -3.0], source=tp.Frame.M, target=tp.Frame.H)

x_T = (T_HT @ T_MH).apply([10.0, -8.0, 16.0])  # mm, frames that do not chain are refused
x_W = scanner.T_TW(np.radians(90.0)).apply(x_T)
h = scanner.P_S @ scanner.T_WS.matrix @ [*x_W, 1.0]
print(f"magnification {scanner.magnification:.3f}, ball at u, v = {h[0] / h[2]:.2f}, {h[1] / h[2]:.2f} px")
