"""Estimates to draw, or to build a map along: from a file, or by an estimator that runs now."""

import dataclasses
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from estimators.base import Belief, Estimate, Estimator
from estimators.team import run_team
from experiments.runs.evaluate import run_over, run_robots
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from experiments.trajectories.odometry import read_odometry_csv
from experiments.trajectories.read import SUFFIXES as TRAJECTORIES
from experiments.trajectories.read import read_trajectory
from experiments.viewing.playback import Playback
from sim.errors import require, required
from sim.recording import Frame, Recording
from sim.team import Team

OnStep = Callable[[int], None]  # of the number of Frames done
_EXTRAS = ("particles", "landmarks", "landmark_covariances")


def with_all_estimates(
    shown: Playback, sources: Sequence[str], overrides: Sequence[str], on_step: OnStep
) -> Playback:
    """Show the estimates of one source, and over them those of others: `with_estimates`."""
    n_frames = sum(len(own.recording.frame_stamps) for own in shown.robots)
    first, *others = [
        with_estimates(shown, source, overrides, partial(_step_on, on_step, k * n_frames))
        for k, source in enumerate(sources)
    ]
    names = [Path(source).name for source in sources]
    tracks = [required(each.robots[0].estimate, "estimate") for each in others]
    own = dataclasses.replace(first.robots[0], others=tuple(zip(names[1:], tracks, strict=True)))
    return dataclasses.replace(first, robots=(own,), name=names[0]) if others else first


def _step_on(on_step: OnStep, before: int, n: int) -> None:
    on_step(before + n)


def with_estimates(
    shown: Playback, source: str, overrides: Sequence[str], on_step: OnStep
) -> Playback:
    """Show estimates that are read, or made now.

    Parameters
    ----------
    source
        A trajectory's file, the folder of a run, or the name of an estimator to run. The starts of
        a team's robots are known to it, and they always talk.
    overrides
        Hydra overrides for that estimator.
    """
    team, path = Team(tuple(own.recording for own in shown.robots)), Path(source)
    if _is_file(path, overrides):
        return shown.with_estimates(_read_all(team, path), "estimate")
    experiment = experiment_over(team.robots[0], source, overrides)
    if len(team) == 1:
        return shown.with_estimates([_sparing(experiment, shown, on_step)], source)
    found = run_team(
        experiment.team_estimator,
        team,
        [experiment.prior(robot, number) for number, robot in enumerate(team.robots)],
        lambda robot: stream(experiment.seed, f"estimator/{source}", robot),
        on_step=on_step,
    )
    return shown.with_estimates([revised or online for online, revised in found], source)


def with_estimates_by(
    shown: Playback, experiment: Experiment, repeat: int, on_step: OnStep
) -> Playback:
    """Show the online estimates of one of an experiment's repeats."""
    if experiment.team is None:
        found = [_sparing(experiment, shown, on_step, repeat)]
    else:
        team = Team(tuple(own.recording for own in shown.robots))
        found = [online for online, _ in run_robots(experiment, team, repeat, on_step)]
    return shown.with_estimates(found, experiment.estimator_name)


def _sparing(experiment: Experiment, shown: Playback, on_step: OnStep, repeat: int = 0) -> Estimate:
    """Online estimate of a robot alone, with what is drawn at the shown Frames."""
    if hasattr(experiment.estimator(), "keep_map"):
        experiment = experiment.with_estimator(keep_map=True)
    recording = shown.robots[0].recording
    sparing = _Sparing(experiment.estimator(), set(shown.rows.tolist()))
    rng = stream(experiment.seed, f"estimator/{experiment.estimator_name}", repeat)
    return run_over(recording, sparing, experiment.prior(recording), rng, _EXTRAS, on_step)[0]


def estimate_along(
    recording: Recording, source: str, overrides: Sequence[str], on_step: OnStep
) -> Estimate:
    """Read a trajectory, or the best one of an estimator: its revised path if it has one."""
    if _is_file(path := Path(source), overrides):
        return read_estimate(recording, path)
    experiment = experiment_over(recording, source, overrides)
    rng = stream(experiment.seed, f"estimator/{source}", 0)
    prior = experiment.prior(recording)
    online, revised = run_over(recording, experiment.estimator(), prior, rng, on_step=on_step)
    return revised or online


def check_no_overrides(overrides: Sequence[str]) -> None:
    """Refuse overrides where no estimator runs."""
    require(not overrides, f"{[*overrides, ''][0]}: overrides are for estimators that run now")


def _is_file(path: Path, overrides: Sequence[str]) -> bool:
    """Whether a word is a trajectory's file or a run's folder, which takes no overrides."""
    of_run = path.is_dir() and (len(path.parts) > 1 or any(path.glob("estimate*.csv")))
    is_file = path.suffix in TRAJECTORIES or of_run
    check_no_overrides(overrides if is_file else ())
    return is_file


def _read_all(team: Team, path: Path) -> list[Estimate]:
    """Read the estimate of a robot alone, or those of a team from the folder of its run."""
    if len(team) == 1:
        return [read_estimate(team.robots[0], path)]
    require(path.is_dir(), f"{path}: an estimate of one robot; name the folder of a team's run")
    files = (path / f"estimate_{number}.csv" for number in range(len(team)))
    return [read_estimate(robot, file) for robot, file in zip(team.robots, files, strict=True)]


def read_estimate(recording: Recording, path: Path) -> Estimate:
    """Read a recording's estimate from a file, or from the folder of a run.

    Raises
    ------
    InputError
        If it cannot be read, is not finite, or belongs to another recording.
    """
    if path.is_dir():
        require(
            not (path / "estimate_0.csv").exists(),
            f"{path}: a team's run; its estimates are {path}/estimate_0.csv and so on",
        )
        path /= "estimate.csv"
    stamps = recording.frame_stamps
    estimate = read_odometry_csv(path) if path.suffix == ".csv" else read_trajectory(path)
    require(
        ((estimate.stamps >= stamps[0]) & (estimate.stamps <= stamps[-1])).any(),
        f"{path}: no stamp of it lies within the recording; is it another's?",
    )
    sound = np.isfinite(estimate.means).all(axis=1)
    require(sound.all(), f"{path}:{2 + int(np.argmin(sound))}: a pose that is not finite")
    return estimate


def experiment_over(recording: Recording, estimator: str, overrides: Sequence[str]) -> Experiment:
    """Experiment of an estimator's option over a recording, with the recording's own robot."""
    robot = dataclasses.asdict(recording.robot)  # and its slip, if that is known
    made_with = recording.config.get("robot")
    if isinstance(made_with, dict):  # else, of a log of many robots, the number of one
        robot |= {
            key: value
            for key, value in made_with.items()
            if key in ("kr", "kl") and isinstance(value, (int, float))
        }
    given = [f"robot.{key}={value}" for key, value in robot.items()]
    return Experiment.compose([f"estimator={estimator}", *given, *overrides])


class _Sparing:
    """An estimator whose extras are kept at the shown Frames only, to save memory."""

    def __init__(self, estimator: Estimator, shown: Collection[int]) -> None:
        self._estimator, self._shown, self._row = estimator, shown, -1

    def reset(self, prior: Any, rng: np.random.Generator) -> None:
        self._row = -1
        self._estimator.reset(prior, rng)

    def step(self, frame: Frame) -> Belief:
        belief = self._estimator.step(frame)
        self._row += 1
        kept = _EXTRAS if self._row in self._shown else ()
        copied = {k: np.array(v) for k, v in belief.extras.items() if k in kept}
        return Belief(belief.mean, belief.covariance, copied)
