"""The arguments of `estima run`, and one run by them."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from omegaconf import OmegaConf

from experiments.cli.flags import check_once, find_own_code
from experiments.runs.compose import open_composer, searched
from experiments.runs.console import show
from experiments.runs.experiment import Experiment
from experiments.runs.run import Draw, run_once
from experiments.sweeps.commands import config_dir_option
from sim.errors import InputError, require


@dataclass(frozen=True)
class CommandLine:
    """Arguments of `estima run`.

    Attributes
    ----------
    overrides
        Hydra's.
    config_dir
        A further folder of options.
    shown
        Whether the configuration is printed, rather than run.
    resolved
        Whether it is printed with values in place of interpolations.
    """

    overrides: Sequence[str]
    config_dir: str | None
    shown: bool
    resolved: bool

    @classmethod
    def of(cls, arguments: Sequence[str]) -> CommandLine:
        """Read overrides and options, in any order.

        Raises
        ------
        InputError
            If an option is unknown, or lacks its value.
        """
        parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
        parser.add_argument("overrides", nargs="*")
        parser.add_argument("--config-dir", "-cd")
        parser.add_argument("--cfg", "-c", choices=["job"])
        parser.add_argument("--resolve", action="store_true")
        known = "estima run takes overrides, -m, --config-dir FOLDER, --cfg job and --resolve"
        try:
            given, others = parser.parse_known_intermixed_args(arguments)
        except argparse.ArgumentError as error:
            raise InputError(f"{error}; {known}") from error
        require(not others, f"{' '.join(others)}: {known}")
        if given.config_dir is not None:
            find_own_code(Path(given.config_dir))
        check_once(given.overrides)
        return cls(given.overrides, given.config_dir, given.cfg is not None, given.resolve)


def run_arguments(arguments: Sequence[str], draw: Draw, out: Path | None = None) -> None:
    """Run one configuration by a command line's arguments, or print it."""
    line = CommandLine.of(arguments)
    with open_composer([*searched(line.config_dir), *line.overrides]) as composer:
        found = composer.compose(composer.words)
    if line.shown:
        show(OmegaConf.to_yaml(found.cfg, resolve=line.resolved))
        return
    if found.cfg.get("sweeps") or found.params:
        raise InputError(
            f"the configuration sweeps values (study={found.choices.get('study')}); add -m: "
            f"estima run -m {shlex.join(line.overrides)}"
        )
    experiment = Experiment(*found.resolve())
    run_once(experiment, draw, out)
    _say_next(experiment, line)


def _say_next(experiment: Experiment, line: CommandLine) -> None:
    """Say what can be done after a simulated run."""
    if experiment.from_file:
        return
    options = config_dir_option(line.config_dir)
    others = [word for word in line.overrides if word.lstrip("+").partition("=")[0] != "seed"]
    said = shlex.join(["estima", "run", *others, *options])
    lines = []
    if not experiment.has_own_map:  # another seed is another world
        lines.append(f"intervals over ten drives: {said} -m 'seed=range(0,10)'")
    if experiment.command is None:  # `view` cannot be told it
        drive = shlex.join(["estima", "record", "-o", "run.npz", *line.overrides, *options])
        view = ["estima", "view", "run.npz", "-e", experiment.estimator_name, *options]
        lines.append(f"as it moves: {drive} && {shlex.join([*view, '-o', 'run.html'])}")
    for number, text in enumerate(lines):
        show(("      " if number else "Next: ") + text)
