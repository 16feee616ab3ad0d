"""Does the command line name a wrong convention?  python benchmarks/trust/conventions.py [--folder DIR]

Every mistake of the list is written into poses.csv or observations.csv of a random calibration (mount, ball, poses,
noise), and `tomopose diagnose` and `tomopose calibrate` are run on the files.  Two plans: compound rotations at four
table angles, where all should be named, and the paper's single-axis grid with the table still, where some cannot be
distinguished and must be reported as such.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import tomopose as tp
from tomopose.cli.main import run
from tomopose.geometry.frames import Frame
from tomopose.geometry.projection import project_ball
from tomopose.geometry.scanner import Scanner
from tomopose.geometry.transforms import RigidTransform

SIGMA_PX = 0.0146
SCANNER = Scanner(d_SD=1500.0, d_SR=555.0, p_u=0.2, p_v=0.2, u_0=1021.37, v_0=1029.81, n_u=2048, n_v=2048)
LOST = SCANNER.n_u - 1.0


@dataclass
class Files:
    """What is written: t (n, 3) mm, angles (n, 3) degrees of R_x R_y R_z, alpha (n,) degrees, x (n, 2) px, and the row
    of the pose that each centre is given to."""

    t: Any
    R: Any
    alpha: Any
    x: Any
    row: Any
    angles: Any = None
    encoder: Any = None
    unit: str = "deg"


Mistake = Callable[[Files, np.random.Generator], Files]


def _image(M: Any) -> Mistake:
    """The image seen is M times the right one about the detector's centre."""
    return lambda f, _: replace(f, x=(f.x - LOST / 2) @ np.array(M, dtype=float).T + LOST / 2)


def _turned(f: Files) -> Any:
    return np.swapaxes(f.R, 1, 2)


def _angles(axes: str, R: Any) -> Any:
    """Columns rx, ry, rz (degrees) of R = R_a R_b R_c, axes = "ABC"."""
    found = Rotation.from_matrix(R).as_euler(axes, degrees=True)
    return np.column_stack([found[:, axes.index(a)] for a in "XYZ"])


def _order(axes: str) -> Mistake:
    return lambda f, _: replace(f, angles=_angles(axes, f.R))


def _sign(names: str) -> Mistake:
    s = np.array([-1.0 if a in names else 1.0 for a in "UVW"])
    return lambda f, _: replace(f, angles=s * _angles("XYZ", f.R))


def _move(M: Any) -> Mistake:
    return lambda f, _: replace(f, t=f.t @ np.array(M, dtype=float).T)


def _lag(lag: int) -> Mistake:
    """The centre of row k is that of the pose `lag` rows further on."""

    def change(f: Files, _: np.random.Generator) -> Files:
        n = len(f.t)
        k = np.arange(max(0, -lag), min(n, n - lag))
        return replace(f, x=f.x[k + lag], row=k)

    return change


def _encoder(f: Files, rng: np.random.Generator) -> Files:
    return replace(f, encoder=f.t + rng.normal(0, 0.02, f.t.shape))


MISTAKES: dict[str, Mistake] = {
    "rows flipped": _image([[1, 0], [0, -1]]),
    "columns flipped": _image([[-1, 0], [0, 1]]),
    "image turned by 180 degrees": _image([[-1, 0], [0, -1]]),
    "image transposed": _image([[0, 1], [1, 0]]),
    "image turned by 90 degrees": _image([[0, 1], [-1, 0]]),
    "image turned by 270 degrees": _image([[0, -1], [1, 0]]),
    "image transposed and turned by 180 degrees": _image([[0, -1], [-1, 0]]),
    "table sign": lambda f, _: replace(f, alpha=-f.alpha),
    **{f"sign of {n}": _sign(n) for n in ("U", "V", "W", "UV", "UW", "VW", "UVW")},
    **{f"order {o}": _order(o) for o in ("XZY", "YXZ", "YZX", "ZXY", "ZYX")},
    "pose inverted": lambda f, _: replace(f, R=_turned(f), t=-(_turned(f) @ f.t[:, :, None])[..., 0]),
    "rotation inverted": lambda f, _: replace(f, R=_turned(f)),
    "translation in the tool frame": lambda f, _: replace(f, t=(_turned(f) @ f.t[:, :, None])[..., 0]),
    "translation turned back": lambda f, _: replace(f, t=(f.R @ f.t[:, :, None])[..., 0]),
    "x and y exchanged": _move([[0, 1, 0], [1, 0, 0], [0, 0, 1]]),
    "y and z exchanged": _move([[1, 0, 0], [0, 0, 1], [0, 1, 0]]),
    "x and z exchanged": _move([[0, 0, 1], [0, 1, 0], [1, 0, 0]]),
    **{f"sign of {n}": _move(np.diag([-1.0 if a in n else 1.0 for a in "xyz"])) for n in ("x", "y", "z", "xyz")},
    **{f"pairing lag {-k:+d}": _lag(-k) for k in (-3, -2, -1, 1, 2, 3)},
    "angles are radians": lambda f, _: replace(f, angles=np.radians(_angles("XYZ", f.R))),
    "angles are degrees": lambda f, _: replace(f, angles=_angles("XYZ", f.R), unit="rad"),
    "half a pixel low": lambda f, _: replace(f, x=f.x + 0.5),
    "half a pixel high": lambda f, _: replace(f, x=f.x - 0.5),
    "pixels counted from 1": lambda f, _: replace(f, x=f.x + 1.0),
    "set poses": _encoder,
}
"""The alternative of `diagnose` that is the truth -> what was written instead of it."""


