"""The one runner: an experiment's rows."""

import dataclasses
import functools
import math
import os
from collections.abc import Callable, Collection, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from estimators.base import (
    Answer,
    Estimate,
    Estimator,
    Prior,
    explain_unsound,
    run,
    run_and_finish,
    since_start,
)
from estimators.team import run_team
from experiments.evaluation.map_quality import closure_errors, landmark_errors
from experiments.evaluation.metrics import (
    LONGEST_GAP_S,
    SCORED_EXTRAS,
    describe_pause,
    score,
    unused_share,
)
from experiments.evaluation.recording_bound import bound_scores, bound_team
from experiments.runs.columns import OF_THE_RUN, REVISED, Average, average_of
from experiments.runs.experiment import Experiment
from experiments.runs.objects import Objects
from experiments.runs.processes import is_interrupt
from experiments.runs.row import GAP, Outcome, Row, Status
from experiments.runs.schema import is_ours
from experiments.runs.seeds import stream
from sim.arrays import Array
from sim.errors import InputError, require, required
from sim.recording import Recording
from sim.sensors import RobotCamera
from sim.team import Team

_ADDED = ("stamps_scored", "stamps_left_out", "step_time_us")  # over the robots
_STREAMS = 100  # of a run's filters
WARNED_SHARE = 0.1  # of scans or sightings that were not used

Streams = Callable[[int], np.random.Generator]
Planted = Callable[[Estimator, int], AbstractContextManager[object]]
Shown = Callable[[Team], AbstractContextManager[Callable[[int], None]]]
OnStep = Callable[[int], None] | None


def evaluate(
    experiment: Experiment,
    fetch: Callable[[], Team] | None = None,
    *,
    streams: Streams | None = None,
    planted: Planted | None = None,
    shown: Shown | None = None,
    on_estimate: Callable[[Recording, int, Estimate, Estimate | None], None] = lambda *_: None,
    on_error: Callable[[BaseException], None] = lambda _: None,
) -> list[Row]:
    """Run an experiment's estimator `repeats` times over its recordings, and score each run.

    Parameters
    ----------
    fetch
        Gives the recordings, once the configuration is known to fit together; by default the
        experiment's own.
    streams
        The estimator's generator of each repeat, or a team's (see `answers_of_team`); by default
        that of the axis `estimator/NAME`.
    planted
        Gives a context in which the estimator is faulty, for each repeat; of one robot alone.
    shown
        Shows the progress over the recordings: gives a function of the number of Frames done, as a
        context around each repeat.
    on_estimate
        Called for each robot, with its recording, the repeat, its online estimate and the revised
        one (or None).
    on_error
        Called with the exception that ended a run, which becomes its row's status.

    Returns
    -------
    list of Row
        One a repeat: origin, status, and the scores; those of a revised path begin with
        `revised_`.

    Raises
    ------
    InputError
        If the configuration or the recording does not fit together.
    """
    experiment.check()
    read = fetch() if fetch else experiment.recordings()
    answers_of = runner(experiment, read, streams)
    require(planted is None or experiment.team is None, "faults are planted in one robot's runs")
    labels = experiment.labels(read.checksum)
    rows = []
    for repeat in range(experiment.repeats):
        estimator = experiment.estimator()
        scores: Row = {}
        try:
            with (
                planted(estimator, repeat) if planted else nullcontext(),
                shown(read) if shown else nullcontext() as on_step,
            ):
                answers = answers_of(estimator, repeat, on_step)
            paired = [(r, *answer) for r, answer in zip(read.robots, answers, strict=True)]
            statuses = [status_of(*each) for each in paired]
            every = [score_run(*each, **experiment.config["scoring"]) for each in paired]
            of_all = _bounds(experiment, read, [revised is not None for *_, revised in paired])
            every = [own | bound for own, bound in zip(every, of_all, strict=True)]
            status, scores = statuses[0], every[0]
            if experiment.team is not None:
                status, scores = status_of_team(statuses), scores_of_team(read, every)
        except InputError:
            raise
        except BaseException as error:
            if is_interrupt(error):
                raise
            status = Status.of_error(error)
            on_error(error)
        else:
            for recording, online, revised in paired:
                on_estimate(recording, repeat, online, revised)
        rows.append({**labels, "repeat": repeat, **status.columns(), **scores})
    return rows


