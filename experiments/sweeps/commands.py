"""The commands that made the rows of a folder, kept beside them."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from sim.files import read_text, require_file, write_text

MOST_BYTES = 1 << 20  # of a folder's commands
_OPTION = "--config-dir"


def commands(folder: Path) -> list[str]:
    """Commands that made the rows of a folder, as the sweeps noted them."""
    path = _file(folder)
    return read_text(path, MOST_BYTES).splitlines() if path.exists() else []


def note_command(folder: Path, arguments: Sequence[str], config_dir: str | None) -> str:
    """Keep a sweep's command beside its rows, for pages that show them, and return it."""
    path = _file(folder)
    require_file(path)
    words = ["estima", "run", "-m", *config_dir_option(config_dir), *arguments]
    command = " ".join(shlex.join(words).splitlines())
    if command not in (noted := commands(folder)):
        write_text(path, "\n".join([*noted, command]) + "\n")
    return command


def config_dir_option(config_dir: str | Path | None) -> list[str]:
    """What a command says of a further folder of options; nothing without one."""
    return [_OPTION, str(config_dir)] if config_dir else []


def noted_config_dir(folder: Path) -> str | None:
    """The folder of options that the last sweep into a folder of rows named, if any did."""
    for command in reversed(commands(folder)):
        with suppress(ValueError):  # edited by hand
            words = shlex.split(command)
            if _OPTION in words[:-1]:
                return words[words.index(_OPTION) + 1]
    return None


def _file(folder: Path) -> Path:
    return folder / "command.txt"
