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
from omegaconf import OmegaConf

from experiments.evaluation.statistics import Interval, log_ratio_interval
from experiments.runs import paths
from experiments.runs.columns import REVISED
from experiments.runs.compose import composed_options, option_called, searched
from experiments.runs.console import progress
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.processes import held_interrupts
from experiments.runs.row import Outcome, Row, read_rows, write_frame
from experiments.sweeps.plan import planned
from experiments.sweeps.ranges import FIRST_JUDGED_SEED, Range, Tuning
from experiments.viewing.plotting import plain_log
from experiments.viewing.style import SERIES, save_figure, subplots
from sim.errors import InputError, require
from sim.files import write_text

FAILED_M = 100.0  # what a run that failed counts as
_ERROR = "ate_rmse_m"
_PRUNED_BELOW = 0.1  # p of the signed-rank test


@dataclass(frozen=True)
class Tuned:
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
    cfg = composed_options([*searched(config_dir), f"study={study}"])
    return Tuning.of(study, OmegaConf.to_container(cfg).get("tune"))  # type: ignore[union-attr]


def tune(
    study: str,
    only: Collection[str] = (),
    *,
    jobs: int = 1,
    config_dir: str | None = None,
    on_progress: Callable[[float], None] = lambda _: None,
) -> Iterator[Tuned]:
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
    require(jobs >= 1, f"--jobs must be at least 1, got {jobs}")
    _optuna()
    tuning = tuning_of(study, config_dir)
    for name in only:
        known = ", ".join(tuning.estimators)
        require(name in tuning.estimators, f"study={study} does not tune {name}; it has {known}")
    names = list(only) or list(tuning.estimators)
    plans = {name: _plan(study, name, tuning, config_dir) for name in names}  # wrong keys end here
    for done, (name, (drives, judged)) in enumerate(plans.items(), start=1):
        yield _tuned(study, name, tuning, drives, judged, jobs)
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
    plan, place = tuning_of(study, config_dir), paths.results()
    found, written = [], []
    with progress(f"tune {study}", 1.0) as on_progress:
        for tuned in tune(study, only, jobs=jobs, config_dir=config_dir, on_progress=on_progress):
            found.append(tuned)
            written.append(write(tuned, study, plan, folder or place / "tuned" / "estimator"))
    tables = place / "tables"
    trials = written_beside(trials_table(found), tables / f"{study}_trials_tuning.csv", plan)
    gains = written_beside(gains_table(found), tables / f"{study}_tuning.csv", plan)
    save_figure(curves(trials, gains), place / "figures" / f"{study}_tuning.png")
    text = gains.to_string(index=False, float_format=lambda v: f"{v:.4g}")
    return "\n".join([text, *map(paths.short, written)])


def yaml_of(tuned: Tuned, study: str, tuning: Tuning) -> str:
    """An option of conf/estimator: the default with the winner's values."""
    option = option_called("estimator", tuned.estimator)
    return ("# @package estimator\n" if "/" in option else "") + (
        f"# {tuned.estimator}, tuned: {tuning.trials} trials on seeds {list(tuning.seeds)} of "
        f"study={study}.\n"
        f"# On {tuned.n_judged} other recordings its error is {tuned.gain.value:.2f} "
        f"[{tuned.gain.low:.2f}, {tuned.gain.high:.2f}] times the default's.\n"
        f"defaults:\n  - {option}\n  - _self_\n"
        + (yaml.safe_dump(dict(tuned.values), sort_keys=False) if tuned.values else "")
    )


def write(tuned: Tuned, study: str, tuning: Tuning, folder: Path) -> Path:
    """Write the winner's YAML, `ESTIMATOR_tuned.yaml`; return its path."""
    path = folder / f"{option_called('estimator', tuned.estimator)}_tuned.yaml"
    write_text(path, yaml_of(tuned, study, tuning))
    return path


def trials_table(results: Sequence[Tuned]) -> pd.DataFrame:
    """All trials, a row each."""
    parts = [tuned.trials.assign(estimator=tuned.estimator) for tuned in results]
    table = pd.concat(parts, ignore_index=True)
    return table[["estimator", *(column for column in table if column != "estimator")]]


def gains_table(results: Sequence[Tuned]) -> pd.DataFrame:
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


def written_beside(table: pd.DataFrame, path: Path, tuning: Tuning) -> pd.DataFrame:
    """Write the rows of the estimators just tuned, and keep those of the study's others.

    Returns
    -------
    pandas.DataFrame
        All rows, by the study's order of estimators.
    """
    parts = [table]
    if path.exists():
        kept = read_rows(path)
        parts.append(kept[~kept["estimator"].isin(set(table["estimator"]))])
    both = pd.concat(parts, ignore_index=True)
    order = [name for name in tuning.estimators if name in set(both["estimator"])]
    found = pd.concat([both[both["estimator"] == name] for name in order], ignore_index=True)
    write_frame(found, path, digits=6)
    return found


