"""An OLE2 container (MS-CFB, version 3) written from its public specification, for files in Xradia's layout."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

SECTOR, MINI, CUTOFF = 512, 64, 4096
FREE, END, FAT = 0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFFD


def padded(data: bytes, size: int) -> bytes:
    return data + bytes(-len(data) % size)


def chain(table: list[int], count: int) -> int:
    """Adds a chain of that many sectors to an allocation table; its first sector."""
    start = len(table)
    table += [*range(start + 1, start + count), END] if count else []
    return start if count else END


def write_ole(path: Path, streams: dict[str, bytes]) -> None:
    """Streams by name, FOLDER/NAME or NAME."""
    fat: list[int] = []
    body, mini, mini_fat = b"", b"", []
    entries = [["Root Entry", 5, FREE, FREE, END, 0]]  # name, type, right, child, start, size
    folders: dict[str, int] = {"": 0}
    children: dict[int, list[int]] = {0: []}
    for name, data in streams.items():
        folder, _, leaf = name.rpartition("/")
        if folder not in folders:
            folders[folder] = len(entries)
            children[0].append(len(entries))
            children[len(entries)] = []
            entries.append([folder, 1, FREE, FREE, 0, 0])
        if len(data) < CUTOFF:
            start = chain(mini_fat, -(-len(data) // MINI))
            mini += padded(data, MINI)
        else:
            start = chain(fat, -(-len(data) // SECTOR))
            body += padded(data, SECTOR)
        children[folders[folder]].append(len(entries))
        entries.append([leaf, 2, FREE, FREE, start, len(data)])
    for parent, members in children.items():
        members.sort(key=lambda k: (len(entries[k][0]), entries[k][0].upper()))
        for k, following in zip(members, [*members[1:], FREE], strict=True):
            entries[k][2] = following
        entries[parent][3] = members[0] if members else FREE
    entries[0][4], entries[0][5] = chain(fat, -(-len(mini) // SECTOR)), len(mini)
    body += padded(mini, SECTOR)
    table = padded(b"".join(struct.pack("<I", k) for k in mini_fat), SECTOR)
    table = table[: 4 * len(mini_fat)] + b"\xff" * (len(table) - 4 * len(mini_fat))
    first_mini = chain(fat, len(table) // SECTOR)
    body += table
    directory = b""
    for name, kind, right, child, start, size in entries:
        text = (name + "\0").encode("utf-16-le")
        directory += text.ljust(64, b"\0") + struct.pack("<HBBIII", len(text), kind, 1, FREE, right, child)
        directory += bytes(16 + 4 + 16) + struct.pack("<IQ", start, size)
    first_entry = chain(fat, len(padded(directory, SECTOR)) // SECTOR)
    body += padded(directory, SECTOR)
    count = 1
    while (len(fat) + count) * 4 > count * SECTOR:
        count += 1
    first_fat = len(fat)
    fat += [FAT] * count
    held = b"".join(struct.pack("<I", k) for k in fat).ljust(count * SECTOR, b"\xff")
    head = b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(16) + struct.pack("<HHHHH", 0x3E, 3, 0xFFFE, 9, 6) + bytes(6)
    head += struct.pack("<IIIIIIIII", 0, count, first_entry, 0, CUTOFF, first_mini, len(table) // SECTOR, END, 0)
    head += b"".join(struct.pack("<I", first_fat + k if k < count else FREE) for k in range(109))
    path.write_bytes(head + body + held)


def write_txrm(path: Path, images: np.ndarray, **numbers: object) -> None:
    """Images (n, rows, columns) uint16 or float32 in the streams that txrm2tiff and dxchange read.

    numbers: further streams by name with `__` for `/`; floats become float32, whole numbers int32.
    """
    n, rows, columns = images.shape
    code = {"uint16": 5, "float32": 10}[images.dtype.name]
    streams = {
        "ImageInfo/NoOfImages": struct.pack("<i", n),
        "ImageInfo/ImageWidth": struct.pack("<i", columns),
        "ImageInfo/ImageHeight": struct.pack("<i", rows),
        "ImageInfo/DataType": struct.pack("<i", code),
    }
    for name, value in numbers.items():
        array = np.atleast_1d(np.asarray(value))
        streams[name.replace("__", "/")] = array.astype("<f4" if array.dtype.kind == "f" else array.dtype).tobytes()
    for k, image in enumerate(images):
        streams[f"ImageData{k // 100 + 1}/Image{k + 1}"] = image.tobytes()
    write_ole(path, {k: v for k, v in streams.items() if v != b""})
