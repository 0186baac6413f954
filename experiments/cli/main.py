"""The command `estima`. Heavy libraries are imported inside the commands, so that help is quick."""

from __future__ import annotations

import copy
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from experiments.cli import logs, look, project, run, score, submit, tables
from experiments.cli.flags import PASS_ON
from experiments.runs.console import exit_with
from experiments.runs.paths import TRUST
from experiments.runs.version import code_version
from sim.errors import InputError, blaming, require

app = typer.Typer(
    help="Estima: simulate differential-drive robots, run localization on the same recordings, "
    "sweep parameters, and judge the papers' claims.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
_INTERRUPTED = 128 + 2  # by SIGINT


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"estima {version('estima')}, code {code_version()}")
        raise typer.Exit


@app.callback()
def options_of_all(
    results: Annotated[
        Path | None,
        typer.Option(
            "--results",
            envvar="ESTIMA_RESULTS",
            file_okay=False,
            help="Folder of results; `results` unless set. Before or after the command's name.",
        ),
    ] = None,
    trust: Annotated[
        bool,
        typer.Option(
            "--trust",
            help="Run what results, studies and suites from elsewhere name (docs/security.md). "
            "Before or after the command's name.",
        ),
    ] = False,
    _: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Options of all commands."""
    if results is not None:
        os.environ["ESTIMA_RESULTS"] = str(results.absolute())
    if trust:
        os.environ[TRUST] = "1"


_COMMANDS: dict[str, dict[str, Callable[..., None]]] = {  # as `estima --help` lists them
    "Run": {
        "run": run.run,
        "options": look.options,
        "recommend": look.recommend,
        "record": run.record,
        "view": look.view,
        "map": look.build_map,
    },
    "Sweeps": {
        "table": tables.table,
        "plot": tables.plot,
        "report": tables.report,
        "tune": run.tune,
        "cache": project.cache,
    },
    "Logs and trajectories": {
        "info": logs.info,
        "convert": logs.convert,
        "solve": logs.solve,
        "score": score.score,
        "compare": score.compare,
        "calibrate": logs.calibrate,
        "twin": logs.twin,
    },
    "Your own method": {
        "conform": score.conform,
        "check": project.check,
        "bisect": project.bisect,
        "history": project.history,
        "bench": project.bench,
    },
    "The papers": {
        "reproduce": project.reproduce,
        "audit": project.audit,
        "results": project.list_results,
        "export-table": tables.export_table,
    },
}
for _panel, _commands in _COMMANDS.items():
    for _name, _command in _commands.items():
        _context = PASS_ON if _name == "run" else None
        app.command(_name, context_settings=_context, rich_help_panel=_panel)(_command)
app.add_typer(submit.app, name="submit", rich_help_panel="Your own method")


def main() -> None:
    """Run the command line; wrong input ends in one line and code 2, a failed run in code 1."""
    _open_closed_streams()
    try:
        try:
            Path.cwd()
        except OSError:
            gone = "the current folder is gone, or may not be entered; cd to another"
            raise InputError(gone) from None
        _check_environment()
        try:
            words = _own_first(sys.argv[1:])
            folders = [w for w in words if w.partition("=")[0] in ("--config-dir", "-cd")]
            require(len(folders) < 2, "--config-dir twice; put the options into one folder")
            _only_named(words)(words)
        finally:
            with suppress(ValueError):  # an estimator has closed it
                sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as error:
        exit_with(error)
    except SystemExit as ended:
        if ended.code == _INTERRUPTED:  # Typer has caught the interrupt, which may hold a message
            exit_with(ended)
        raise


def _only_named(words: list[str]) -> typer.Typer:
    """The app with no command but the one that is named: Typer takes 2 ms to make each."""
    named = [command for command in app.registered_commands if command.name in words]
    if not named or words[0] in ("-h", "--help"):
        return app
    one = copy.copy(app)
    one.registered_commands = named
    return one


def _check_environment() -> None:
    """Refuse, or bound, what libraries would fail at."""
    for name, least in {"OMP_NUM_THREADS": 1, "SOURCE_DATE_EPOCH": 0}.items():
        given = os.environ.get(name) or "1"
        require(
            given.isdecimal() and int(given) >= least,
            f"{name} must be a whole number, at least {least}, got {given!r}",
        )
    if os.environ.get("MPLBACKEND"):
        with blaming(f"MPLBACKEND={os.environ['MPLBACKEND']}"):
            import matplotlib  # noqa: F401
    if os.environ.get("COLUMNS", "").isdecimal():  # a page of help is drawn as wide
        os.environ["COLUMNS"] = str(min(int(os.environ["COLUMNS"]), 1000))


def _open_closed_streams() -> None:
    """Give whoever closed a standard stream the null device, lest a file takes its number."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    sys.stdout = sys.stdout or os.fdopen(1, "w")
    sys.stderr = sys.stderr or os.fdopen(2, "w")


def _own_first(arguments: list[str]) -> list[str]:
    """Move `--results DIR` and `--trust`, which may be anywhere, before the command's name."""
    if "--trust" in arguments:
        return ["--trust", *_own_first([a for a in arguments if a != "--trust"])]
    for i, argument in enumerate(arguments):
        if argument.partition("=")[0] == "--results":
            n_words = 1 if "=" in argument else 2
            given = [*argument.split("=", 1)[1:], *arguments[i + 1 :]]
            if not given or not given[0]:
                raise InputError("--results must name a folder")
            return [*arguments[i : i + n_words], *arguments[:i], *arguments[i + n_words :]]
    return arguments
