"""Flags that several commands have, and how a command takes many of them."""

import dataclasses
import functools
import inspect
import sys
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from experiments.cli import completion
from sim.errors import require

PASS_ON = {
    "allow_extra_args": True,
    "ignore_unknown_options": True,
    "help_option_names": ["-h", "--help"],
}


def check_once(overrides: list[str] | None) -> list[str] | None:
    """Refuse a key that is set twice, of which the second would win silently."""
    for one in overrides or []:
        key = one.lstrip("+").partition("=")[0]
        same = [o for o in overrides or [] if o.lstrip("+").partition("=")[0] == key]
        require(len(set(same)) == 1, f"{key} is set twice ({', '.join(same)}); leave one out")
    return overrides


Overrides = Annotated[
    list[str] | None,
    typer.Argument(
        help="Hydra overrides, such as world=office seed=3.",
        autocompletion=completion.overrides,
        callback=check_once,
    ),
]


def find_own_code(folder: Path | None = None) -> None:
    """Let `_target_` name modules of a folder and of the current one, behind all others."""
    sys.path.extend(str(place.resolve()) for place in (folder, Path()) if place is not None)


def _check_folder(folder: Path | None) -> Path | None:
    require(folder is None or folder.is_dir(), f"--config-dir must name a folder, got {folder}")
    if folder is not None:
        find_own_code(folder)
    return folder


ConfigDir = Annotated[
    Path | None,
    typer.Option(
        "--config-dir", "-cd", help="Folder with options of your own.", callback=_check_folder
    ),
]
Log = Annotated[list[Path], typer.Argument(help="A recording (.npz) or a log of any format.")]
WhichRobot = Annotated[
    int | None,
    typer.Option(
        help="Which robot of an MRCLAM set (from 1; default: 1), or of a team's file (from 0)."
    ),
]
Sweep = Annotated[
    str,
    typer.Argument(
        help="A sweep's name, or a folder or file of rows.", autocompletion=completion.sweeps
    ),
]
Topic = Annotated[
    str | None, typer.Option(help="Of a bag, the nav_msgs/Odometry to read (default: estimate).")
]


def gathered(command: Callable[..., None]) -> Callable[..., None]:
    """A command for Typer, which gets each field of a parameter that is a dataclass as a flag."""
    parameters: list[inspect.Parameter] = []
    groups: dict[str, type[Any]] = {}
    hints = typing.get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        kind = hints[name]
        if not dataclasses.is_dataclass(kind):
            parameters.append(parameter.replace(annotation=kind, kind=parameter.KEYWORD_ONLY))
            continue
        groups[name] = typing.cast("type[Any]", kind)
        fields = typing.get_type_hints(kind, include_extras=True)
        parameters += [
            own.replace(annotation=fields[own.name], kind=own.KEYWORD_ONLY)
            for own in inspect.signature(groups[name]).parameters.values()
        ]

    @functools.wraps(command)
    def called(**given: Any) -> None:
        for name, group in groups.items():
            keys = [field.name for field in dataclasses.fields(group)]
            given[name] = group(**{key: given.pop(key) for key in keys})
        command(**given)

    vars(called)["__signature__"] = inspect.Signature(parameters)
    called.__annotations__ = {own.name: own.annotation for own in parameters}
    return called
