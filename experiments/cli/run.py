"""Commands that make runs: run, record, tune."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from experiments.cli import completion
from experiments.cli.flags import ConfigDir, Overrides
from experiments.runs.console import show
from sim.errors import require


def run(
    context: typer.Context,
    overrides: Overrides = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="File of the estimate to write too: .tum, .csv, .json, .mcap, .bag."
        ),
    ] = None,
    against: Annotated[
        list[str] | None,
        typer.Option(help="With until=decided: compare each with this estimator; repeat it."),
    ] = None,
) -> None:
    """Make or read a recording, run an estimator over it, and write its row of results.

    With -o it also writes the estimate: the revised path, if the estimator gives one. The other
    arguments are Hydra's: `group=option`, `key=value`, `-m` for a sweep over values.

    Examples
    --------
      estima run (a first look: study=first_run)

      estima run estimator=odometry world=office seed=3

      estima run robot.kr=1e-4 estimator.kr=1e-5 (truth and belief apart)

      estima run estimator=ekf_icp sensors=hokuyo -o est.tum

      estima run -m robot.kr=1e-5,1e-4 seed="range(0,5)"

      estima run -m estimator=odometry,ekf_icp sensors=hokuyo seed="range(1000,1100)" until=decided

      estima run --config-dir mine estimator=mine (your own estimator)

      estima run --cfg job (print the configuration; estima options lists the groups)
    """
    arguments = [*(overrides or []), *context.args]
    many = {"-m", "--multirun"} & set(arguments)
    if against:
        require(many, f"--against {against[0]}: goes with -m and until=decided")
        arguments.append(f"against={','.join(against)}")
    if out is not None:
        from experiments.trajectories.convert import check_estimate_name

        require(not many, f"-o {out}: one file holds one run; leave out -m")
        check_estimate_name(out)
    if many:
        from experiments.cli.sweep import sweep_arguments

        sweep_arguments([a for a in arguments if a not in many])
        return
    if not arguments:
        arguments = ["study=first_run"]
        print("estima run study=first_run (estima options lists what else there is)")
    from experiments.cli.arguments import run_arguments

    run_arguments(arguments, _draw, out)


def _draw(*run: Any) -> None:
    """Write a run's picture; Matplotlib, which takes a second to import, is needed for it alone."""
    from experiments.viewing.run_figure import draw_run

    draw_run(*run)


def record(
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write, .npz.")],
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
) -> None:
    """Simulate a recording and save it.

    Example: estima record -o office.npz world=office sensors=lms291 seed=3
    """
    from experiments.runs.compose import searched
    from experiments.runs.experiment import Experiment
    from experiments.runs.run import record as record_to

    experiment = Experiment.compose([*searched(config_dir), *(overrides or [])])
    if not record_to(experiment, out):
        raise typer.Exit(1)


def tune(
    study: Annotated[
        str,
        typer.Argument(
            help="A study of conf/study that has a tune.", autocompletion=completion.studies
        ),
    ],
    only: Annotated[list[str] | None, typer.Option(help="Only this estimator; repeat it.")] = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", help="Processes.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder of the YAMLs (default: results/tuned/estimator)."),
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """Tune a study's estimators on seeds below 100, with one budget, and judge them on its own.

    The trials are kept, so that the command goes on where it was interrupted. It writes
    ESTIMATOR_tuned.yaml, tables of trials and gains, and their figure.

    Examples
    --------
      estima tune peers --jobs 2

      estima run --config-dir results/tuned estimator=ekf_icp_tuned sensors=hokuyo
    """
    from experiments.sweeps.tune import tune_study

    show(tune_study(study, only or (), jobs, str(config_dir) if config_dir else None, out))
