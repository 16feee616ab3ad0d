"""Values that one can hold, and the refusal of others by name."""

from tomopose.values.arguments import require, require_types
from tomopose.values.held import Column, Rows, Tabular, content_hash, equal, shown, table, value, verdict_html
from tomopose.values.images import Images

__all__ = [
    "Column",
    "Images",
    "Rows",
    "Tabular",
    "content_hash",
    "equal",
    "require",
    "require_types",
    "shown",
    "table",
    "value",
    "verdict_html",
]