def _bounds(experiment: Experiment, read: Team, revised: Sequence[bool]) -> list[Row]:
    """Columns of the bound, of each robot."""
    settings, names = experiment.config["estimator"], list(read.robots[0].sensors)
    if is_ours(settings) and "programs" not in settings["_target_"]:  # others may read all
        names = [name for name in names if name in settings.values()]
    with limit_blas():
        bounds = bound_team(read, experiment.priors(read), names)
    if bounds is None:
        return [{} for _ in revised]
    rows = list[Row]()
    for robot, bound, is_revised in zip(read.robots, bounds, revised, strict=True):
        counted = robot.frame_stamps >= (
            robot.frame_stamps[0] + experiment.config["scoring"]["after_s"]
        )
        last = bound_scores(bound.revised[counted]) if is_revised else {}
        of_path = {f"{REVISED}{name}": value for name, value in last.items()}
        rows.append({**bound_scores(bound.online[counted]), **of_path})
    return rows


def runner(
    experiment: Experiment, read: Team, streams: Streams | None = None
) -> Callable[[Estimator, int, OnStep], list[Answer]]:
    """Function that runs an estimator over recordings: of it, the repeat, and the progress.

    Raises
    ------
    InputError
        If there are more or fewer recordings than robots in the experiment, or they lack what is
        known at the start.
    """
    experiment.check_size(read)
    priors = experiment.priors(read)
    axis = f"estimator/{experiment.estimator_name}"
    own = streams or functools.partial(stream, experiment.seed, axis)

    def answers(estimator: Estimator, repeat: int, on_step: OnStep) -> list[Answer]:
        if experiment.team is None:
            keep = (*SCORED_EXTRAS, *experiment.config["keep"])
            return [run_over(read.only, estimator, priors[0], own(repeat), keep, on_step)]
        with limit_blas():
            return answers_of_team(experiment, read, priors, repeat, own, on_step)

    return answers


def run_robots(
    experiment: Experiment, read: Team, repeat: int = 0, on_step: OnStep = None
) -> list[Answer]:
    """Online and revised estimate of each robot, of one repeat, as `evaluate` makes them."""
    return runner(experiment, read)(experiment.estimator(), repeat, on_step)


def run_over(
    recording: Recording,
    estimator: Estimator,
    prior: Prior,
    rng: np.random.Generator,
    keep: Collection[str] = (),
    on_step: OnStep = None,
) -> Answer:
    """Online estimate of a run, and the revised one of an estimator that has `finish`.

    The online estimate has the processor time of all, `finish` included, but for compiling code
    and reading compiled code.

    BLAS uses one thread, or as many as ESTIMA_BLAS_THREADS says: its threads spin while they wait,
    and the matrices of filters are small.
    """
    n_frames = len(recording.frame_stamps)
    with limit_blas():
        return run_and_finish(
            estimator,
            lambda: run(estimator, recording, prior, rng, keep, on_step),
            None if on_step is None else lambda: on_step(n_frames),
        )


def limit_blas() -> AbstractContextManager[object]:
    """Context in which BLAS uses one thread, or as many as ESTIMA_BLAS_THREADS says.

    The variables of BLAS itself do not count: the workers of a sweep find them set by joblib.
    """
    asked = os.environ.get("ESTIMA_BLAS_THREADS") or "1"
    require(
        asked.isdecimal() and int(asked) >= 1,
        f"ESTIMA_BLAS_THREADS must be a whole number, at least 1, got {asked!r}",
    )
    limit: AbstractContextManager[object] = _blas().limit(limits=int(asked), user_api="blas")
    return limit


@functools.cache
def _blas() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401 its BLAS is found once it is loaded

    return ThreadpoolController()


def score_run(
    recording: Recording,
    online: Estimate,
    revised: Estimate | None,
    longest_gap_s: float = LONGEST_GAP_S,
    after_s: float = 0.0,
) -> Row:
    """Scores of a run as columns; those of the revised path begin with `revised_`."""
    made = online.map if revised is None else revised.map
    scores: Row = {
        **score(recording, online, longest_gap_s, after_s),
        **landmark_errors(recording, made),
        **closure_errors(recording, made, longest_gap_s),
    }
    own = score(recording, revised, longest_gap_s, after_s) if revised is not None else {}
    return scores | {f"{REVISED}{k}": v for k, v in own.items() if k not in OF_THE_RUN}


def status_of(recording: Recording, online: Estimate, revised: Estimate | None = None) -> Status:
    """How a run ended that no exception did."""
    if recording.status != "ok":
        return Status(Outcome.FAILED, "recording", recording.status)
    sound = np.isfinite(online.means).all(axis=1)
    sound &= np.isfinite(online.covariances).all(axis=(1, 2))
    if online.status == "ok" and not sound.any():
        return Status(Outcome.FAILED, "not_finite", "no pose at any time: it was never placed")
    if online.status == "ok" and not sound.all():
        step = int(np.argmin(sound))
        detail = f"not finite at {since_start(online.stamps, step)}, step {step}"
        return Status(Outcome.FAILED, "not_finite", detail)
    paths = [path for path in (online, revised) if path is not None]
    for path in paths:
        if why := explain_unsound(path):
            return Status(Outcome.FAILED, "unsound", f"{path.kind}: {why}")
    pause = next(filter(None, (describe_pause(recording, path.stamps) for path in paths)), "")
    if online.status == "ok":
        return Status(Outcome.REMARK, GAP, pause) if pause else Status()
    unused = unused_share(online) or 0.0
    said = f"{100.0 * unused:.0f} % of scans or sightings not used" if unused > WARNED_SHARE else ""
    detail = "; ".join(filter(None, [pause, online.status, said]))
    return Status(Outcome.REMARK, GAP if pause else "estimator", detail)


