"""The one runner: an experiment's rows."""

import functools
import os
from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, nullcontext

import numpy as np
from threadpoolctl import ThreadpoolController

from estimators.base import Estimate, Estimator, Prior, run_to_the_end
from experiments.evaluation.map_quality import landmark_errors
from experiments.evaluation.metrics import (
    LONGEST_GAP_S,
    SCORED_EXTRAS,
    longest_pause_s,
    score,
)
from experiments.runs.columns import OF_THE_RUN
from experiments.runs.experiment import Experiment
from experiments.runs.row import GAP, Outcome, Row, Status
from experiments.runs.seeds import stream
from experiments.runs.team import (
    TeamExperiment,
    recorded,
    robots_of,
    scores_of_team,
    status_of_team,
)
from sim.arrays import Array
from sim.errors import InputError, require
from sim.recording import Recording
from sim.team import Team

REMARKED_PAUSE_S = 1.0  # without a pose

Streams = Callable[[int], np.random.Generator]
Planted = Callable[[Estimator, int], AbstractContextManager[object]]
Shown = Callable[[Recording | Team], AbstractContextManager[Callable[[int], None]]]
OnStep = Callable[[int], None] | None
Answers = list[tuple[Estimate, Estimate | None]]  # of each robot: online and revised


def evaluate(
    experiment: Experiment,
    fetch: Callable[[], Recording | Team] | None = None,
    *,
    streams: Streams | None = None,
    planted: Planted | None = None,
    shown: Shown | None = None,
    on_estimate: Callable[[Recording, int, Estimate, Estimate | None], None] = lambda *_: None,
    on_error: Callable[[Exception | SystemExit], None] = lambda _: None,
) -> list[Row]:
    """Run an experiment's estimator `repeats` times over its recording, and score each run.

    Parameters
    ----------
    fetch
        Gives the recording, or those of a team, once the configuration is known to fit together; by
        default the experiment's own.
    streams
        The estimator's generator of each repeat, or a team's (see `TeamExperiment.run`); by default
        that of the axis `estimator/NAME`.
    planted
        Gives a context in which the estimator is faulty, for each repeat; not of a team.
    shown
        Shows the progress over a recording: gives a function of the number of Frames done, as a
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
    read = fetch() if fetch else recorded(experiment)
    answers_of = _runner(experiment, read, streams)
    require(planted is None or not isinstance(read, Team), "faults are planted in one robot's runs")
    robots = robots_of(read)
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
            status, scores = _scored_run(read, answers, experiment.scoring)
        except InputError:
            raise
        except (Exception, SystemExit) as error:
            status = Status.of_error(error)
            on_error(error)
        else:
            for recording, answer in zip(robots, answers, strict=True):
                on_estimate(recording, repeat, *answer)
        rows.append({**labels, "repeat": repeat, **status.columns(), **scores})
    return rows


def _runner(
    experiment: Experiment, read: Recording | Team, streams: Streams | None
) -> Callable[[Estimator, int, OnStep], Answers]:
    """Function that runs an estimator of one robot, or of a team, over what was read."""
    require(
        isinstance(read, Team) == (experiment.team is not None),
        "team: the recording is of one robot, and the experiment of several"
        if experiment.team is not None
        else "the recording is of a team; choose study=teams",
    )
    if isinstance(read, Team):
        team, several = read, TeamExperiment(experiment)

        def run_several(
            _: Estimator, repeat: int, on_step: Callable[[int], None] | None
        ) -> Answers:
            with limited_blas():
                return several.run(team, repeat, streams, on_step)

        return run_several
    recording, prior = read, experiment.prior(read)
    own = streams or functools.partial(
        stream, experiment.seed, f"estimator/{experiment.estimator_name}"
    )
    keep = (*SCORED_EXTRAS, *experiment.keep)
    return lambda estimator, repeat, on_step: [
        estimates(estimator, recording, prior, own(repeat), keep, on_step)
    ]


def _scored_run(
    read: Recording | Team, answers: Answers, scoring: Mapping[str, float]
) -> tuple[Status, Row]:
    """How a run ended, and its scores."""
    statuses, scores = [], []
    for recording, (online, revised) in zip(robots_of(read), answers, strict=True):
        statuses.append(status_of(recording, online, revised))
        scores.append(scored(recording, online, revised, **scoring))
    if isinstance(read, Team):
        return status_of_team(statuses), scores_of_team(read, scores)
    return statuses[0], scores[0]


def estimates(
    estimator: Estimator,
    recording: Recording,
    prior: Prior,
    rng: np.random.Generator,
    keep: Collection[str] = (),
    on_step: Callable[[int], None] | None = None,
) -> tuple[Estimate, Estimate | None]:
    """Online estimate of a run, and the revised one of an estimator that has `finish`.

    The online estimate has the processor time of all, `finish` included, but for compiling code
    and reading compiled code.

    BLAS uses one thread, or as many as ESTIMA_BLAS_THREADS says: its threads spin while they wait,
    and the matrices of filters are small.
    """
    with limited_blas():
        return run_to_the_end(estimator, recording, prior, rng, keep, on_step)


def limited_blas() -> AbstractContextManager[object]:
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


def scored(
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
    if revised is not None:
        found = score(recording, revised, longest_gap_s, after_s)
        scores |= {f"revised_{k}": found[k] for k in found if k not in OF_THE_RUN}
    return scores


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
    paths = (online.stamps, *([] if revised is None else [revised.stamps]))
    found = max((status_of_pauses(recording, stamps) for stamps in paths), key=lambda s: s.code)
    if online.status == "ok":
        return found
    detail = "; ".join(filter(None, [found.detail, online.status]))
    return Status(Outcome.REMARK, found.code or "estimator", detail)


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
