"""Tuning: each estimator of a study gets the same number of trials on the same recordings.

A trial is a choice of values; its error on a recording is that of the method's best answer, and its
value the mean log error. A trial that is worse than the best one so far in a signed-rank test over
the recordings that both saw is given up (Optuna's WilcoxonPruner). The first trial is the default.
The winner and the default are then judged on the study's own seeds, which it was not tuned on.

Akiba et al., Optuna: a next-generation hyperparameter optimization framework, KDD 2019.
"""

from __future__ import annotations

import hashlib
import json
import math
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from joblib import Parallel, delayed
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from omegaconf import OmegaConf

from experiments.evaluation.statistics import Interval, log_ratio_interval
from experiments.runs import paths
from experiments.runs.columns import REVISED
from experiments.runs.compose import compose_options, find_option, searched
from experiments.runs.console import pluralize, progress
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.processes import hold_interrupts
from experiments.runs.row import Outcome, Row, read_rows, write_frame
from experiments.sweeps.plan import plan_experiments
from experiments.sweeps.ranges import FIRST_JUDGED_SEED, Range, Tuning
from experiments.viewing.plotting import name_ends, plain_log
from experiments.viewing.style import SERIES, save_figure, subplots
from sim.errors import InputError, how_to_install, require
from sim.files import write_text
from sim.options import build

FAILED_M = 100.0  # what a run that failed counts as
_ERROR = "ate_rmse_m"
_PRUNED_BELOW = 0.1  # p of the signed-rank test


@dataclass(frozen=True)
class TuningResult:
    """What came of tuning one estimator.

    Attributes
    ----------
    estimator
        Its option.
    values
        The winner's options that differ from the default.
    trials
        A row a trial: `trial` from 1, `state`, `seconds`, `mean_log_error` (NaN if pruned),
        `options` as JSON, `best_so_far_m`.
    gain
        Error of the winner over that of the default on the judged recordings, geometric mean.
    default_m, tuned_m
        Geometric means of the errors there.
    n_judged
        Judged recordings.
    """

    estimator: str
    values: Mapping[str, Any]
    trials: pd.DataFrame
    gain: Interval
    default_m: float
    tuned_m: float
    n_judged: int


def tuning_of(study: str, config_dir: str | None = None) -> Tuning:
    """The `tune` of a study's YAML."""
    cfg = compose_options([*searched(config_dir), f"study={study}"])
    settings: Any = OmegaConf.to_container(cfg)
    require(
        settings.get("tune") is not None,
        f"study={study}: its YAML has no `tune`, which names seeds and ranges, as study=peers has",
    )
    return build(Tuning, settings["tune"], f"study={study}: tune")


