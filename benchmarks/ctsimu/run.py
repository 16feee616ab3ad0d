"""The CTSimU 2D tests and the twin test with the virtual CT, evaluated by the ctsimu toolbox itself.

python benchmarks/ctsimu/run.py [--only 2D-FB-1,2D-HS-1] [--out DIR] [--threads 2]

Needs ctsimu 1.7 with pandas and reportlab. Prints one row a test: what the toolbox found, the tolerance and its
origin, and whether it holds. Exit code 1 where a test that was run is not passed.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import math
import multiprocessing
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import ctsimu.geometry as geometry_module
import numpy as np
from ctsimu.evaluation import test2D_HS_1
from ctsimu.geometry import Geometry
from ctsimu.image import Image
from ctsimu.primitives import Vector
from ctsimu.toolbox import Toolbox
from images import opaque, run_of, scenario, wedge_run, wedge_scanner, write, write_drawn
from samples import StepWedge, drawn_holes, duplex_wires, half_plane_edge, hole_foil
from tube import DETECTORS, seen_by, spectrum

EDGE = "2D-WE-2_2021-10-13v02r03dp.json"
SPOTS = {"spot1": (1, 9.579, 29.852), "spot2": (2, 24.552, 11.770)}
"""Number, standard deviation of the line spread function (um) and MTF20 (cycles/mm) that the toolbox documents."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table; passed is None where the test cannot be run or its reference is known to be off."""

    test: str
    found: str
    tolerance: str
    passed: bool | None


@dataclass(frozen=True, kw_only=True)
class Place:
    folder: Path
    threads: int

    def evaluate(self, test: str, *files: str, **subtests: str) -> str:
        """Runs the toolbox's test; what it printed."""
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            Toolbox(test, *files, **subtests)
        return said.getvalue()

    def result(self, test: str, name: str) -> str:
        return (self.folder / f"{test}-results" / name).read_text()


@contextlib.contextmanager
def plain_numbers() -> Iterator[None]:
    """2D-HS-1 of ctsimu 1.7 multiplies a string by a NumPy Boolean, which NumPy 2 refuses: for the time of the test its
    distances, angles and means are Python numbers. No value changes."""
    distance, angle, mean = Vector.distance, Vector.angle, test2D_HS_1.list_mean_and_stddev
    Vector.distance = lambda *args: float(distance(*args))
    Vector.angle = lambda *args: float(angle(*args))
    test2D_HS_1.list_mean_and_stddev = lambda values: tuple(float(x) for x in mean(values))
    try:
        yield
    finally:
        Vector.distance, Vector.angle, test2D_HS_1.list_mean_and_stddev = distance, angle, mean


def columns_of_analytical_image(geometry: Geometry, polygons: list[object], columns: range) -> list[np.ndarray]:
    """Those columns of the toolbox's two images, by its own function, whose loop over columns is shortened."""
    width, begun = geometry.detector.cols(), False

    def shortened(*n: int) -> range:
        nonlocal begun
        first, begun = not begun and n == (width,), begun or n == (width,)
        return columns if first else range(*n)

    geometry_module.range = shortened
    try:
        return [image.px for image in geometry.create_detector_flat_field_sphere(*polygons)]
    finally:
        del geometry_module.range


@contextlib.contextmanager
def analytical_image_once(folder: Path, threads: int) -> Iterator[None]:
    """2D-WE-1 and 2D-WE-2 calculate an analytical image pixel by pixel, for 20 minutes: its columns are shared among
    processes, and it is kept beside the tests' images for the next run with the same detector and edge."""
    calculate = Geometry.create_detector_flat_field_sphere

    def once(self: Geometry, *polygons: object) -> tuple[Image, ...]:
        setting = repr(
            (str(self.detector), str(self.source), [[str(p) for p in polygon.points] for polygon in polygons])
        )
        kept = folder / f"analytical_{hashlib.sha256(setting.encode()).hexdigest()[:16]}.npy"
        if not kept.exists():
            bands = [range(x, min(x + 16, self.detector.cols())) for x in range(0, self.detector.cols(), 16)]
            Geometry.create_detector_flat_field_sphere = calculate
            with multiprocessing.get_context("fork").Pool(threads) as pool:
                parts = pool.starmap(columns_of_analytical_image, [(self, list(polygons), band) for band in bands], 1)
            Geometry.create_detector_flat_field_sphere = once
            np.save(kept, np.sum(parts, axis=0))
        images = []
        for px in np.load(kept):
            image = Image()
            image.shape(self.detector.cols(), self.detector.rows(), 0, image.getInternalDataType())
            image.px[:] = px
            images.append(image)
        return tuple(images)

    Geometry.create_detector_flat_field_sphere = once
    try:
        yield
    finally:
        Geometry.create_detector_flat_field_sphere = calculate


