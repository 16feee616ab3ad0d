"""Tables in and out: units and row orders are converted at the border, and nowhere else."""

import tempfile
from pathlib import Path

import tomopose as tp

with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "poses.csv"
    tp.write_poses(path, tp.pose_grid(2))
    again = tp.read_poses(path)
    print(
        len(again), f"poses, {abs(again.T_MH.matrix - tp.pose_grid(2).T_MH.matrix).max():.0e} apart from those written"
    )
    path.write_text("pose_id,x_mm,y_mm\n0,1,2\n")
    try:
        tp.read_poses(path)
    except tp.TomoposeError as error:
        print(type(error).__name__, "-", str(error).replace(folder, ""))
