"""One key for everything that is kept between runs: journals, checkpoints, study steps, partial stacks, simulated runs.

A kept piece of work is used again only by a run that would make the same bytes.  Its key holds one entry for each thing
that the bytes depend on: the content of every input (arrays and files whole; rows are never sampled), each setting,
masks, flats, the seed, and the versions of this package and of the libraries that calculate.

    key = key_of("reconstruction-checkpoint", images=digest_of_images(images), matrices=P, grid=grid, **settings)
    if goes_on(folder / "key.json", key, what="the checkpoint in runs/a"):
        ...                     # the state there was made with the same key
    else:                       # nothing is kept, or a warning has named what differs
        ...                     # clear the folder
        write_key(folder / "key.json", key)

Values are compared canonically and by type: the order of a mapping's entries does not matter; 1, 1.0, True and "1" are
four values; an array is its dtype, its shape and its bytes.  A value that has no canonical form (a function, an open
file) is refused with TypeError rather than compared by its name or its address.
"""

from __future__ import annotations

import hashlib
import math
import struct
import warnings
from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import MappingProxyType

import numpy as np

from tomopose.errors import FileError
from tomopose.files import read_json, write_json
from tomopose.provenance import package_version, sha256

SCHEMA_NAME = "key"
CALCULATING = ("tomopose", "numpy", "scipy", "numba")
"""The packages whose version may change the bytes of a result."""

LONGEST_SHOWN = 60
MOST_NAMED = 5


class StartsAnewWarning(UserWarning):
    """What was kept from an earlier run belongs to other inputs or settings; the work begins again."""


@dataclass(frozen=True, kw_only=True)
class Key:
    """What a kept piece of work was made with.

    kind:  what is kept, for example "study-step".
    parts: name of an input or setting -> its canonical form; short values in words ("float 0.8"), all others as
           "sha256 ...".
    """

    kind: str
    parts: Mapping[str, str]

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", MappingProxyType(dict(sorted(self.parts.items()))))

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def digest(self) -> str:
        """SHA-256 of the whole key, 64 hexadecimal digits."""
        return digest_of({"kind": self.kind, "parts": dict(self.parts)})

    def changes(self, kept: Key) -> tuple[str, ...]:
        """What differs from a kept key, one phrase each; empty where the two are equal."""
        if kept.kind != self.kind:
            return (f"it is a {kept.kind}, not a {self.kind}",)
        names = sorted({*self.parts, *kept.parts})
        return tuple(
            _change(name, kept.parts.get(name), self.parts.get(name))
            for name in names
            if kept.parts.get(name) != self.parts.get(name)
        )

    def to_json(self) -> dict[str, object]:
        """As it is written beside or into what is kept."""
        return {"kind": self.kind, "parts": dict(self.parts)}

    @classmethod
    def from_json(cls, block: object) -> Key | None:
        """A kept key; None where the block is not valid, so that what lies beside it is not used."""
        if not isinstance(block, Mapping) or not isinstance(block.get("parts"), Mapping):
            return None
        parts = {str(name): str(value) for name, value in block["parts"].items()}
        return cls(kind=str(block.get("kind", "")), parts=parts)


def key_of(kind: str, **parts: object) -> Key:
    """The key of a piece of work of this kind, from everything that its bytes depend on.

    A Path is the content of that file (a folder: of all its files, by name).  A mapping gives one part an entry
    ("settings.relaxation"), so that a difference can be named.  The versions of the calculating packages are added.

    Raises FileError where a file cannot be read, TypeError for a value without a canonical form.
    """
    found: dict[str, str] = {f"version of {name}": package_version(name) for name in CALCULATING}
    for name, value in parts.items():
        found |= _flat(name, value)
    return Key(kind=kind, parts=found)


def goes_on(path: Path, key: Key, *, what: str) -> bool:
    """Whether the key kept in the file `path` is this one, so that the work beside it can be used again.

    False where nothing is kept; where another key is kept, or none can be read, StartsAnewWarning says so and names
    what differs.  `what` is the subject of that sentence: "the checkpoint in runs/a".
    """
    if not path.exists():
        return False
    try:
        kept = Key.from_json(read_json(path, SCHEMA_NAME))
    except FileError:
        kept = None
    return same_key(kept, key, what=what)


def same_key(kept: Key | None, key: Key, *, what: str) -> bool:
    """As `goes_on`, for a key that was read already (None: there is work, but its key is missing or damaged)."""
    if kept == key:
        return True
    warnings.warn(anew(kept, key, what=what), StartsAnewWarning, stacklevel=3)
    return False


def anew(kept: Key | None, key: Key, *, what: str) -> str:
    """The sentence that says why kept work is not used."""
    if kept is None:
        return f"{what} has no readable key of its inputs and settings; the work starts anew"
    changes = key.changes(kept)
    named = "; ".join(changes[:MOST_NAMED])
    more = f"; and {len(changes) - MOST_NAMED} more" if len(changes) > MOST_NAMED else ""
    return f"{what} was made with other inputs or settings ({named}{more}); the work starts anew"


def write_key(path: Path, key: Key) -> None:
    """Write the key, atomically: after what belonged to another key is gone, before what belongs to this one."""
    write_json(path, SCHEMA_NAME, key.to_json())