def number(text: str, label: str) -> float:
    """The number that follows a label in a result file."""
    found = re.search(re.escape(label) + r"\s*([-+0-9.eE]+)", text)
    if found is None:
        raise ValueError(f"the toolbox's result has no {label!r}")
    return float(found[1])


def noise(place: Place) -> list[Row]:
    files, rows = {}, []
    for k, snr in ((1, 100), (2, 250)):
        run = run_of(scenario(f"2D-FB-1_Detektor{k}_SNR{snr}_2021-05-25v06r00dp.json"), place.folder)
        files[f"SNR{snr}"] = write(place.folder, f"noise{snr}", run)
    place.evaluate("2D-FB-1", **files)
    pixels = run.scanner.n_u * run.scanner.n_v
    for snr in (100, 250):
        text = place.result("2D-FB-1", f"2D-FB-1_SNR{snr}_summary.txt")
        found, mean = number(text, "Overall projection SNR:"), number(text, "Mean grey value:")
        # Standard deviations of a sample's SNR and mean.
        u_snr, u_mean = snr / math.sqrt(2 * pixels), 60000 / snr / math.sqrt(pixels)
        rows.append(
            Row(
                test=f"2D-FB-1, SNR {snr}",
                found=f"SNR {found:.3f}, mean {mean:.2f}",
                tolerance=f"{snr} +- {3 * u_snr:.3f}, 60000 +- {3 * u_mean + 0.5:.2f} (3 sigma of {pixels} pixels)",
                passed=abs(found - snr) <= 3 * u_snr and abs(mean - 60000) <= 3 * u_mean + 0.5,
            )
        )
    return rows


def falloff(place: Place) -> list[Row]:
    run = run_of(scenario("2D-FB-2_2021-03-24v06r00dp.json"), place.folder)
    place.evaluate("2D-FB-2", write(place.folder, "falloff", run, flat=False))
    text = place.result("2D-FB-2", "2D-FB-2_summary.txt")
    worst, rms = number(text, "Max Absolute GV Difference:"), number(text, "RMS GV Difference:")
    found = f"worst {worst:.2f}, rms {rms:.2f} of 60000"
    return [Row(test="2D-FB-2", found=found, tolerance="worst 1.0 (rounding is 0.5)", passed=worst <= 1.0)]


def placement(place: Place) -> list[Row]:
    """The toolbox counts the expected centres of the holes from the panel's corner and the found ones from the centre
    of its first pixel, so that a perfect image is half a pixel off in both directions. The same test on circles that
    are drawn at the expected centres shows the toolbox's own zero."""
    content = scenario("2D-HS-1_2021-03-24v02r00dp.json")
    run = run_of(content, place.folder, hole_foil(content))
    drawn = placement_of(place, write_drawn(place.folder, "drawn", run.scanner, drawn_holes(run.scanner)))
    made = placement_of(place, write(place.folder, "foil", run, threads=place.threads))
    shift = made.shift - drawn.shift
    return [
        Row(
            test="2D-HS-1",
            found=f"scale {made.scale:.1e}, turn {made.turn:.1e} rad, shift {pair(made.shift)} px, "
            f"of drawn circles {pair(drawn.shift)} px",
            tolerance="1e-4, 1e-4 rad, 0.1 px to drawn circles (own; the circle fit works on whole pixels)",
            passed=abs(made.scale) < 1e-4 and abs(made.turn) < 1e-4 and bool(np.abs(shift).max() < 0.1),
        )
    ]


@dataclass(frozen=True, kw_only=True)
class Placement:
    """Of 2D-HS-1: relative deviation of the scale, rotation (rad), mean translation (x, y), px."""

    scale: float
    turn: float
    shift: np.ndarray


def placement_of(place: Place, file: str) -> Placement:
    with plain_numbers():
        place.evaluate("2D-HS-1", file)
    text = place.result("2D-HS-1", "2D-HS-1_summary.txt")
    shift = [float(x) for x in re.findall(r"[-+0-9.e]+", text.split("Mean translation vector [px]:")[1])[:2]]
    return Placement(
        scale=number(text, "Mean scale deviation:"),
        turn=number(text, "Mean rotation angle:"),
        shift=np.array(shift),
    )


def pair(values: np.ndarray) -> str:
    return f"({values[0]:.3f}, {values[1]:.3f})"


