"""Estima from Python: simulate, load, run, score, sweep, plot.

The overrides are those of the command line: `group=option` chooses a world, a robot, sensors, a
route or an estimator (`estima options` lists them), `key=value` sets a value.

Examples
--------
>>> import estima
>>> recording = estima.simulate("simulation.physics=kinematic", "route=linear_1", "seed=3")
>>> run = estima.run(recording, estimator="odometry")
>>> run.row["status"], len(run.online.means) == len(recording.frame_stamps)
('ok', True)
"""

from __future__ import annotations

import hashlib
import importlib
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack, overload

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from matplotlib.figure import Figure

    from estimators.base import Belief, Estimate, Estimator, Prior
    from experiments.runs.experiment import Experiment
    from experiments.runs.row import Row
    from sim.errors import InputError
    from sim.recording import Frame, Recording

__all__ = [
    "Belief",
    "Estimate",
    "Estimator",
    "Experiment",
    "Frame",
    "InputError",
    "Prior",
    "Recording",
    "Run",
    "load",
    "plot",
    "run",
    "score",
    "simulate",
    "sweep",
]
_TYPES = {
    **dict.fromkeys(("Belief", "Estimate", "Estimator", "Prior"), "estimators.base"),
    "Experiment": "experiments.runs.experiment",
    **dict.fromkeys(("Frame", "Recording"), "sim.recording"),
    "InputError": "sim.errors",
}


def __getattr__(name: str) -> Any:
    """Find a type or the version when first asked for: `import estima` alone loads no library."""
    if name == "__version__":
        from importlib.metadata import version

        return version("estima")
    if name not in _TYPES:
        raise AttributeError(f"module 'estima' has no attribute {name!r}")
    return getattr(importlib.import_module(_TYPES[name]), name)


@dataclass(frozen=True, repr=False)
class Run:
    """What an estimator made of a recording.

    Attributes
    ----------
    recording
        What it read.
    online
        Estimate whose every belief saw only its past.
    revised
        Estimate of the whole trajectory in hindsight; None of an estimator without `finish`.
    row
        Settings, status and scores of the run, as a sweep has them in a row. The scores of the
        revised estimate begin with `revised_`.
    """

    recording: Recording
    online: Estimate
    revised: Estimate | None
    row: Row

    def __repr__(self) -> str:
        row, prefix = self.row, "" if self.revised is None else "revised_"
        numbers = {name: value for name, value in row.items() if isinstance(value, float)}
        error_m, nees = numbers.get(f"{prefix}ate_rmse_m"), numbers.get(f"{prefix}nees_mean")
        step_us = numbers.get("step_time_us")
        facts = [
            f"{row['status']}, {row['status_detail']}" if row["status"] != "ok" else "",
            "" if error_m is None else f"position RMSE {error_m * 1000.0:.3g} mm",
            "" if nees is None else f"NEES {nees:.3g}",
            "" if step_us is None else f"{step_us / 1000.0:.3g} ms per step",
        ]
        world = row.get("choice.world", "a recording")
        return f"Run({row['choice.estimator']} on {world}: {', '.join(filter(None, facts))})"

    def _repr_html_(self) -> str:
        """Show the errors and the picture in a notebook."""
        import base64
        import html
        import io

        png = io.BytesIO()
        self.plot().savefig(png, format="png")
        picture = base64.b64encode(png.getvalue()).decode()
        shown = html.escape(repr(self))
        return f'<p>{shown}</p><img alt="{shown}" src="data:image/png;base64,{picture}">'

    def plot(self, path: str | Path | None = None) -> Figure:
        """Draw the trajectory, revised if there is one, and its errors against time.

        Parameters
        ----------
        path
            File to write: .png, .pdf or .svg.
        """
        from experiments.viewing.run_figure import run_figure

        estimate = self.online if self.revised is None else self.revised
        found = [(self.recording, estimate)]
        return _saved(run_figure(found, str(self.row["choice.estimator"])), path)


def simulate(*overrides: str) -> Recording:
    """Simulate a recording.

    Parameters
    ----------
    overrides
        World, robot, sensors, route and their keys, such as `world=office` and `seed=3`.

    Returns
    -------
    Recording
        Its `status` says if the robot hit something. `sim.recording.save` writes it to a file.

    Raises
    ------
    InputError
        If the overrides do not fit together.

    Examples
    --------
    >>> import estima
    >>> recording = estima.simulate("simulation.physics=kinematic", "route=linear_1")
    >>> recording.status, recording.duration_s
    ('ok', 2.7)
    """
    return _experiment(overrides).simulate()


