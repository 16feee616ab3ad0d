"""Whole files and folders: swapped in one step, one writer at a time, and nothing of killed runs stays."""

from __future__ import annotations

import os
import signal
import socket

import pytest

from tomopose.atomic import (
    _host,
    _start_of,
    atomic_file,
    atomic_folder,
    deferred_signals,
    only_writer,
    remove_leftovers,
    require_absent,
)
from tomopose.errors import FileError


def write(folder, text, *names, **options):
    with atomic_folder(folder, **options) as made:
        for name in names:
            (made / name).parent.mkdir(parents=True, exist_ok=True)
            (made / name).write_text(text)


def names(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())


def test_a_new_result_takes_the_old_ones_place_and_other_files_stay(tmp_path):
    out = tmp_path / "out"
    write(out, "old", "a.csv", "b.csv", "sub/c.csv")
    (out / "mine.txt").write_text("mine")
    (out / "sub" / "notes.txt").write_text("mine")
    write(out, "new", "a.csv", "sub/d.csv", force=True, stale=("b.csv", "sub/c.csv", "never.csv"))
    assert names(out) == ["a.csv", "mine.txt", "sub/d.csv", "sub/notes.txt"]
    assert (out / "a.csv").read_text() == "new"
    assert names(tmp_path) == [f"out/{n}" for n in names(out)]


def test_the_folder_in_which_somebody_works_keeps_its_place(tmp_path, monkeypatch):
    out = tmp_path / "out"
    write(out, "old", "a.csv", "b.csv")
    inode = out.stat().st_ino
    monkeypatch.chdir(out)
    write(".", "new", "a.csv", force=True, stale=("b.csv",))
    assert out.stat().st_ino == inode
    assert names(out) == ["a.csv"]
    assert (out / "a.csv").read_text() == "new"


def test_a_name_in_the_way_stops_before_anything_moved(tmp_path):
    write(tmp_path / "out", "old", "b.csv")
    with pytest.raises(FileError, match=r"b\.csv exists already"):
        write(tmp_path / "out", "new", "a.csv", "b.csv")
    assert names(tmp_path) == ["out/b.csv"]


def test_the_second_writer_of_a_folder_is_refused_by_name(tmp_path):
    with only_writer(tmp_path / "out"):
        with pytest.raises(FileError, match=f"out is being written by process {os.getpid()} on {socket.gethostname()}"):
            write(tmp_path / "out", "new", "a.csv")
        with only_writer(tmp_path / "other"):
            pass
    write(tmp_path / "out", "new", "a.csv")
    assert names(tmp_path) == ["out/a.csv"]


def test_leftovers_of_killed_runs_go_and_those_of_living_ones_stay(tmp_path):
    living = f"{os.getpid()}-{_start_of(os.getpid())}"
    for name in (
        f".a-{_host()}-999999999-1-x.csv",
        f".b-{_host()}-{os.getpid()}-1-y",
        f".c-{_host()}-{living}-z.csv",
        ".d-elsewhere-999999999-1-x.csv",
        ".hidden",
        "a-1-2-3.csv",
    ):
        (tmp_path / name).write_text("x")
    (tmp_path / f".geo-{_host()}-999999999-1-q").mkdir()
    remove_leftovers(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        [f".c-{_host()}-{living}-z.csv", ".d-elsewhere-999999999-1-x.csv", ".hidden", "a-1-2-3.csv"]
    )


def test_an_interruption_leaves_no_temporary_file(tmp_path):
    def interrupted():
        with atomic_folder(tmp_path / "out") as made:
            (made / "a").write_text("x")
            with atomic_file(tmp_path / "b.csv") as temporary:
                temporary.write_text("x")
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []


def test_signals_wait_until_the_swap_is_over():
    came = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: came.append(number))
    try:
        with deferred_signals():
            os.kill(os.getpid(), signal.SIGTERM)
            assert came == []
        assert came == [signal.SIGTERM]
    finally:
        signal.signal(signal.SIGTERM, before)


def test_places_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    (tmp_path / "file").write_text("x")
    with pytest.raises(FileError, match="link to nothing"):
        require_absent(tmp_path / "link", force=True)
    with pytest.raises(FileError, match="file or a link to nothing"):
        write(tmp_path / "link", "x", "a")
    with pytest.raises(FileError, match="link is a link to nothing"):
        write(tmp_path / "link" / "below" / "it", "x", "a")
    with pytest.raises(FileError, match="link is a link to nothing"), atomic_file(tmp_path / "link" / "x"):
        pass
    assert not (tmp_path / "gone").exists()
    with pytest.raises(FileError, match="a folder is needed"):
        write(tmp_path / "file", "x", "a")
    with pytest.raises(FileError, match="File name too long"):
        write(tmp_path / ("x" * 300), "x", "a")
    with pytest.raises(FileError, match=r"cannot be written|Not a directory"), atomic_file(tmp_path / "file" / "b"):
        pass
    with pytest.raises(FileError, match="no path that can be written"):
        require_absent("a\0b")


def test_devices_pipes_and_sockets_are_refused_and_stay(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for name in ("pipe", "link"):
        with pytest.raises(FileError, match="device, a pipe or a socket"):
            require_absent(tmp_path / name, force=True)
        with pytest.raises(FileError, match="device, a pipe or a socket"), atomic_file(tmp_path / name) as temporary:
            temporary.write_text("x")
    assert (tmp_path / "pipe").is_fifo()
    assert (tmp_path / "link").is_symlink()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "pipe"]


def test_a_link_to_a_file_stays_and_the_file_gets_the_new_content(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "file").write_text("old")
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere" / "file")
    with atomic_file(tmp_path / "link") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "elsewhere" / "file").read_text() == "new"
    assert [p.name for p in (tmp_path / "elsewhere").iterdir()] == ["file"]


def test_a_full_disk_is_an_error_and_leaves_nothing(tmp_path):
    def full():
        with atomic_file(tmp_path / "a.csv") as temporary:
            temporary.write_text("x")
            raise OSError(28, "No space left on device")

    with pytest.raises(FileError, match=r"a\.csv cannot be written: No space left on device"):
        full()
    assert list(tmp_path.iterdir()) == []