def unsharpness(place: Place) -> list[Row]:
    files, rows, mesh = {}, [], duplex_wires()
    for k, um in ((1, 75), (2, 150)):
        content = scenario(f"2D-DW-1_Detektor{k}_2021-05-26v01r01dp.json")
        run = run_of(content, place.folder, mesh, moved=True)
        files[f"SR{um}"] = write(place.folder, f"wires{um}", run, threads=place.threads)
    place.evaluate("2D-DW-1", **files)
    for um in (75, 150):
        found = 1000 * number(place.result("2D-DW-1", f"2D-DW-1_SR{um}_results.txt"), "iSRb:")
        tolerance = f"{um} um +- 5 % (own; the toolbox's example gives 147 for 150)"
        rows.append(
            Row(
                test=f"2D-DW-1, SRb {um} um",
                found=f"iSRb {found:.1f} um",
                tolerance=tolerance,
                passed=abs(found / um - 1) < 0.05,
            )
        )
    return rows


def focal_spot(place: Place) -> list[Row]:
    files, rows = {}, []
    for key, (k, _, _) in SPOTS.items():
        content = opaque(scenario(f"2D-WE-1_Spot{k}_2021-10-13v02r04dp.json"))
        files[key] = write(place.folder, key, run_of(content, place.folder, half_plane_edge()), threads=place.threads)
    with analytical_image_once(place.folder, place.threads):
        place.evaluate("2D-WE-1", **files)
    for key, (_, sigma, mtf20) in SPOTS.items():
        text = place.result("2D-WE-1", f"2D-WE-1_{key}_summary.txt")
        own = 1000 * number(text.split("measured:   sigma")[1], "[mm] =")
        own_mtf = number(text.split("MTF20 measured:")[1], "[cycles/mm] =")
        rows.append(
            Row(
                test=f"2D-WE-1, {key}",
                found=f"sigma {own:.3f} um, MTF20 {own_mtf:.3f} / mm",
                tolerance=f"{sigma} um, {mtf20} / mm (documented) +- 1 % (own)",
                passed=abs(own / sigma - 1) < 0.01 and abs(own_mtf / mtf20 - 1) < 0.01,
            )
        )
    return rows


def partial_pixels(place: Place) -> list[Row]:
    rows = []
    # The toolbox's own edge leans by 3.008 and 2.996 degrees, not by the 3 of its documentation: it turns a vector's y
    # by the x that it has already turned. The edge of the documentation is imaged beside, without a verdict.
    c, s = math.cos(math.radians(3)), math.sin(math.radians(3))
    edges = (("3 degrees", math.radians(3), None), ("as the toolbox turns", math.atan(s / (c - s * s)), math.atan(s)))
    with analytical_image_once(place.folder, place.threads):
        for name, right, top in edges:
            run = run_of(opaque(scenario(EDGE)), place.folder, half_plane_edge(right, top), moved=True)
            place.evaluate("2D-WE-2", write(place.folder, "edge", run, threads=place.threads))
            text = place.result("2D-WE-2", "2D-WE-2_summary.txt")
            both, rmsd = number(text, "(covered in both)/(covered in analytical):"), number(text, "vs. measured]:")
            ours = number(text, "measured image:")
            rows.append(
                Row(
                    test=f"2D-WE-2, edge {name}",
                    found=f"{both:.2f} % of the pixels, {ours:.0f} partly covered, RMSD {rmsd:.1f} of 60000",
                    tolerance="the reference is another edge" if top is None else "98 %, RMSD 120, 0.2 % (own)",
                    passed=None if top is None else both >= 98 and rmsd <= 120,
                )
            )
    return rows


def within_reference(text: str, column: int, reference: tuple[int, int, int]) -> tuple[float, float]:
    """(largest relative deviation, largest deviation in units of the reference's error bar) of a table's rows."""
    rows = np.array([[float(x) for x in line.split("\t")] for line in text.splitlines() if line and line[0] != "#"])
    value, (r, lower, upper) = rows[:, column], reference
    off = value - rows[:, r]
    bar = np.where(off < 0, rows[:, lower], rows[:, upper])
    return float(np.abs(off / rows[:, r]).max()), float(np.abs(off / bar).max())


def filters(place: Place) -> list[Row]:
    wedge, files, rows = StepWedge(wedge_scanner()), {}, []
    for material in ("Al", "Fe"):
        for name, copper in ((material, 0.0), (f"{material}Cu", 2.0)):
            run = wedge_run(wedge.whole(material), seen_by(spectrum(200.0, mono=False, copper=copper), "D1"))
            files[name] = write(place.folder, f"filter{name}", run, threads=place.threads, whole=wedge_scanner())
    place.evaluate("2D-SW-2", **files)
    for name in files:
        relative, bars = within_reference(place.result("2D-SW-2", f"2D-SW-2_{name}_ratios.txt"), 2, (3, 4, 5))
        rows.append(
            Row(
                test=f"2D-SW-2, {name}",
                found=f"ratios of steps within {100 * relative:.2f} %, {bars:.2f} error bars",
                tolerance="1 error bar of the Monte Carlo reference, primary",
                passed=bars <= 1,
            )
        )
    return rows


