"""Every command in the README and the documentation runs as printed, in order.

A comment above a block says what is special about it: `<!-- not run: REASON -->`, or
`<!-- needs: FILE ... -->` for real logs, which are linked from shared/data where it is present.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from shlex import quote

import pytest

from tests.fixtures.log_samples import DATA

ROOT = Path(__file__).resolve().parents[2]
PAGES = ["README.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(
    r"(?:<!-- (?P<how>not run|needs): (?P<what>.*?) -->\n)?```sh\n(?P<lines>.*?)```", re.S
)


def blocks_of(text):
    """Yield how to treat each block of commands, what with, and its lines."""
    for block in BLOCK.finditer(text):
        yield block["how"], block["what"], block["lines"]


@pytest.fixture
def desk(tmp_path):
    """An empty folder with the documentation in it, as in a clone; `estima` is on the PATH."""
    program = tmp_path / "bin" / "estima"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {sys.executable} -m experiments.cli "$@"\n')
    program.chmod(0o755)
    folder = tmp_path / "desk"
    folder.mkdir()
    shutil.copytree(ROOT / "docs" / "examples", folder / "docs" / "examples")
    path = os.pathsep.join(
        [str(program.parent), str(Path(sys.executable).parent), os.environ["PATH"]]
    )
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "COLUMNS": "100"}
    environment.pop("ESTIMA_RESULTS", None)
    return folder, environment


def run_page(text, folder, environment):
    """Run the blocks of a page one after the other; return how many ran, and why others did not."""
    ran, left = 0, []
    at = folder.parent / "at.txt"
    at.write_text(str(folder))
    for name, code in re.findall(r"One file, `(\S+)`:\n\n```python\n(.*?)```", text, re.S):
        (folder / name).write_text(code)
    for name, code in re.findall(r"YAML, `(\S+)`:\n\n```yaml\n(.*?)```", text, re.S):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(code)
    for how, what, lines in blocks_of(text):
        if how == "needs":
            logs = (
                [next(DATA.rglob(name), None) for name in what.split()] if DATA.exists() else [None]
            )
            for log in filter(None, logs):
                (folder / log.name).unlink(missing_ok=True)
                (folder / log.name).symlink_to(log)
            how = None if all(logs) else "not run"
        if how == "not run":
            left.append(what)
            continue
        # -E and the trap name the command that failed; exports hold within a block, and the next
        # one starts in the folder where this one ended
        ended = f"trap 'pwd > {quote(str(at))}' EXIT\n"
        script = "set -eEuo pipefail\ntrap 'echo \"failed: $BASH_COMMAND\" >&2' ERR\n" + ended
        done = subprocess.run(
            ["bash", "-c", script + lines], cwd=at.read_text().strip(), env=environment,
            capture_output=True, text=True, timeout=900,
        )  # fmt: skip
        assert done.returncode == 0, f"{lines}\n{done.stdout[-1500:]}\n{done.stderr[-3000:]}"
        assert "Traceback" not in done.stderr, done.stderr[-3000:]
        ran += 1
    return ran, left


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if "```sh\n" in (ROOT / page).read_text()])
def test_the_commands_of_a_page_run_in_order(page, desk):
    ran, left = run_page((ROOT / page).read_text(), *desk)
    assert ran or left


def test_a_command_that_fails_is_named(desk):
    text = "```sh\necho fine\n```\n<!-- not run: no -->\n```sh\nfalse\n```\n"
    assert run_page(text, *desk) == (1, ["no"])
    moved = "```sh\nmkdir deep && cd deep\n```\n```sh\ntest $(basename $PWD) = deep\n```\n"
    assert run_page(moved, *desk) == (2, [])
    with pytest.raises(AssertionError, match="failed: ls missing"):
        run_page("```sh\nls missing  # a comment\n```\n", *desk)