def load(*paths: str | Path, robot: int | None = None) -> Recording:
    """Read a recording, or a log of any format that `docs/formats.md` lists.

    Parameters
    ----------
    paths
        The log; the formats of several files take them in the order that `docs/formats.md` gives.
    robot
        Which robot of an MRCLAM set, by default 1; or of a team's file, from 0 on.

    Raises
    ------
    InputError
        If a file cannot be read, or its format is unknown.

    Examples
    --------
    >>> import estima
    >>> estima.load("missing.log")
    Traceback (most recent call last):
    sim.errors.InputError: missing.log: cannot read (No such file or directory)
    """
    from sim.formats.detect import read_any

    return read_any([Path(path) for path in paths], robot)


@overload
def run(
    recording: Recording, /, *overrides: str, estimator: str | Estimator | None = None
) -> Run: ...
@overload
def run(*overrides: str, estimator: str | Estimator | None = None) -> Run: ...
def run(*given: Any, estimator: str | Estimator | None = None) -> Run:
    """Run an estimator once over a recording, and score it.

    Parameters
    ----------
    given
        A Recording, or none to simulate one (which is then cached in `results/cache`); and
        overrides, such as `prior.map=world` or `estimator.max_particles=2000`.
    estimator
        An option such as `ekf_icp`, or any object with `reset` and `step`. By default the one that
        the overrides name, else `odometry`.

    Raises
    ------
    InputError
        If the overrides do not fit together, or the recording lacks what the estimator needs.
    Exception
        Whatever the estimator raised.

    Examples
    --------
    >>> import estima
    >>> quick = ("simulation.physics=kinematic", "route=linear_1")
    >>> recording = estima.simulate(*quick)
    >>> found = estima.run(recording, "estimator.kr=1e-4", estimator="odometry")
    >>> found.row["estimator.kr"], found.row["ate_rmse_m"] < 0.05
    (0.0001, True)
    >>> estima.run(*quick, estimator="ekf_icp")
    Traceback (most recent call last):
    sim.errors.InputError: estimator=ekf_icp needs a sensor laser, and sensors=encoder has none; try sensors=hokuyo, laser_stereo, laser_stereo_lidar3d, lms291, lms291_degree, lms291_quarter, real_laser, rplidar_a1, urg04lx, utm30lx
    """  # noqa: E501 the message is one line
    from experiments.runs.evaluate import evaluate
    from sim.errors import require
    from sim.team import Team

    recording = given[0] if given and not isinstance(given[0], str) else None
    overrides = given if recording is None else given[1:]
    named = [f"estimator={estimator}"] if isinstance(estimator, str) else []
    experiment = _experiment((*named, *overrides))
    require(experiment.team is None, "team: estima.run takes one robot; estima.sweep runs teams")
    require(
        experiment.repeats == 1,
        f"estima.run makes one run; use estima.sweep for repeats={experiment.repeats}",
    )
    if not (estimator is None or isinstance(estimator, str)):
        experiment = experiment.with_estimator_object(estimator)
    if recording is not None:
        experiment = experiment.with_recording(recording)
    found: list[tuple[Recording, Estimate, Estimate | None]] = []
    rows = evaluate(
        experiment,
        None if recording is None else lambda: Team((recording,)),
        on_estimate=lambda read, _, online, revised: found.append((read, online, revised)),
        on_error=_raise,
    )
    return Run(*found[0], rows[0])


def score(recording: Recording, estimate: Estimate) -> dict[str, float]:
    """Score an estimate against its recording's truth, with the unit in each key.

    What does not apply has no key: all errors without a truth, the error over 10 m of a shorter
    run, the NEES without a usable covariance.

    Raises
    ------
    InputError
        If it is not an Estimate, or shares no time with the truth.

    Examples
    --------
    >>> import estima
    >>> recording = estima.simulate("simulation.physics=kinematic", "route=linear_1")
    >>> scores = estima.score(recording, estima.run(recording).online)
    >>> sorted(scores)[:2], scores["distance_m"] > 0.5
    (['ate_aligned_rmse_m', 'ate_mean_m'], True)
    """
    from estimators.base import Estimate
    from experiments.evaluation.metrics import score
    from sim.errors import require

    require(
        isinstance(estimate, Estimate),
        f"estima.score takes an Estimate, such as run.online, got {type(estimate).__name__}",
    )
    return score(recording, estimate)


