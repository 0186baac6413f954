"""Trajectories made elsewhere over the recordings of a suite, as rows that a check compares."""

import importlib.util
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from estimators.programs.offline import recording_of, start_text
from experiments.evaluation.metrics import path_scores
from experiments.gate.suite import ERRORS, Entry, Suite, fingerprint, read_suite, suite_path
from experiments.runs.console import progress, warn
from experiments.runs.experiment import Experiment
from experiments.runs.score import Scoring, match_and_align
from experiments.trajectories.read import SUFFIXES, read_trajectory
from sim.errors import InputError, printable, require
from sim.files import write_text
from sim.formats.carmen import write_carmen
from sim.formats.rosbag_out import write_bag
from sim.recording import Recording
from sim.team import Team

LONGEST_GAP_S = 1.0  # without a pose; longer ones fail, so that no candidate chooses what is scored


def write_recordings(
    suite: Suite, folder: Path, on_progress: Callable[[float], None] = lambda _: None
) -> int:
    """Write a suite's recordings without their truth, for programs elsewhere; return their number.

    GROUP_SEED.mcap (where rosbags is installed), GROUP_SEED.log (CARMEN, of a laser) and
    GROUP_SEED.start.txt, which holds the first belief: `x y heading`, and its covariance.
    Teams are left out.
    """
    named = {entry.recordings for entry in suite.estimators}
    groups = [g for g in named if suite.compose(suite.overrides[g]).team is None]
    total = sum(suite.counts[group] for group in groups)
    bags = importlib.util.find_spec("rosbags") is not None
    runs = ((group, *run) for group in groups for run in _recordings(suite, group))
    for done, (group, seed, experiment, team) in enumerate(runs, start=1):
        prior = experiment.prior(team.only)
        copy = recording_of(list(team.only.frames()), prior)
        stem = folder / f"{group}_{seed}"
        if bags:
            write_bag(stem.with_suffix(".mcap"), copy)
        if "laser" in copy.logs:
            write_carmen(stem.with_suffix(".log"), copy)
        write_text(stem.with_suffix(".start.txt"), start_text(prior))
        on_progress(done / total)
    return total


def export_recordings(suite: str, only: Sequence[str], folder: Path) -> str:
    """Write the recordings of a suite's entries that are made elsewhere; say how many."""
    chosen = read_suite(suite_path(suite)).select(only).made(elsewhere=True)
    with progress("recordings", 1.0) as on_progress:
        return f"{folder}: {write_recordings(chosen, folder, on_progress)} recordings"


def candidate_rows(
    suite: Suite,
    folder: Path,
    repeats: Mapping[str, int],
    on_progress: Callable[[float], None] = lambda _: None,
) -> pd.DataFrame:
    """Errors of each trajectory, in the columns of `run_suite`.

    The files are GROUP_SEED.tum (or .csv, .mcap, .bag), of several repeats GROUP_SEED.0.tum and so
    on; in a folder of its own, called by the entry, for each of several entries. A trajectory that
    is missing, cannot be read, or has a gap of more than a second is a run that failed. Files of
    trajectories that belong to no run are left out, and named.

    Raises
    ------
    InputError
        If there are none.
    """
    rows: list[dict[str, Any]] = []
    for place, entry in enumerate(suite.estimators):
        own = folder if len(suite.estimators) == 1 else folder / entry.name
        group, count = entry.recordings, suite.counts[entry.recordings]
        require(
            own.is_dir() and any(own.glob(f"{group}_*")),
            f"{own}: no trajectories here; name them {group}_{suite.first_seed}.tum, and of "
            f"several repeats {group}_{suite.first_seed}.0.tum",
        )
        read = set[Path | None]()
        for i, (seed, _, team) in enumerate(_recordings(suite, group)):
            origin = {"checksum": team.checksum[:12], "fingerprint": fingerprint(team)}
            for repeat in range(repeats[entry.name]):
                which = {"estimator": entry.name, "recording": seed, "repeat": repeat}
                path = trajectory_path(own, entry, seed, repeat)
                read.add(path)
                errors, status = _errors(path, entry, seed, repeat, team.only)
                rows.append({**which, **origin, **errors, "status": status})
            on_progress((place + (i + 1) / count) / len(suite.estimators))
        _tell_of_others(own, read)
    return pd.DataFrame(rows)


def _tell_of_others(folder: Path, read: set[Path | None]) -> None:
    """Name the trajectories of a folder that belong to no run."""
    others = sorted(p.name for p in folder.iterdir() if p.suffix in SUFFIXES and p not in read)
    if others:
        more = f" and {len(others) - 5} more" if len(others) > 5 else ""
        shown = printable(", ".join(others[:5]))
        warn(f"{folder}: of no run, left out: {shown}{more}")


def trajectory_path(folder: Path, entry: Entry, seed: int, repeat: int) -> Path | None:
    """File of a run's trajectory; None if there is none."""
    stem = f"{entry.recordings}_{seed}"
    names = [f"{stem}.{repeat}", *([stem] if repeat == 0 else [])]
    paths = (folder / f"{name}{suffix}" for name in names for suffix in SUFFIXES)
    return next((path for path in paths if path.exists()), None)


def _errors(
    path: Path | None, entry: Entry, seed: int, repeat: int, recording: Recording
) -> tuple[dict[str, float], str]:
    nothing = dict.fromkeys(ERRORS, float("nan"))
    if path is None:
        return nothing, f"missing: no trajectory {entry.recordings}_{seed}, repeat {repeat}"
    try:
        scored = match_and_align(recording, read_trajectory(path), Scoring())
    except InputError as error:
        return nothing, printable(f"unreadable: {error}")
    if scored.longest_gap_s > LONGEST_GAP_S:
        return nothing, f"gap: {scored.longest_gap_s:.3g} s without a pose"
    scores = path_scores(scored.truth, scored.estimate.means, scored.estimate.covariances)
    return {name: scores[name] for name in ERRORS}, "ok"


def _recordings(suite: Suite, group: str) -> Iterator[tuple[int, Experiment, Team]]:
    """Seed, experiment and recording, one after another."""
    whole = suite.compose(suite.overrides[group])
    for i in range(suite.counts[group]):
        seed = suite.first_seed + i
        experiment = whole.with_values(seed=seed, world_seed=seed)
        yield seed, experiment, experiment.recordings()
