"""Logs that a command reads: which robot of several it takes is said."""

from collections.abc import Sequence
from pathlib import Path

from experiments.runs.console import show
from sim.formats.detect import describe_choice, read_any
from sim.recording import Recording


def read_log(log: Sequence[Path], robot: int | None = None, *, by_flag: bool = True) -> Recording:
    """Read a log of one robot, as `read_any` does; of several say which it is.

    Parameters
    ----------
    by_flag
        As for `describe_choice`.
    """
    recording = read_any(log, robot)
    if robot is None:
        say_choice(log[0], recording, by_flag=by_flag)
    return recording


def say_choice(path: Path, recording: Recording, *, by_flag: bool = False) -> None:
    """Say which robot of several a recording is that nobody chose."""
    if choice := describe_choice(path, recording, by_flag=by_flag):
        show(choice)