def digest_of(value: object) -> str:
    """SHA-256 of a value's canonical and typed form, 64 hexadecimal digits.

    Takes None, truth values, numbers, text, bytes, enumerations, paths (the file's content), arrays (whole), mappings,
    sets, sequences and dataclasses of these.  Raises TypeError for anything else.
    """
    return _digest(value).hex()


def digest_of_images(images: Iterable[object]) -> str:
    """SHA-256 of all pixels of all images, in order, one image in memory at a time."""
    whole = hashlib.sha256()
    count = 0
    for image in images:
        whole.update(_digest(np.asarray(image)))
        count += 1
    return hashlib.sha256(f"images {count} ".encode() + whole.digest()).hexdigest()


def _flat(name: str, value: object) -> dict[str, str]:
    """A part, or the entries of a mapping or dataclass under the part's name."""
    if is_dataclass(value) and not isinstance(value, type):
        members = {f.name: getattr(value, f.name) for f in fields(value)}
        return {name: f"a {type(value).__name__}", **_flat(name, members)}
    if isinstance(value, Mapping) and value and all(isinstance(k, str) for k in value):
        found: dict[str, str] = {}
        for entry, inner in value.items():
            found |= _flat(f"{name}.{entry}", inner)
        return found
    return {name: _form(value)}


def _form(value: object) -> str:
    """Short values in words, so that a difference can be read; others by their digest."""
    plain = value.item() if isinstance(value, np.generic) else value
    if plain is None or (isinstance(plain, (bool, int, float, str)) and not isinstance(plain, Enum)):
        shown = f"{type(plain).__name__} {plain!r}" if plain is not None else "nothing"
        if len(shown) <= LONGEST_SHOWN:
            return shown
    return f"sha256 {digest_of(value)}"


def _change(name: str, kept: str | None, now: str | None) -> str:
    """One difference in words."""
    if kept is None:
        return f"{name} is new"
    if now is None:
        return f"{name} is not given now"
    if kept.startswith("sha256 ") or now.startswith("sha256 "):
        return f"{name} changed"
    return f"{name} was {_shown(kept)}, now {_shown(now)}"


def _shown(form: str) -> str:
    kind, _, value = form.partition(" ")
    return value if kind in ("bool", "int", "float", "str") else form


def _tagged(tag: str, *payload: bytes) -> bytes:
    digest = hashlib.sha256(tag.encode() + b"\0")
    for piece in payload:
        digest.update(len(piece).to_bytes(8, "little"))
        digest.update(piece)
    return digest.digest()


def _digest(value: object) -> bytes:
    """The SHA-256 of one value: a tag of its type, then its content, or the digests of its members."""
    if isinstance(value, np.generic) and not isinstance(value, np.void):
        value = value.item()
    if value is None:
        return _tagged("none")
    if isinstance(value, Enum):
        return _tagged("enum", type(value).__name__.encode(), value.name.encode())
    if isinstance(value, (bool, int)):
        return _tagged(type(value).__name__, repr(value).encode())
    if isinstance(value, float):
        return _tagged("float", b"nan" if math.isnan(value) else struct.pack("<d", value))
    if isinstance(value, complex):
        return _tagged("complex", struct.pack("<dd", value.real, value.imag))
    if isinstance(value, str):
        return _tagged("str", value.encode("utf-8", "surrogatepass"))
    if isinstance(value, (bytes, bytearray, memoryview)):
        return _tagged("bytes", bytes(value))
    if isinstance(value, Path):
        return _digest_of_file(value)
    if isinstance(value, np.ndarray):
        return _digest_of_array(value)
    return _digest_of_members(value)


def _digest_of_members(value: object) -> bytes:
    if is_dataclass(value) and not isinstance(value, type):
        members = [_tagged(f.name, _digest(getattr(value, f.name))) for f in fields(value)]
        return _tagged("dataclass", type(value).__name__.encode(), *members)
    if isinstance(value, Mapping):
        return _tagged("mapping", *sorted(_tagged("entry", _digest(k), _digest(v)) for k, v in value.items()))
    if isinstance(value, AbstractSet):
        return _tagged("set", *sorted(_digest(v) for v in value))
    if isinstance(value, (list, tuple, range)):
        return _tagged("sequence", *(_digest(v) for v in value))
    raise TypeError(f"a {type(value).__name__} has no canonical form; give its content, or digest_of_images(...)")


def _digest_of_array(value: np.ndarray) -> bytes:
    if value.dtype.hasobject:
        raise TypeError("an array of Python objects has no canonical form; give its content")
    form = repr((value.dtype.descr if value.dtype.names else value.dtype.str, value.shape))
    digest = hashlib.sha256(f"array {form}\0".encode())
    whole = value if value.flags.c_contiguous else np.ascontiguousarray(value)
    digest.update(whole.reshape(-1).view(np.uint8).data if whole.size else b"")
    return digest.digest()


def _digest_of_file(path: Path) -> bytes:
    """The content of a file, or of all files in a folder with their names inside it; never where it lies."""
    try:
        if path.is_dir():
            inside = sorted(p for p in path.rglob("*") if p.is_file())
            return _tagged("folder", *(_tagged(p.relative_to(path).as_posix(), sha256(p).encode()) for p in inside))
        return _tagged("file", sha256(path).encode())
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}", path=path) from error
