"""Damage done to a file's bytes: what transfers, disks, editors and other programs do, and what nobody would do."""

from __future__ import annotations

import contextlib
import json
import random
import re
from collections.abc import Callable

LARGEST = 20_000_000
"""Bytes that a line repeated over and over may come to."""
NUMBERS = (
    b"0",
    b"-1",
    b"1e308",
    b"-1e-308",
    b"1e999",
    b"nan",
    b"NaN",
    b"Infinity",
    b"2147483648",
    b"4294967295",
    b"9223372036854775808",
    b"1" + b"0" * 350,
    b"9" * 5000,
    b"1e-30",
    b"true",
    b"null",
    b'"x"',
    b"[]",
    b"{}",
    b"1,5",
    b"",
)
INTEGERS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x40000000, 0x10000)
VALUES: tuple[object, ...] = (
    None,
    True,
    0,
    -1,
    1.5,
    1e308,
    10**400,
    "",
    "x",
    "x" * 5000,
    [],
    [[]],
    {},
    {"a": 1},
    [None],
    "../x",
    2**31,
)


def flip(data: bytearray, rng: random.Random) -> None:
    for _ in range(rng.choice((1, 1, 2, 5, 20))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def overwrite(data: bytearray, rng: random.Random) -> None:
    place, count = rng.randrange(len(data)), rng.choice((1, 2, 4, 8, 64))
    data[place : place + count] = rng.randbytes(min(count, len(data) - place))


def integer(data: bytearray, rng: random.Random) -> None:
    """A revealing whole number where another may be."""
    width = rng.choice((1, 2, 4, 8))
    place = rng.randrange(max(len(data) - width, 1))
    value = rng.choice(INTEGERS) & ((1 << 8 * width) - 1)
    data[place : place + width] = value.to_bytes(width, rng.choice(("little", "big")))


def cut(data: bytearray, rng: random.Random) -> None:
    del data[rng.randrange(len(data)) :]


def drop(data: bytearray, rng: random.Random) -> None:
    place = rng.randrange(len(data))
    del data[place : place + rng.choice((1, 2, 8, 100))]


def double(data: bytearray, rng: random.Random) -> None:
    place, count = rng.randrange(len(data)), rng.choice((1, 4, 32, 300))
    data[place:place] = data[place : place + count] * rng.choice((1, 2, 50))


def move(data: bytearray, rng: random.Random) -> None:
    a, b, count = rng.randrange(len(data)), rng.randrange(len(data)), rng.choice((2, 16, 128))
    data[b : b + count] = data[a : a + count]


def number(data: bytearray, rng: random.Random) -> None:
    """Another number, or no number, where a text has one."""
    found = list(re.finditer(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?", bytes(data)))
    if not found:
        return flip(data, rng)
    one = rng.choice(found)
    data[one.start() : one.end()] = rng.choice(NUMBERS)
    return None


def line(data: bytearray, rng: random.Random) -> None:
    lines = bytes(data).split(b"\n")
    k = rng.randrange(len(lines))
    what = rng.randrange(4)
    if what == 0:
        del lines[k]
    elif what == 1:
        lines.insert(k, lines[rng.randrange(len(lines))])
    elif what == 2:
        lines[k] = lines[k] * min(rng.choice((2, 100, 3000)), 1 + LARGEST // (1 + len(lines[k])))
    else:
        rng.shuffle(lines)
    data[:] = b"\n".join(lines)


def value(data: bytearray, rng: random.Random) -> None:
    """Another kind of value somewhere in a JSON document."""
    try:
        document = json.loads(bytes(data))
    except (ValueError, RecursionError):  # the second change of a document that the first nested deeply
        return number(data, rng)
    places: list[tuple[object, object]] = []
    nodes: list[object] = [document]
    while nodes:
        node = nodes.pop()
        pairs = (
            list(node.items()) if isinstance(node, dict) else list(enumerate(node)) if isinstance(node, list) else []
        )
        places += [(node, key) for key, _ in pairs]
        nodes += [inner for _, inner in pairs]
    if not places:
        return flip(data, rng)
    node, key = rng.choice(places)
    what = rng.randrange(5)
    if what == 0:
        del node[key]  # type: ignore[attr-defined]
    elif what == 1 and isinstance(node, list):
        node.append(node[0])
    elif what == 1 and isinstance(node, dict):
        node["unknown"] = node[key]
    else:
        node[key] = rng.choice(VALUES)  # type: ignore[index]
    with contextlib.suppress(RecursionError):
        data[:] = json.dumps(document).encode()
    return None


BINARY: tuple[Callable[[bytearray, random.Random], None], ...] = (
    flip,
    overwrite,
    integer,
    integer,
    cut,
    drop,
    double,
    move,
)
TEXT: tuple[Callable[[bytearray, random.Random], None], ...] = (
    flip,
    overwrite,
    cut,
    drop,
    double,
    move,
    number,
    number,
    line,
    value,
    value,
    value,
)


def mutant(seed: bytes, rng: random.Random) -> bytes:
    """One to three kinds of damage to a file's bytes."""
    data = bytearray(seed)
    text = b"\0" not in seed[:4096]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        if not data:
            break
        rng.choice(TEXT if text else BINARY)(data, rng)
    return bytes(data)