def curves(trials: pd.DataFrame, gains: pd.DataFrame) -> Figure:
    """Draw the best value against the trials, and the gains that were judged."""
    names = list(gains["estimator"])
    page, (left, right) = subplots(10.0, 3.8, 1, 2)
    places = np.arange(len(names))[::-1]
    judged = gains.set_index("estimator")[["low", "tuned_over_default", "high"]]
    for i, (name, place) in enumerate(zip(names, places, strict=True)):
        rows = trials[trials["estimator"] == name]
        colour, marker = SERIES[i % len(SERIES)]
        style = {"color": colour, "marker": marker, "ms": 6}
        best = rows["best_so_far_m"].to_numpy(float)
        at = [i % len(best)]  # one mark a line, at trials of their own, where lines are the same
        left.step(rows["trial"], best / best[0], where="post", label=name, markevery=at, **style)
        low, gain, high = judged.loc[name]
        right.errorbar(gain, place, xerr=[[gain - low], [high - gain]], capsize=3, **style)
    left.set(
        xlabel="trials", ylabel="best error over the default's,\nseeds of tuning", yscale="log"
    )
    page.legend(loc="outside lower center", ncols=4, fontsize=8)
    right.axvline(1.0, color="0.6", lw=0.8, ls="--")
    right.set(xlabel="error over the default's, other seeds, 95 % interval", xscale="log")
    right.set_yticks(places, names)
    plain_log(left.yaxis)
    plain_log(right.xaxis)
    return page


def _plan(
    study: str, name: str, tuning: Tuning, config_dir: str | None
) -> tuple[list[Experiment], list[Experiment]]:
    """Experiments to tune on, all worlds of a seed together, and to judge by."""
    common = [
        f"study={study}",
        "sweeps=[]",
        f"estimator={option_called('estimator', name, config_dir)}",
    ]
    seeds = f"seed={','.join(map(str, tuning.seeds))}"
    drives = sorted(planned([*common, seeds], config_dir), key=lambda e: e.seed)
    judged = list(planned(common, config_dir))
    require(
        all(e.seed >= FIRST_JUDGED_SEED for e in judged),
        f"study={study}: its own seeds are judged, and must be {FIRST_JUDGED_SEED} or more",
    )
    first = drives[0]
    first.check()
    for key, allowed in tuning.estimators[name].items():
        default = _value(first, key)
        require(
            allowed.has(default),
            f"tune.estimators.{name}.{key} must hold the default, {default!r}, so that it is a "
            "trial too",
        )
    return drives, judged


def _value(experiment: Experiment, option: str) -> Any:
    settings = experiment.options_of("estimator")
    del settings["_target_"]
    known = f"{experiment.estimator_name} has no option {option}; it has {', '.join(settings)}"
    require(option in settings, known)
    return settings[option]


def _tuned(
    study: str,
    name: str,
    tuning: Tuning,
    drives: Sequence[Experiment],
    judged: Sequence[Experiment],
    jobs: int,
) -> Tuned:
    optuna, ranges = _optuna(), tuning.estimators[name]
    journal = paths.results() / "tune" / study / f"{name}.journal"
    journal.parent.mkdir(parents=True, exist_ok=True)
    label = _digest(drives, ranges)
    default = {option: _value(drives[0], option) for option in ranges}
    opened = _opened(journal, label)
    if not opened.trials:
        opened.enqueue_trial(default)
    arguments = (str(journal), label, tuning.trials, ranges, drives)
    Parallel(n_jobs=jobs)(delayed(_work)(*arguments, worker) for worker in range(jobs))
    done = _opened(journal, label).get_trials(states=_done())
    finished = sorted(done, key=lambda t: t.number)[: tuning.trials]  # two processes may make more
    complete = [t for t in finished if t.state == optuna.trial.TrialState.COMPLETE]
    best = min(complete, key=lambda t: t.value)
    values = {k: v for k, v in best.params.items() if v != default[k]}
    before, after = (_judged(opened, chosen, judged, jobs) for chosen in (default, values))
    default_m, tuned_m = (math.exp(float(np.mean(np.log(e)))) for e in (before, after))
    gain = log_ratio_interval(after, before)
    return Tuned(name, values, _trials(finished), gain, default_m, tuned_m, len(judged))