def tune(
    study: str,
    only: Collection[str] = (),
    *,
    jobs: int = 1,
    config_dir: str | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Iterator[TuningResult]:
    """Tune the estimators of a study, and judge each.

    Trials are kept in `results/tune/STUDY/ESTIMATOR.journal`: a run that was interrupted goes on
    after the last one. Other ranges, seeds, settings or code begin again.

    Parameters
    ----------
    only
        Estimators; all that the study's `tune` names if empty.
    jobs
        Processes. With one, and from the first trial, the same trials come again.
    on_progress
        Called with the share of the estimators done.

    Raises
    ------
    InputError
        If the study has no `tune`, or Optuna or a method's package is not installed.
    """
    require(jobs >= 1, f"the number of jobs must be at least 1, got {jobs}")
    _optuna()
    tuning = tuning_of(study, config_dir)
    names = list(only) or list(tuning.estimators)
    for name in names:
        known = ", ".join(tuning.estimators)
        require(name in tuning.estimators, f"study={study} does not tune {name}; it has {known}")
    problems = [_problem(study, name, tuning, config_dir) for name in names]  # wrong keys end here
    for done, problem in enumerate(problems, start=1):
        yield _tuned(problem, paths.results() / "tune" / study / f"{problem.name}.journal", jobs)
        on_progress(done / len(names))


def tune_study(
    study: str,
    only: Collection[str] = (),
    jobs: int = 1,
    config_dir: str | None = None,
    folder: Path | None = None,
) -> str:
    """Tune, write options, tables and their figure; return the gains and the options' files.

    Parameters
    ----------
    folder
        Where the options go; by default results/tuned/estimator.
    """
    tuning, place = tuning_of(study, config_dir), paths.results()
    results, written = [], []
    with progress(f"tune {study}", 1.0) as on_progress:
        for tuned in tune(study, only, jobs=jobs, config_dir=config_dir, on_progress=on_progress):
            results.append(tuned)
            written.append(write(tuned, study, tuning, folder or place / "tuned" / "estimator"))
    stem, order = str(place / "tables" / study), list(tuning.estimators)
    trials = merge_into(Path(f"{stem}_trials_tuning.csv"), trials_table(results), order)
    gains = merge_into(Path(f"{stem}_tuning.csv"), gains_table(results), order)
    save_figure(curves(trials, gains), place / "figures" / f"{study}_tuning.png")
    return "\n".join([*map(_said, results), *map(paths.short, written)])


def _said(tuned: TuningResult) -> str:
    """The gain of one estimator, in a line."""
    gain, n = tuned.gain, pluralize(tuned.n_judged, "recording")
    interval = f" [{gain.low:.3g}, {gain.high:.3g}]" if math.isfinite(gain.low) else ""
    errors = f"{tuned.default_m:.3g} m by default, {tuned.tuned_m:.3g} m tuned"
    line = f"{tuned.estimator}: {gain.value:.3g}{interval} times the default's error"
    return f"{line} on {n} that it was not tuned on ({errors})"


def write(tuned: TuningResult, study: str, tuning: Tuning, folder: Path) -> Path:
    """Write the default with the winner's values, `ESTIMATOR_tuned.yaml`; return its path."""
    option = find_option("estimator", tuned.estimator)
    path = folder / f"{option}_tuned.yaml"
    write_text(
        path,
        ("# @package estimator\n" if "/" in option else "")
        + f"# {tuned.estimator}, tuned: {tuning.trials} trials on seeds {list(tuning.seeds)} of "
        f"study={study}.\n"
        f"# On {tuned.n_judged} other recordings its error is {tuned.gain.value:.2f} "
        f"[{tuned.gain.low:.2f}, {tuned.gain.high:.2f}] times the default's.\n"
        f"defaults:\n  - {option}\n  - _self_\n"
        + (yaml.safe_dump(nested(tuned.values), sort_keys=False) if tuned.values else ""),
    )
    return path


def with_values(experiment: Experiment, values: Mapping[str, Any]) -> Experiment:
    """An experiment with values of its estimator by key; its other settings are kept."""
    options = nested(values)
    for option, settings in options.items():
        if isinstance(settings, dict):
            options[option] = {**(experiment.option(option) or {}), **settings}
    return experiment.with_estimator(**options)


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by key as options: `settings.width` is a key of the option `settings`."""
    options: dict[str, Any] = {}
    for key, value in values.items():
        option, _, setting = key.partition(".")
        if setting:
            options.setdefault(option, {})[setting] = value
        else:
            options[key] = value
    return options


def trials_table(results: Sequence[TuningResult]) -> pd.DataFrame:
    """All trials, a row each."""
    parts = {tuned.estimator: tuned.trials for tuned in results}
    return pd.concat(parts, names=["estimator"]).reset_index(level=0).reset_index(drop=True)


def gains_table(results: Sequence[TuningResult]) -> pd.DataFrame:
    """A row an estimator: trials, errors of default and winner, and their ratio's interval."""
    return pd.DataFrame(
        [
            {
                "estimator": t.estimator,
                "trials": len(t.trials),
                "pruned": int((t.trials["state"] == "pruned").sum()),
                "judged_recordings": t.n_judged,
                "default_ate_rmse_m": t.default_m,
                "tuned_ate_rmse_m": t.tuned_m,
                "tuned_over_default": t.gain.value,
                "low": t.gain.low,
                "high": t.gain.high,
                "values": json.dumps(dict(t.values)),
            }
            for t in results
        ]
    )


def merge_into(path: Path, table: pd.DataFrame, order: Sequence[str]) -> pd.DataFrame:
    """Write the rows of the estimators just tuned, and keep those of the study's others.

    Returns
    -------
    pandas.DataFrame
        All rows, by the study's order of estimators.
    """
    if path.exists():
        old = read_rows(path)
        table = pd.concat([table, old[~old["estimator"].isin(table["estimator"])]])
    table = table[table["estimator"].isin(order)]
    table = table.sort_values("estimator", key=lambda s: s.map(order.index), kind="stable")
    write_frame(table, path, digits=6)
    return table.reset_index(drop=True)


def curves(trials: pd.DataFrame, gains: pd.DataFrame) -> Figure:
    """Draw the best value against the trials, and the gains that were judged."""
    page, (left, right) = subplots(10.0, 3.8, 1, 2)
    lines: dict[str, Line2D] = {}
    bounds = gains[["estimator", "low", "tuned_over_default", "high"]]
    for i, name, low, gain, high in bounds.itertuples(name=None):
        rows = trials[trials["estimator"] == name]
        colour, marker = SERIES[i % len(SERIES)]
        style = {"color": colour, "marker": marker, "ms": 6}
        best = rows["best_so_far_m"].to_numpy(float)
        at = [i % len(best)]  # one mark a line, at trials of their own, where lines are the same
        (line,) = left.step(rows["trial"], best / best[0], where="post", markevery=at, **style)
        lines[name] = line
        right.errorbar(gain, -i, xerr=[[gain - low], [high - gain]], capsize=3, **style)
    left.set(
        xlabel="trials", ylabel="best error over the default's,\nseeds of tuning", yscale="log"
    )
    right.axvline(1.0, color="0.6", lw=0.8, ls="--")
    right.set(xlabel="error over the default's, judged seeds [95 %]", xscale="log")
    right.set_yticks(-np.arange(len(gains)), gains["estimator"])
    plain_log(left.yaxis)
    plain_log(right.xaxis)
    name_ends(page, left, lines)
    return page


@dataclass(frozen=True)
class _Problem:
    """An estimator to tune: on which experiments, judged by which, and what may change."""

    name: str
    trials: int
    ranges: Mapping[str, Range]
    drives: Sequence[Experiment]
    judged: Sequence[Experiment]
    default: Mapping[str, Any]


def _problem(study: str, name: str, tuning: Tuning, config_dir: str | None) -> _Problem:
    """The problem of one estimator; it is tuned on all worlds of a seed together."""
    common = [
        f"study={study}",
        "sweeps=[]",
        f"estimator={find_option('estimator', name, config_dir)}",
    ]
    seeds = f"seed={','.join(map(str, tuning.seeds))}"
    drives = sorted(plan_experiments([*common, seeds], config_dir), key=lambda e: e.seed)
    judged = list(plan_experiments(common, config_dir))
    require(
        all(e.seed >= FIRST_JUDGED_SEED for e in judged),
        f"study={study}: its own seeds are judged, and must be {FIRST_JUDGED_SEED} or more; set "
        "seed under hydra.sweeper.params, since `sweeps` is not read here",
    )
    drives[0].check()
    options, ranges = drives[0].options_of("estimator"), tuning.estimators[name]
    del options["_target_"]
    default: dict[str, Any] = {}
    for key, allowed in ranges.items():
        option, dot, setting = key.partition(".")
        require(option in options, f"{name} has no option {key}; it has {', '.join(options)}")
        where = f"tune.estimators.{name}.{key}"
        stated = (options[option] or {}) if dot else options
        require(isinstance(stated, dict), f"{where}: {option} has no settings; leave out the dot")
        of_program = bool(dot) and setting not in stated
        require(not dot or setting, f"{where}: name the setting after the dot")
        require(
            not of_program or allowed.default is not None,
            f"{where}: give the default, with which the program runs",
        )
        require(
            of_program or allowed.default is None,
            f"{where}: leave out the default, which the option's file states",
        )
        default[key] = allowed.default if of_program else stated[setting or key]
        require(
            allowed.has(default[key]),
            f"{where} must hold the default, {default[key]!r}, so that it is a trial too",
        )
    return _Problem(name, tuning.trials, ranges, drives, judged, default)


def _tuned(problem: _Problem, journal: Path, jobs: int) -> TuningResult:
    journal.parent.mkdir(parents=True, exist_ok=True)
    opened, default = _opened(journal, problem), problem.default
    if not opened.trials:
        opened.enqueue_trial(default)
    Parallel(n_jobs=jobs)(delayed(_work)(journal, problem, worker) for worker in range(jobs))
    done = _opened(journal, problem).get_trials(states=_done())
    finished = sorted(done, key=lambda t: t.number)[: problem.trials]  # processes may make more
    for trial in finished:  # a journal may come from anybody
        sound = all(
            k in problem.ranges and problem.ranges[k].has(v) for k, v in trial.params.items()
        )
        require(sound, f"{journal}: trial {trial.number} is not of this study; delete the file")
    trials = _trials(finished)
    best = finished[int(trials["mean_log_error"].idxmin())]
    values = {k: v for k, v in best.params.items() if v != default[k]}
    before, after = (_judged(opened, chosen, problem.judged, jobs) for chosen in (default, values))
    default_m, tuned_m = (math.exp(float(np.mean(np.log(e)))) for e in (before, after))
    gain = log_ratio_interval(after, before)
    return TuningResult(problem.name, values, trials, gain, default_m, tuned_m, len(problem.judged))


def _judged(
    study: Any, values: Mapping[str, Any], judged: Sequence[Experiment], jobs: int
) -> list[float]:
    """Errors of these values on the judged recordings, m; the journal keeps them."""
    key = json.dumps([_digest(judged, {}), values], sort_keys=True)
    kept: dict[str, list[float]] = study.user_attrs.get("judged", {})
    if key not in kept:
        runs = (delayed(error_m)(with_values(experiment, values)) for experiment in judged)
        kept = {**kept, key: list(Parallel(n_jobs=jobs)(runs))}
        study.set_user_attr("judged", kept)
    return kept[key]


def _work(journal: Path, problem: _Problem, worker: int) -> None:
    """Run trials until there are enough of them."""
    study = _opened(journal, problem, seed=len(problem.drives) + worker)
    if len(study.get_trials(deepcopy=False, states=_done())) < problem.trials:
        enough = _optuna().study.MaxTrialsCallback(problem.trials, states=_done())
        study.optimize(lambda trial: _mean_log_error(trial, problem), callbacks=[enough])


def _done() -> tuple[Any, Any]:
    """States of trials that count; one that was interrupted is run again."""
    states = _optuna().trial.TrialState
    return states.COMPLETE, states.PRUNED


def _mean_log_error(trial: Any, problem: _Problem) -> float:
    """Mean log error of a trial's values; the trial is pruned when it is clearly not the best.

    The default is not: the others' errors are told as shares of its own.
    """
    values = {name: _suggested(trial, name, allowed) for name, allowed in problem.ranges.items()}
    logs = []
    for i, experiment in enumerate(problem.drives):
        logs.append(math.log(error_m(with_values(experiment, values))))
        trial.report(logs[-1], i)
        last = i + 1 == len(problem.drives)
        if not last and values != problem.default and trial.should_prune():
            raise _optuna().TrialPruned
    return float(np.mean(logs))


def _suggested(trial: Any, name: str, allowed: Range) -> Any:
    if allowed.interval is None:
        return trial.suggest_categorical(name, allowed.choice)
    whole = isinstance(allowed.interval[0], int)
    suggest = trial.suggest_int if whole else trial.suggest_float
    return suggest(name, *allowed.interval, log=allowed.log)


def error_m(experiment: Experiment) -> float:
    """Position error of the best answer, RMS m; the geometric mean over its repeats."""
    with hold_interrupts() as on_step:  # an interrupted run is none that failed
        rows = evaluate(experiment, shown=lambda _: nullcontext(on_step))
    return math.exp(float(np.mean([math.log(_answer_m(row)) for row in rows])))


def _answer_m(row: Row) -> float:
    error = row.get(REVISED + _ERROR, row.get(_ERROR))
    if row["status"] == Outcome.FAILED or not isinstance(error, float) or not math.isfinite(error):
        return FAILED_M
    return max(error, 1e-9)


def _trials(finished: Sequence[Any]) -> pd.DataFrame:
    """A row a trial; a pruned one has no value.

    Optuna gives that the value of its last recording.
    """
    table = pd.DataFrame(
        [
            {
                "trial": number,
                "state": trial.state.name.lower(),
                "seconds": trial.duration.total_seconds(),
                "mean_log_error": trial.value if trial.state.name == "COMPLETE" else math.nan,
                "options": json.dumps(trial.params),
            }
            for number, trial in enumerate(finished, start=1)
        ]
    )
    return table.assign(best_so_far_m=np.exp(table["mean_log_error"].cummin().ffill()))


def _digest(drives: Sequence[Experiment], ranges: Mapping[str, Range]) -> str:
    """What decides the trials; the budget does not, so that it can be raised later."""
    of_all = [[e.key for e in drives], {name: repr(r) for name, r in sorted(ranges.items())}]
    return hashlib.sha256(json.dumps(of_all).encode()).hexdigest()[:16]


def _opened(journal: Path, problem: _Problem, seed: int = 0) -> Any:
    """The study of a problem in a journal; a new one if there is none."""
    optuna = _optuna()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # parts of Optuna call themselves experimental
        return optuna.create_study(
            storage=optuna.storages.JournalStorage(
                optuna.storages.journal.JournalFileBackend(str(journal))
            ),
            study_name=_digest(problem.drives, problem.ranges),
            load_if_exists=True,
            sampler=optuna.samplers.TPESampler(seed=seed, n_startup_trials=5),
            pruner=optuna.pruners.WilcoxonPruner(p_threshold=_PRUNED_BELOW),
        )


def _optuna() -> Any:
    try:
        import optuna
    except ImportError as error:
        raise InputError(f"tuning needs Optuna ({error}); {how_to_install('tune')}") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
