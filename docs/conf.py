"""How the documentation is built:  sphinx-build -W -b html docs docs/_build/html"""

from __future__ import annotations

import re
from pathlib import Path

import tomopose

project = "tomopose"
author = "The tomopose developers"
copyright = "The tomopose developers"
release = version = tomopose.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc"]
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
root_doc = "index"
exclude_patterns = ["_build", "changelog.d", "**/README.md"]
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings give shapes, units and frames
add_module_names = False

html_theme = "furo"
html_title = "tomopose"
html_static_path = ["_static"]
html_css_files = ["tomopose.css"]

FOLDER = Path(__file__).parent
SPECIAL = re.compile(r"([\\*_`|<>])")


def write_reference(app: object) -> None:
    """One page that documents every public name, so that a new one cannot be forgotten."""
    lines = ["Python reference", "================", "", "Every public name of ``tomopose``, by alphabet.", ""]
    for name in tomopose.__all__:
        value = getattr(tomopose, name)
        kind = "class" if isinstance(value, type) else "function"
        lines += [name, "-" * len(name), "", f".. auto{kind}:: tomopose.{name}"]
        lines += ["   :members:"] if kind == "class" and not issubclass(value, Exception) else []
        lines += ["   :no-index-entry:", ""]
    target = FOLDER / "_generated" / "reference.rst"
    target.parent.mkdir(exist_ok=True)
    text = "\n".join(lines)
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
