"""Drawings in which one can read everything: what overlaps is found, and the package's own drawings have none."""

from __future__ import annotations

import pytest

from tomopose.report.page import Figure
from tomopose.report.pages.study_page import figure_png
from tomopose.report.style import axis, layout

RED = {"color": "#b3261e"}
PLANE = layout(xaxis=axis("x / mm"), yaxis=axis("y / mm"))


def figure(*data, plan=PLANE, title="Errors of the lengths") -> Figure:
    return Figure(title=title, meaning="m", look_for="l", data=list(data), layout=plan)


def bars(name: str, labels: list[str]) -> dict:
    return {"type": "bar", "name": name, "x": labels, "y": list(range(len(labels))), "marker": RED}


def points(name: str, at: float) -> dict:
    return {"type": "scatter", "name": name, "x": [0, 1, 2], "y": [at, at, at], "mode": "markers", "marker": RED}


RUNS = ("circular scan", "3D scan, paper's method, run 1", "3D scan, paper's method, run 2", "our best", "MPE")
SPACE = {"scene": {f"{c}axis": {"title": {"text": f"{c} / mm"}} for c in "xyz"}}


@pytest.mark.parametrize(
    "drawn",
    [
        figure(*(points(name, k) for k, name in enumerate(RUNS))),
        figure(*(bars(name, [str(k) for k in range(1, 28)]) for name in RUNS)),
        figure(bars("poses trusted", [f"error correction, {k} mixed poses at four table angles" for k in range(5)])),
        figure({"type": "heatmap", "x": [0, 1], "y": [0, 1], "z": [[1, 2], [3, 4]], "colorbar": {"title": "share"}}),
        figure(
            {"type": "scatter3d", "name": "3D scan", "x": [-300, 300, 0], "y": [-300, 300, 9], "z": [-25, 25, 0],
             "mode": "lines", "line": RED},
            plan=SPACE,
        ),
    ],
    ids=["points", "many bars", "long names", "map", "flat path in space"],
)  # fmt: skip
def test_a_drawing_of_each_kind_hides_nothing(drawn, tmp_path):
    assert figure_png(tmp_path / "drawn.png", drawn) == ()
    assert (tmp_path / "drawn.png").read_bytes().startswith(b"\x89PNG")


WORDS = [{"x": 0.5, "y": 0.0, "text": "3D scan"}, {"x": 0.52, "y": 0.0, "text": "circular scan"}]


@pytest.mark.parametrize(
    ("drawn", "said"),
    [
        (figure(points("a", 0), plan={**PLANE, "annotations": WORDS}), "'3D scan' and 'circular scan' overlap"),
        (figure(bars("a", [f"case {k}" for k in range(60)])), "'case 0' and 'case 1' overlap"),
        (figure(points("a", 0), title="long " * 60), "leaves the sheet"),
    ],
)
def test_what_hides_something_is_named(drawn, said, tmp_path):
    assert any(said in words for words in figure_png(tmp_path / "drawn.png", drawn))


def test_a_legend_over_the_data_is_named():
    from matplotlib.figure import Figure as Sheet

    from tomopose.report.overlaps import overlaps

    sheet = Sheet()
    ax = sheet.add_subplot()
    ax.plot([0, 1], [0, 1], label="a")
    assert overlaps(sheet) == ()
    ax.legend()
    assert overlaps(sheet) == ("the legend covers the axes ''",)
