"""How the documentation is built:  sphinx-build -W -b html docs docs/_build/html"""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import tomopose

project = "tomopose"
author = "The tomopose developers"
copyright = "The tomopose developers"
release = version = tomopose.__version__

extensions = ["myst_nb", "sphinx.ext.autodoc"]
nb_execution_mode = "force"  # the notebooks show what this version does
nb_execution_raise_on_error = True
nb_execution_timeout = 600
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
root_doc = "index"
exclude_patterns = ["_build", "changelog.d", "**/README.md"]
autodoc_member_order = "bysource"
autodoc_typehints = "signature"  # the docstrings give shapes, units and frames
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
add_module_names = False

html_theme = "furo"
html_title = "tomopose"
html_static_path = ["_static"]
html_css_files = ["tomopose.css"]

FOLDER = Path(__file__).parent
SPECIAL = re.compile(r"([\\*_`|<>])")


GROUPS = {
    "geometry": ("Frames, transforms, scanner, matrices", ("geometry",)),
    "poses": ("Poses and manipulators", ("manipulator", "trajectory")),
    "images": ("Radiographs", ("io.images", "io.pairing", "values")),
    "files": ("Tables and files", ("io", "observations", "provenance", "errors")),
    "detection": ("Find the ball", ("detection",)),
    "calibration": ("Calibrate, judge and compare", ("calibration",)),
    "exports": ("Geometry for other packages", ("exports", "engines.objects")),
    "planning": ("Plan poses and scans", ("planning",)),
    "reconstruction": ("Reconstruct and refine", ("reconstruction", "refinement", "engines", "volume")),
    "measurement": ("Measure", ("measurement", "uncertainty")),
    "simulation": ("Simulate", ("simulation",)),
    "report": ("Look in a notebook", ("report",)),
}
"""Page of the reference -> its title (a task) and the rooms whose public names it lists; the first that fits counts."""


def group_of(module: str) -> str:
    """The page on which the names of a module are listed."""
    room = module.removeprefix("tomopose.")
    fits = [(len(r), page) for page, (_, rooms) in GROUPS.items() for r in rooms if (room + ".").startswith(r + ".")]
    if not fits:
        raise ValueError(f"{module}: no page of the reference lists it; give its room to one of GROUPS")
    return max(fits)[1]


def write_reference(app: object) -> None:
    """One page a task, with every public name on one of them, so that a new one cannot be forgotten."""
    folder = FOLDER / "_generated"
    folder.mkdir(exist_ok=True)
    pages: dict[str, list[str]] = {page: [title, "=" * len(title), ""] for page, (title, _) in GROUPS.items()}
    for page, lines in pages.items():
        example = FOLDER.parent / "examples" / "reference" / f"{page}.py"
        lines += [f".. literalinclude:: ../../examples/reference/{page}.py", "   :language: python", ""]
        if not example.is_file():
            raise FileNotFoundError(f"{example}: each page of the reference begins with an example that runs")
    for name in tomopose.__all__:
        value = getattr(tomopose, name)
        if inspect.ismodule(value):
            pages["files"] += [f".. automodule:: {value.__name__}", "   :members:", "   :no-index:", ""]
            continue
        kind = "class" if isinstance(value, type) else "function" if callable(value) else "data"
        pages[group_of(value.__module__)] += [name, "-" * len(name), "", f".. auto{kind}:: tomopose.{name}"]
        members = kind == "class" and not issubclass(value, Exception)
        pages[group_of(value.__module__)] += ["   :members:", ""] if members else [""]
    index = ["Python reference", "================", "", "Every public name of ``tomopose``, by task.", ""]
    index += [".. toctree::", "", *(f"   reference_{page}" for page in GROUPS), ""]
    for page, lines in {**{f"reference_{p}": lines for p, lines in pages.items()}, "reference": index}.items():
        target, text = folder / f"{page}.rst", "\n".join(lines)
        if not target.exists() or target.read_text(encoding="utf-8") != text:
            target.write_text(text, encoding="utf-8")


def keep_docstrings_as_written(
    app: object, what: str, name: str, value: object, options: object, lines: list[str]
) -> None:
    """Docstrings are written to be read in an editor; the page shows them so, the first paragraph as prose."""
    text = "\n".join(lines).strip()
    if not text:
        return
    first, _, rest = text.partition("\n\n")
    prose = re.split(r"(`+[^`]+`+)", " ".join(first.split()))
    shown = "".join(f"``{p.strip('`')}``" if p.startswith("`") else SPECIAL.sub(r"\\\1", p) for p in prose)
    lines[:] = [shown, ""]
    if rest.strip():
        lines += [".. code-block:: text", "", *(f"   {line}" for line in rest.rstrip().splitlines()), ""]


def plain_defaults(
    app: object, what: str, name: str, value: object, options: object, signature: str | None, returned: str | None
) -> tuple[str, str | None] | None:
    """Defaults that are made anew for each object, as three dots."""
    return None if signature is None else (signature.replace("<factory>", "..."), returned)


def setup(app: object) -> None:
    app.connect("builder-inited", write_reference)  # type: ignore[attr-defined]
    app.connect("autodoc-process-signature", plain_defaults)  # type: ignore[attr-defined]
    app.connect("autodoc-process-docstring", keep_docstrings_as_written)  # type: ignore[attr-defined]