def _judged(
    study: Any, values: Mapping[str, Any], judged: Sequence[Experiment], jobs: int
) -> list[float]:
    """Errors of these values on the judged recordings, m; the journal keeps them."""
    key = json.dumps([_digest(judged, {}), values], sort_keys=True)
    kept: dict[str, list[float]] = study.user_attrs.get("judged", {})
    if key not in kept:
        runs = (delayed(error_m)(experiment.with_estimator(**values)) for experiment in judged)
        kept = {**kept, key: list(Parallel(n_jobs=jobs)(runs))}
        study.set_user_attr("judged", kept)
    return kept[key]


def _work(
    journal: str,
    label: str,
    trials: int,
    ranges: Mapping[str, Range],
    drives: Sequence[Experiment],
    worker: int,
) -> None:
    """Run trials until there are enough of them."""
    optuna = _optuna()
    study = _opened(Path(journal), label, seed=len(drives) + worker)
    if len(study.get_trials(deepcopy=False, states=_done())) < trials:
        enough = optuna.study.MaxTrialsCallback(trials, states=_done())
        study.optimize(lambda trial: _mean_log_error(trial, ranges, drives), callbacks=[enough])


def _done() -> tuple[Any, Any]:
    """States of trials that count; one that was interrupted is run again."""
    states = _optuna().trial.TrialState
    return states.COMPLETE, states.PRUNED


def _mean_log_error(trial: Any, ranges: Mapping[str, Range], drives: Sequence[Experiment]) -> float:
    """Mean log error of a trial's values; the trial is pruned when it is clearly not the best."""
    values = {name: _suggested(trial, name, allowed) for name, allowed in ranges.items()}
    logs = []
    for i, experiment in enumerate(drives):
        logs.append(math.log(error_m(experiment.with_estimator(**values))))
        trial.report(logs[-1], i)
        if i + 1 < len(drives) and trial.should_prune():
            raise _optuna().TrialPruned
    return float(np.mean(logs))


def _suggested(trial: Any, name: str, allowed: Range) -> Any:
    if allowed.choice:
        return trial.suggest_categorical(name, allowed.choice)
    if allowed.whole:
        return trial.suggest_int(name, allowed.low, allowed.high, log=allowed.log)
    return trial.suggest_float(name, allowed.low, allowed.high, log=allowed.log)


def error_m(experiment: Experiment) -> float:
    """Position error of the best answer, RMS m; the geometric mean over its repeats."""
    with held_interrupts() as on_step:  # an interrupted run is none that failed
        rows = evaluate(experiment, shown=lambda _: nullcontext(on_step))
    return math.exp(float(np.mean([math.log(_answer_m(row)) for row in rows])))


def _answer_m(row: Row) -> float:
    found = row.get(REVISED + _ERROR, row.get(_ERROR))
    if row["status"] == Outcome.FAILED or not isinstance(found, float) or not math.isfinite(found):
        return FAILED_M
    return max(found, 1e-9)


def _trials(finished: Sequence[Any]) -> pd.DataFrame:
    """A row a trial; a pruned one has no value.

    Optuna gives that the value of its last recording.
    """
    rows = []
    for number, trial in enumerate(finished, start=1):
        state = trial.state.name.lower()
        value = trial.value if state == "complete" else math.nan
        options = json.dumps(trial.params)
        seconds = trial.duration.total_seconds()
        rows.append((number, state, seconds, value, options))
    table = pd.DataFrame(rows, columns=["trial", "state", "seconds", "mean_log_error", "options"])
    return table.assign(best_so_far_m=np.exp(table["mean_log_error"].cummin().ffill()))


def _digest(drives: Sequence[Experiment], ranges: Mapping[str, Range]) -> str:
    """What decides the trials; the budget does not, so that it can be raised later."""
    of_all = [[e.key for e in drives], {name: repr(r) for name, r in sorted(ranges.items())}]
    return hashlib.sha256(json.dumps(of_all).encode()).hexdigest()[:16]


def _opened(journal: Path, label: str, seed: int = 0) -> Any:
    """The study of this label in a journal; a new one if there is none."""
    optuna = _optuna()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # parts of Optuna call themselves experimental
        return optuna.create_study(
            storage=optuna.storages.JournalStorage(
                optuna.storages.journal.JournalFileBackend(str(journal))
            ),
            study_name=label,
            load_if_exists=True,
            sampler=optuna.samplers.TPESampler(seed=seed, n_startup_trials=5),
            pruner=optuna.pruners.WilcoxonPruner(p_threshold=_PRUNED_BELOW),
        )


def _optuna() -> Any:
    try:
        import optuna
    except ImportError as error:
        raise InputError(f"tuning needs Optuna ({error}); pip install 'estima[tune]'") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