def scintillators(place: Place) -> list[Row]:
    wedge, files, rows = StepWedge(wedge_scanner()), {}, []
    beams = (("Al", 50.0, True), ("Al", 120.0, False), ("Fe", 100.0, True), ("Fe", 200.0, False))
    for detector in DETECTORS:
        for material, voltage, mono in beams:
            key = f"{detector}_{material}_{voltage:.0f}"
            run = wedge_run(wedge.whole(material), seen_by(spectrum(voltage, mono=mono), detector))
            files[key] = write(place.folder, key, run, threads=place.threads, whole=wedge_scanner())
    place.evaluate("2D-SW-1", **files)
    ours, bars = (
        table(place.result("2D-SW-1", f"2D-SW-1_{name}.txt"))
        for name in ("all_GV_ratios_to_Det1", "all_MCprimary_reference_ratios")
    )
    for key in files:
        if key.startswith("D1"):
            continue
        off = ours[key] - bars[key]
        lower, upper = (bars[f"u_{side}({key})"] for side in ("lower", "upper"))
        worst = np.abs(off / np.where(off < 0, lower, upper)).max()
        rows.append(
            Row(
                test=f"2D-SW-1, {key}",
                found=f"ratios within {100 * np.abs(off / bars[key]).max():.2f} %, {worst:.2f} error bars",
                tolerance="1 error bar of the Monte Carlo reference, primary",
                passed=bool(worst <= 1),
            )
        )
    return rows


def table(text: str) -> dict[str, np.ndarray]:
    """Columns of a tab-separated table by the names of its last comment line."""
    lines = text.splitlines()
    names = [line for line in lines if line.startswith("#")][-1].lstrip("# ").split("\t")
    rows = [line.split("\t") for line in lines if line[:1] not in ("", "#")]
    values = np.array([[np.nan if x == "-" else float(x) for x in row] for row in rows])
    return dict(zip(names, values.T, strict=True))


def boolean_models(place: Place) -> list[Row]:
    wedge, files, rows = StepWedge(wedge_scanner()), {}, []
    for right in ("Al", "Ti"):
        photons = seen_by(spectrum(80.0, mono=True), "D1")
        # Two edges cross in a pixel where a step ends at the joint; 2 x 2 cells leave 0.2 % there.
        run = wedge_run(wedge.halves("Al", right), photons, cells=4)
        files[f"Al_{right}"] = write(place.folder, f"halves{right}", run, threads=place.threads, whole=wedge_scanner())
    place.evaluate("2D-SW-3", **files)
    for key in files:
        text = place.result("2D-SW-3", f"2D-SW-3_{key}_summary.txt")
        checked, bad = number(text, "treated pixels:"), number(text, "value anomalies:")
        rows.append(
            Row(
                test=f"2D-SW-3, {key}",
                found=f"{bad:.0f} anomalies in {checked:.0f} pixels",
                tolerance="0 (the toolbox's limits: 0.04 % inside, 5 % at edges)",
                passed=bad == 0,
            )
        )
    return rows


def not_run(test: str, reason: str) -> Callable[[Place], list[Row]]:
    return lambda place: [Row(test=test, found="not run", tolerance=reason, passed=None)]


TESTS: dict[str, Callable[[Place], list[Row]]] = {
    "2D-FB-1": noise,
    "2D-FB-2": falloff,
    "2D-HS-1": placement,
    "2D-DW-1": unsharpness,
    "2D-WE-1": focal_spot,
    "2D-WE-2": partial_pixels,
    "2D-SW-1": scintillators,
    "2D-SW-2": filters,
    "2D-SW-3": boolean_models,
    "2D-SW-4": not_run("2D-SW-4", "neither object, distances nor spectrum of this test are published"),
    "twin": not_run("twin", "needs repeated scans of a real, calibrated part; none is published with its scanner"),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default=",".join(TESTS), help="names of tests, separated by commas")
    parser.add_argument("--out", type=Path, help="folder that keeps images and the toolbox's results")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    failed = 0
    with contextlib.ExitStack() as stack:
        folder = options.out or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        place = Place(folder=folder.resolve(), threads=options.threads)
        print(f"{'test':34s} | {'found':62s} | {'passed':8s} | tolerance")
        for name in options.only.split(","):
            for row in TESTS[name](place):
                failed += row.passed is False
                word = {True: "passed", False: "NOT", None: "-"}[row.passed]
                print(f"{row.test:34s} | {row.found:62s} | {word:8s} | {row.tolerance}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
