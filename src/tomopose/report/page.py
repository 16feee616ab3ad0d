"""A report as values: sections made of blocks, rendered to one HTML document that needs nothing from a network.

The figures are plain dictionaries in the vocabulary of plotly.js, drawn by our own script (`templates/plots`, SVG and
a canvas for scenes, 50 kB); it is embedded once, the data are in the page as JSON, and a content security policy
forbids the browser to load anything from elsewhere.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from tomopose.files import plain, write_text
from tomopose.report.figures.thumbnails import Thumbnail, thumbnail_svg

Tone = Literal["good", "care", "bad"]
"""How a verdict is coloured."""
GOOD: Tone = "good"
CARE: Tone = "care"
BAD: Tone = "bad"


SOLID = ("scatter3d", "mesh3d")


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One plot.  meaning: what it shows, in one sentence; look_for: what a reader should look for, in another.

    data, layout: plotly.js traces and layout; height in px.
    """

    title: str
    meaning: str
    look_for: str
    data: Sequence[Mapping[str, Any]]
    layout: Mapping[str, Any]
    height: int = 420
    wide: bool = True
    kind: Literal["figure"] = "figure"

    @property
    def solid(self) -> bool:
        """Whether it is a scene in space, which the keyboard can turn."""
        return any(trace["type"] in SOLID for trace in self.data)


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table of text cells.  numeric: indices of right-aligned columns; folded: hidden until it is opened."""

    title: str
    meaning: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    numeric: Sequence[int] = ()
    folded: bool = False
    wide: bool = True
    kind: Literal["table"] = "table"


@dataclass(frozen=True, kw_only=True)
class Words:
    """Paragraphs, or a list."""

    title: str = ""
    paragraphs: Sequence[str] = ()
    items: Sequence[str] = ()
    wide: bool = True
    kind: Literal["words"] = "words"


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """Radiograph crops with the found silhouette drawn."""

    title: str
    meaning: str
    look_for: str
    thumbnails: Sequence[Thumbnail]
    wide: bool = True
    kind: Literal["pictures"] = "pictures"


Block = Figure | Table | Words | Pictures


@dataclass(frozen=True, kw_only=True)
class Section:
    """A heading with its blocks.  lead: the section's message in a sentence."""

    title: str
    lead: str = ""
    blocks: Sequence[Block] = ()


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The line that a report begins with.  tone: good | care | bad; reasons: why."""

    word: str
    sentence: str
    tone: Tone
    reasons: Sequence[str] = ()


@dataclass(frozen=True, kw_only=True)
class KeyFigure:
    """A number that is at the top: its name, the number with its unit, and a word of explanation."""

    name: str
    value: str
    note: str = ""


@dataclass(frozen=True, kw_only=True)
class Answer:
    """A question that a reader comes with, answered in a sentence or two."""

    question: str
    words: str


@dataclass(frozen=True, kw_only=True)
class Page:
    """A whole report."""

    title: str
    subtitle: str = ""
    verdict: Verdict | None = None
    answers: Sequence[Answer] = ()
    key_figures: Sequence[KeyFigure] = ()
    sections: Sequence[Section] = field(default_factory=tuple)
    footer: str = ""


PLOT_SCRIPTS = ("numbers.js", "plane.js", "space.js", "plots.js")
"""Parts of the plotting script, in the order in which they use one another."""


@lru_cache(maxsize=1)
def plots_script() -> str:
    """The script that draws figures, for a script element or a file of its own."""
    folder = files("tomopose.report") / "templates" / "plots"
    return "\n".join((folder / name).read_text(encoding="utf-8") for name in PLOT_SCRIPTS)


def figure_content(figure: Figure) -> dict[str, Any]:
    """What the plotting script takes: traces and layout."""
    return {"data": figure.data, "layout": figure.layout}


def script_json(value: object) -> str:
    """JSON that is safe inside a script element."""
    text = json.dumps(plain(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


def render(page: Page) -> str:
    """The HTML document of a page.

    Returns one self-contained document: style, scripts, figures' data and pictures are all inside it.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader("tomopose.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["identity"] = id
    figures = [block for section in page.sections for block in section.blocks if isinstance(block, Figure)]
    content = {f"figure-{k}": figure_content(f) for k, f in enumerate(figures)}
    names = {id(f): f"figure-{k}" for k, f in enumerate(figures)}
    return environment.get_template("page.html.j2").render(
        page=page,
        names=names,
        thumbnail_svg=lambda thumbnail: Markup(thumbnail_svg(thumbnail)),
        figures_json=Markup(script_json(content)),
        plots=Markup(plots_script()) if figures else "",
    )


def write_report(path: str | Path, html: str) -> None:
    """Write a report, atomically, as UTF-8."""
    write_text(path, html)