def sweep(*overrides: str, name: str | None = None) -> pd.DataFrame:
    """Run all combinations of the swept values on all cores, and return one row a run.

    As `estima run -m` does: runs whose rows are there already are not repeated. A run that failed
    has a row that says how, and a warning is given.

    Parameters
    ----------
    overrides
        As of a run, with several values where there are commas or ranges: `robot.kr=1e-5,1e-4`,
        `seed=range(0,20)`; or `study=NAME`.
    name
        Folder below `results/runs`, all of whose rows are returned. By default one of these
        overrides' own.

    Raises
    ------
    InputError
        If the overrides do not fit together.

    Examples
    --------
    >>> import estima
    >>> table = estima.sweep(
    ...     "simulation.physics=kinematic", "route=linear_1", "robot.kr=1e-5,1e-4",
    ...     "seed=range(0,2)", "hydra/launcher=basic",
    ... )
    >>> table[["robot.kr", "seed", "status"]].values.tolist()
    [[1e-05, 0, 'ok'], [1e-05, 1, 'ok'], [0.0001, 0, 'ok'], [0.0001, 1, 'ok']]
    """
    from experiments.runs.console import RunFailedError
    from experiments.sweeps import launch
    from experiments.sweeps.collect import collect

    own = f"sweep_{hashlib.sha256(repr(overrides).encode()).hexdigest()[:8]}"
    with _checked(overrides):
        named = [line.partition("=")[2] for line in overrides if line.startswith("name=")]
        folder = name or (named or [own])[-1]
        try:
            launch.sweep([*overrides, f"name={folder}"])
        except RunFailedError as error:
            warnings.warn(str(error), stacklevel=2)
    return collect(folder)


class Layout(TypedDict, total=False):
    """How `plot` lays out its panels.

    Attributes
    ----------
    row, col
        One row, one column of panels for each value of this column.
    size
        `screen` (the default), or `column` or `page` of a paper.
    pool
        Average over other settings that differ too, rather than refuse it.
    """

    row: str
    col: str
    size: str
    pool: bool


def plot(
    table: pd.DataFrame,
    x: str,
    y: str = "answer_ate_rmse_m",
    by: str | Sequence[str] | None = None,
    path: str | Path | None = None,
    **layout: Unpack[Layout],
) -> Figure:
    """Draw a column of a sweep against another one: means over recordings, with 95 % intervals.

    Parameters
    ----------
    table
        What `sweep` returned; runs that failed are left out.
    x, y
        A swept setting, such as `robot.kr` or `choice.estimator`, and a score.
    by
        One line for each value of this column, or for each combination of several.
    path
        File to write: .png, .pdf or .svg.
    layout
        `row`, `col`, `size` and `pool`, see `Layout`.

    Raises
    ------
    InputError
        If the column is missing, it holds no numbers to average, or the table is not a sweep's.

    Examples
    --------
    >>> import estima
    >>> quick = ("simulation.physics=kinematic", "route=linear_1", "hydra/launcher=basic")
    >>> table = estima.sweep(*quick, "robot.kr=1e-5,1e-4", "seed=range(0,2)")
    >>> estima.plot(table, x="robot.kr", y="ate_rmse_m").axes[0].get_xlabel()
    'true kr, m'
    """
    from experiments.report.plot import sweep_figure
    from experiments.runs.row import Outcome
    from sim.errors import require

    for column in ("status", "recording_checksum"):
        require(
            column in table,
            f"the table has no column {column}; estima.plot takes what estima.sweep returned",
        )
    rows = table[table["status"] != Outcome.FAILED]
    figure = sweep_figure(rows, x, y, by, **layout)
    return _saved(figure, path)


def _experiment(overrides: tuple[str, ...]) -> Experiment:
    from experiments.runs.experiment import Experiment

    with _checked(overrides):
        return Experiment.compose(overrides)


@contextmanager
def _checked(overrides: tuple[str, ...]) -> Iterator[None]:
    """What is wrong with overrides becomes the InputError that is documented."""
    from experiments.runs.console import as_input_error
    from sim.errors import require

    for each in overrides:
        require(
            isinstance(each, str),
            f"an override is a text such as 'seed=1', got a {type(each).__name__}; give those of a "
            "list one by one: *overrides",
        )
    try:
        yield
    except Exception as error:
        if (refused := as_input_error(error)) is None:
            raise
        raise refused from error


def _raise(error: BaseException) -> None:
    raise error


def _saved(page: Figure, path: str | Path | None) -> Figure:
    from experiments.viewing.style import save_figure

    if path is not None:
        save_figure(page, Path(path))
    return page