def files(rng: np.random.Generator, *, still: bool) -> Files:
    """A random calibration, written rightly."""
    if still:
        poses = tp.pose_grid(3)
        t, R, alpha = poses.T_MH.t, poses.T_MH.R, np.zeros(len(poses))
    else:
        n = int(rng.integers(40, 80))
        t = rng.uniform(-10, 10, (n, 3))
        R = Rotation.from_euler("XYZ", rng.uniform(-5, 5, (n, 3)), degrees=True).as_matrix()
        alpha = rng.choice([0.0, 90.0, 180.0, 270.0], n)
    turn = Rotation.from_rotvec(rng.normal(0, 0.05, 3)) * Rotation.from_euler("Z", rng.uniform(0, 6))
    T_HT = RigidTransform(R=turn.as_matrix(), t=rng.uniform(-5, 5, 3), source=Frame.H, target=Frame.T)
    way = rng.normal(size=3)
    ball = rng.uniform(15, 25) * way / np.linalg.norm(way)
    x = project_ball(
        SCANNER,
        T_HT=T_HT,
        T_MH=RigidTransform(R=R, t=t, source=Frame.M, target=Frame.H),
        t=ball,
        alpha=np.radians(alpha),
    )
    return Files(t=t, R=R, alpha=alpha, x=x + rng.normal(0, SIGMA_PX, x.shape), row=np.arange(len(t)))


def write(folder: Path, f: Files) -> list[str]:
    """scanner.json, poses.csv, observations.csv by hand, as a user's script would; returns the options."""
    tp.write_scanner(folder / "scanner.json", SCANNER, force=True)
    angles = _angles("XYZ", f.R) if f.angles is None else f.angles
    names = ["x_mm", "y_mm", "z_mm", *(f"r{a}_{f.unit}" for a in "xyz"), "alpha_deg"]
    shown = f.t if f.encoder is None else f.encoder
    table = np.column_stack([shown, angles, f.alpha])
    if f.encoder is not None:
        names += ["x_set_mm", "y_set_mm", "z_set_mm", "rx_set_deg", "ry_set_deg", "rz_set_deg"]
        table = np.column_stack([table, f.t, angles])
    lines = ["# convention: pi-hexapod", "# units: confirmed", ",".join(["pose_id", *names])]
    lines += [",".join([f"p{k:03d}", *(f"{v:.9f}" for v in row)]) for k, row in enumerate(table)]
    (folder / "poses.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    lines = ["pose_id,u_px,v_px,sigma_u_px,sigma_v_px"]
    lines += [f"p{k:03d},{u:.6f},{v:.6f},{SIGMA_PX},{SIGMA_PX}" for k, (u, v) in zip(f.row, f.x, strict=True)]
    (folder / "observations.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [
        "--scanner",
        str(folder / "scanner.json"),
        "--poses",
        str(folder / "poses.csv"),
        "--observations",
        str(folder / "observations.csv"),
    ]


def command(words: list[str]) -> tuple[int, dict[str, Any]]:
    """(exit code, the JSON that was printed) of the command line."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(io.StringIO()):
        code = run([*words, "--json"])
    return code, json.loads(out.getvalue().strip().splitlines()[-1]) if out.getvalue().strip() else {}


def judged(name: str, said: dict[str, Any]) -> tuple[str, str]:
    """(what diagnose says of the true reading, its remedy): first | tied with N | not distinguished | missed |
    refused."""
    if "hypotheses" not in said:
        return "refused at reading", said["error"]["message"].split(": ", 1)[1]
    mine = next((h for h in said["hypotheses"] if h["name"] == name), None)
    if mine is None:
        return "missed", ""
    leading = said["leading"]
    if name in leading:
        return ("first" if leading == [name] else f"first or tied, with {len(leading) - 1}"), mine["cure"]
    return ("not distinguished" if not leading and mine["outcome"] == "same" else "missed"), mine["cure"]


def cases(folder: Path, *, still: bool, seed: int = 0) -> list[dict[str, Any]]:
    found = []
    for number, (name, mistake) in enumerate(MISTAKES.items()):
        if still and name == "table sign":
            continue
        rng = np.random.default_rng([seed, number, int(still)])
        options = write(folder, mistake(files(rng, still=still), rng))
        code, said = command(["diagnose", *options])
        code_c, calibrated = command(["calibrate", *options, "--out", str(folder / "cal"), "--force"])
        verdict, cure = judged(name, said)
        found.append(
            {
                "mistake": name,
                "diagnose": verdict,
                "cure": cure,
                "exit": code,
                "calibrate_exit": code_c,
                "calibrate": calibrated.get("verdict", "refused"),
            }
        )
    return found


def conventions(folder: Path) -> None:
    for still, plan in ((False, "compound, four table angles"), (True, "paper's grid, table still")):
        rows = cases(folder, still=still)
        good = sum(r["diagnose"].startswith(("first", "refused")) for r in rows)
        blind = sum(r["diagnose"] == "not distinguished" for r in rows)
        print(
            f"\nWrong conventions written into the files, {plan}: {good} of {len(rows)} named, "
            f"{blind} said not to be distinguishable"
        )
        print(f"{'mistake':44s} {'diagnose':24s} {'exit':>4s}  {'calibrate':12s} {'exit':>4s}  remedy printed")
        for r in rows:
            print(
                f"{r['mistake']:44s} {r['diagnose']:24s} {r['exit']:4d}  {r['calibrate']:12s} "
                f"{r['calibrate_exit']:4d}  {r['cure'][:90]}",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=None, help="keep the files here")
    folder = parser.parse_args().folder
    if folder is not None:
        conventions(folder)
        return
    with tempfile.TemporaryDirectory() as temporary:
        conventions(Path(temporary))


if __name__ == "__main__":
    main()
