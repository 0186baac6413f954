"""The one runner: an experiment's rows."""

import functools
import os
from collections.abc import Callable, Collection
from contextlib import AbstractContextManager, nullcontext

import numpy as np
from threadpoolctl import ThreadpoolController

from estimators.base import Answer, Estimate, Estimator, Prior, run_and_finish
from experiments.evaluation.map_quality import landmark_errors
from experiments.evaluation.metrics import (
    LONGEST_GAP_S,
    SCORED_EXTRAS,
    longest_pause_s,
    score,
)
from experiments.runs.columns import OF_THE_RUN, REVISED
from experiments.runs.experiment import Experiment
from experiments.runs.row import GAP, Outcome, Row, Status
from experiments.runs.seeds import stream
from experiments.runs.team import answers_of_team, scores_of_team, status_of_team
from sim.arrays import Array
from sim.errors import InputError, require
from sim.recording import Recording
from sim.team import Team

REMARKED_PAUSE_S = 1.0  # without a pose

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
    on_error: Callable[[Exception | SystemExit], None] = lambda _: None,
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
            status, scores = statuses[0], every[0]
            if experiment.team is not None:
                status, scores = status_of_team(statuses), scores_of_team(read, every)
        except InputError:
            raise
        except (Exception, SystemExit) as error:
            status = Status.of_error(error)
            on_error(error)
        else:
            for recording, online, revised in paired:
                on_estimate(recording, repeat, online, revised)
        rows.append({**labels, "repeat": repeat, **status.columns(), **scores})
    return rows


def runner(
    experiment: Experiment, read: Team, streams: Streams | None = None
) -> Callable[[Estimator, int, OnStep], list[Answer]]:
    """Function that runs an estimator over recordings: of it, the repeat, and the progress.

    Raises
    ------
    InputError
        If the recordings are of more or fewer robots than the experiment, or lack what is known at
        the start.
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
    with limit_blas():
        return run_and_finish(estimator, recording, prior, rng, keep, on_step)


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
        when = online.stamps[np.argmin(sound)]
        return Status(Outcome.FAILED, "not_finite", f"not finite at {when:.2f} s")
    pauses = [
        status_of_pauses(recording, path.stamps) for path in (online, revised) if path is not None
    ]
    worst = max(pauses, key=lambda status: status.code)
    if online.status == "ok":
        return worst
    detail = "; ".join(filter(None, [worst.detail, online.status]))
    return Status(Outcome.REMARK, worst.code or "estimator", detail)


def status_of_pauses(recording: Recording, stamps: Array) -> Status:
    """Remark on a path that leaves out much: whoever chooses its poses chooses what is scored.

    It counts what can be scored: the time between the first and the last Frame with a truth.
    """
    frames = recording.frame_stamps
    start, end, own_s = frames[0], frames[-1], float(np.diff(frames).max(initial=0.0))
    if recording.truth is not None:
        known = recording.truth.stamps
        start, end = max(start, known[0]), min(end, known[-1])
        own_s = max(own_s, float(np.diff(known).max(initial=0.0)))
    pause_s = longest_pause_s(stamps, start, end)
    if pause_s <= max(REMARKED_PAUSE_S, own_s):
        return Status()
    return Status(Outcome.REMARK, GAP, f"no pose for {pause_s:.3g} s of the recording")
