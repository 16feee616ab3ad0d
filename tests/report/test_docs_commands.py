"""The commands in the documentation are commands that the program knows, with options that it has."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

from tomopose.cli.main import VERBS, app

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(p for p in (ROOT / "docs").rglob("*.md") if "_build" not in p.parts) + [ROOT / "README.md"]
SHELLS = ("", "text", "sh", "bash", "console")


def code_lines(text: str) -> list[str]:
    """The lines inside fenced blocks of no language or of a shell's."""
    found, inside, wanted = [], False, False
    for line in text.splitlines():
        if line.startswith("```"):
            inside = not inside
            wanted = inside and line.strip("`").strip() in SHELLS
        elif wanted and found and found[-1].endswith("\\"):
            found[-1] = found[-1].removesuffix("\\") + line.strip()
        elif wanted:
            found.append(line)
    return found


def commands() -> list[tuple[str, str]]:
    """(page, command) of each line in a code block that begins with `tomopose `."""
    return [
        (str(page.relative_to(ROOT)), part.strip())
        for page in PAGES
        for line in code_lines(page.read_text("utf-8"))
        for part in line.split("&&")
        if part.strip().startswith("tomopose ")
    ]


def leaf(words: list[str]) -> tuple[Any, list[str]]:
    """The command that the first words name, and the words that follow it."""
    command: Any = typer.main.get_command(app)
    while words and hasattr(command, "commands"):
        assert words[0] in command.commands, f"no verb {words[0]!r}"
        command, words = command.commands[words[0]], words[1:]
    return command, words


@pytest.mark.parametrize(("page", "line"), commands(), ids=[f"{p}: {c[:60]}" for p, c in commands()])
def test_commands_in_the_documentation_are_known(page, line):
    command, words = leaf(shlex.split(line, comments=True)[1:])
    known = {name for p in command.params for name in p.opts} | {"--help"}
    used = [w.split("=")[0] for w in words if w.startswith("--")]
    assert not set(used) - known, f"{page}: {line}"


def test_there_are_commands_to_check():
    assert len(commands()) > 20


def test_every_verb_has_its_page():
    pages = {p.stem for p in (ROOT / "docs" / "howto").glob("*.md")} - {"index"}
    assert pages == set(VERBS)
