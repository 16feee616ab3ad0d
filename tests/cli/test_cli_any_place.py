"""Any place, any terminal: pipes, full disks, encodings, read-only folders, no network."""

from __future__ import annotations

import io
import json
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from tomopose import kernel_cache
from tomopose.cli import main as program
from tomopose.cli.common import as_line, speak_any_terminal, tell


@pytest.mark.parametrize(
    "words", [["calibrate", "--nonsense"], ["export", "--out", ""], ["export", "--out="], ["nonsense"]]
)
def test_usage_errors_are_one_json_object_where_that_is_asked_for(words, capsys):
    assert program.run([*words, "--json"]) == 2
    printed = capsys.readouterr()
    found = json.loads(printed.out)["error"]
    assert found["exit_code"] == 2
    assert found["message"]
    assert found["message"].split(":")[0] in printed.err


def test_an_empty_path_is_no_working_folder(capsys):
    assert program.run(["export", "--matrices", "m.npz", "--out", ""]) == 2
    assert "--out" in capsys.readouterr().err


class Closed(io.StringIO):
    """Standard output whose reader has left."""

    def write(self, text):
        raise BrokenPipeError(32, "Broken pipe")

    def fileno(self):
        raise OSError


def test_a_reader_that_has_left_is_no_error(monkeypatch):
    monkeypatch.setattr(sys, "stdout", Closed())
    assert program.run(["--version"]) == 0


def test_a_full_disk_behind_standard_output_is_an_error(monkeypatch, capsys):
    with open("/dev/full", "w", encoding="utf-8") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert program.run(["--version"]) == 1
    assert "No space left on device" in capsys.readouterr().err


def test_notes_to_nobody_do_not_stop_the_work(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Closed())
    tell("a note")


@pytest.mark.parametrize(
    ("encoding", "shown"), [("ascii", "3 um +- 1 -> ?"), ("latin-1", "3 µm ± 1 -> ?"), ("utf-8", "3 µm ± 1 -> →")]
)
def test_a_terminal_without_unicode_shows_other_characters(monkeypatch, encoding, shown):
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(sys, "stderr", io.TextIOWrapper(io.BytesIO(), encoding=encoding))
    speak_any_terminal()
    print("3 µm ± 1 -> →")
    stream.flush()
    assert stream.buffer.getvalue().decode(encoding).strip() == shown
    assert json.loads(as_line({"a": "→"}).encode(encoding).decode(encoding)) == {"a": "→"}


@pytest.mark.parametrize(
    ("raised", "code"),
    [
        (program.Terminated(), 143),
        (KeyboardInterrupt(), 130),
        (MemoryError(), 1),
        (OSError(28, "No space left on device"), 1),
        (PermissionError(13, "Permission denied", "/x"), 1),
        (RuntimeError("ours"), 70),
    ],
)
def test_what_ends_a_verb_has_its_exit_code(monkeypatch, capsys, raised, code):
    def verb(**_):
        raise raised

    class Command:
        main = staticmethod(verb)

    monkeypatch.setattr(program.typer.main, "get_command", lambda app: Command())
    assert program.run(["doctor"]) == code
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_sigterm_is_ctrl_c():
    with pytest.raises(KeyboardInterrupt):
        program._terminate(15, None)


def test_kernels_are_kept_where_they_can_be(monkeypatch, tmp_path):
    monkeypatch.setattr(kernel_cache, "_writable", lambda folder: False)
    monkeypatch.delenv(kernel_cache.VARIABLE, raising=False)
    cache, temporary = tmp_path / "cache", tmp_path / "tmp"
    temporary.mkdir()
    monkeypatch.setattr(kernel_cache.tempfile, "gettempdir", lambda: str(temporary))
    environment = {"XDG_CACHE_HOME": str(cache), "HOME": str(tmp_path / "home")}
    kernel_cache.choose_cache_folder(tmp_path, environment)
    assert Path(kernel_cache.os.environ[kernel_cache.VARIABLE]) == cache / "tomopose" / "kernels"
    assert stat.S_IMODE((cache / "tomopose" / "kernels").stat().st_mode) == 0o700
    (tmp_path / "file").write_text("x")
    kernel_cache.choose_cache_folder(
        tmp_path, {"XDG_CACHE_HOME": str(tmp_path / "file"), "HOME": str(tmp_path / "file")}
    )
    assert Path(kernel_cache.os.environ[kernel_cache.VARIABLE]).parent == temporary
    Path(kernel_cache.os.environ[kernel_cache.VARIABLE]).chmod(0o777)  # somebody else may write there: it is not used
    called = []
    monkeypatch.setattr(kernel_cache, "compile_each_time", lambda: called.append(1))
    monkeypatch.setattr(kernel_cache.sys, "platform", "other")
    kernel_cache.choose_cache_folder(tmp_path, {})
    assert called == [1]
    assert kernel_cache.VARIABLE not in kernel_cache.os.environ


def test_the_packages_own_folder_is_left_to_numba(monkeypatch, tmp_path):
    monkeypatch.delenv(kernel_cache.VARIABLE, raising=False)
    kernel_cache.choose_cache_folder(tmp_path, {})
    assert kernel_cache.VARIABLE not in kernel_cache.os.environ


OFFLINE = """
import socket, sys
from pathlib import Path
assert socket.if_nameindex() in ([], [(1, "lo")]), socket.if_nameindex()
import numpy as np, tomopose as tp
from tomopose.cli.main import run
P = np.tile(np.array([[1000.0, 0, 10, 1e5], [0, 1000.0, 20, 1e5], [0, 0, 1.0, 300.0]]), (3, 1, 1))
out = Path(sys.argv[1])
tp.write_matrices(out / "m.npz", tp.ProjectionMatrices(P=P, n_u=11, n_v=13, p_u=0.2, p_v=0.2, pose_id=("a", "b", "c")))
sys.exit(run(["export", "--matrices", str(out / "m.npz"), "--to", "cil,cera,leap", "--out", str(out / "out")]))
"""


@pytest.mark.slow
def test_nothing_needs_a_network(tmp_path):
    apart = [shutil.which("unshare") or "unshare", "--map-root-user", "--net"]
    try:
        subprocess.run([*apart, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("this system allows no network namespace")
    ended = subprocess.run(
        [*apart, sys.executable, "-c", OFFLINE, str(tmp_path)], check=False, capture_output=True, text=True
    )
    assert ended.returncode == 0, ended.stderr
    assert (tmp_path / "out" / "manifest.json").exists()