# The robots of a team


def answers_of_team(
    experiment: Objects,
    team: Team,
    priors: Sequence[Prior],
    repeat: int,
    streams: Callable[[int], np.random.Generator],
    on_step: Callable[[int], None] | None = None,
) -> list[Answer]:
    """Online and revised estimate of each robot.

    A robot whose start is not known has no estimate until it is placed. The estimates share the
    processor time of the run.

    Parameters
    ----------
    repeat
        Which of the runs over the same team.
    streams
        Generators of the filters by number.
    on_step
        Called with the number of Frames done.
    """
    settings = required(experiment.team, "team must hold keys; choose study=teams")
    range_m = settings.communication.range_m
    answers = run_team(
        experiment.team_estimator,
        team,
        priors,
        lambda robot: streams(_STREAMS * repeat + robot),
        settings.communication,
        None if range_m is None else in_range(team, range_m),
        on_step,
    )
    if settings.starts == "known":
        return answers
    others = [(_placed(online), revised and _placed(revised)) for online, revised in answers[1:]]
    return [answers[0], *others]


def status_of_team(statuses: Sequence[Status]) -> Status:
    """The worst of the robots' statuses, which says whose it is."""
    rank = [list(Outcome).index(status.outcome) for status in statuses]
    number = int(np.argmax(rank))
    worst = statuses[number]
    detail = f"robot {number}: {worst.detail}" if worst.detail else ""
    return dataclasses.replace(worst, detail=detail)


def scores_of_team(team: Team, scores: Sequence[Row]) -> Row:
    """Scores of a team: those of its robots, combined.

    Errors are pooled by their squares over all stamps that count. Counts and times of a step add
    up; all else is averaged over the stamps. `worst_robot_rmse_m` comes from the best answers.
    """
    row: Row = {}
    for name in dict.fromkeys(name for own in scores for name in own):
        given = [own for own in scores if name in own]
        values = np.array([own[name] for own in given], np.float64)
        weights = np.array([own.get("stamps_scored", 1.0) for own in given], np.float64)
        if name in _ADDED or name.removeprefix(REVISED) in _ADDED:
            row[name] = float(values.sum())
        elif average_of(name) is Average.ERROR:
            row[name] = math.sqrt(np.average(values**2, weights=weights))
        else:
            row[name] = float(np.average(values, weights=weights))
    error = "ate_rmse_m"
    worst = [own.get(f"{REVISED}{error}", own.get(error)) for own in scores]
    known = [float(value) for value in worst if isinstance(value, float)]
    if known:
        row["worst_robot_rmse_m"] = float(np.max(known))
    row["n_sightings"] = sum(
        len(log["points_in_camera"])
        for robot in team.robots
        for name, log in robot.logs.items()
        if isinstance(robot.sensors[name], RobotCamera)
    )
    return row


def in_range(team: Team, range_m: float) -> NDArray[np.bool_]:
    """Which robots are within a distance of each other, (T, R, R) at each instant, by the truth."""
    stamps = np.unique(np.concatenate([recording.frame_stamps for recording in team.robots]))
    at: Array = np.stack([_where(recording, stamps) for recording in team.robots], axis=1)
    apart = at[:, :, None] - at[:, None]
    return np.asarray(np.hypot(apart[..., 0], apart[..., 1]) <= range_m)


def _where(recording: Any, stamps: Array) -> Array:
    """True positions (T, 2); before and after its recording a robot stands where it was."""
    truth = recording.known_truth.stamps
    return np.asarray(recording.truth_at(np.clip(stamps, truth[0], truth[-1]))[:, :2])


def _placed(estimate: Estimate) -> Estimate:
    """The estimate from its first pose on; as it is, if there is none."""
    known = np.isfinite(estimate.means).all(axis=1)
    kept = slice(int(np.argmax(known)), None)
    return dataclasses.replace(
        estimate,
        stamps=estimate.stamps[kept],
        means=estimate.means[kept],
        covariances=estimate.covariances[kept],
        step_seconds=estimate.step_seconds[kept],
    )
