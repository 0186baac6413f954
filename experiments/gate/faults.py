"""The planted-regression experiment: how often `estima check` alarms wrongly and rightly.

Faults are planted in the estimators' code, in three kinds: a wrong entry of a derivative (or of
the geometry it stands for), a lost observation, an inflated noise. Each is graded to a worsening
of 10 %: its size is sought until the geometric mean of the position errors over all recordings of
the pool has risen by that much. No error is ever scaled.

All runs are made once and pooled; whole checks are then drawn from the pool: recordings with
replacement, so that no luck of the suite's own seeds is counted, and of estimators that draw at
random the baseline's and the check's runs, apart from each other, among the seedings of the pool.
A check on equivalent code draws both from the sound runs of all estimators, a check on a fault
draws the check's from the faulty runs of one.

    python -m experiments.gate.faults                # about half an hour on two cores
    python -m experiments.gate.faults --share 0.1    # a few minutes; rough
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy import stats

from estimators import ekf_icp, ekf_icp_paper, fastslam, mcl, odometry, smoother
from estimators.base import Belief, Estimator, Prior
from estimators.gaussian import Gaussian
from estimators.scan_matching import Match, ScanMatcher
from estimators.stereo import StereoModel
from experiments.evaluation.statistics import share_interval
from experiments.gate.compare import (
    ALPHA_GENERAL,
    ALPHA_REAL,
    Finding,
    baseline_folder,
    baseline_paths,
    compare,
    examine,
    judge,
    read_baseline,
)
from experiments.gate.power_figure import detectable
from experiments.gate.suite import ERRORS, Suite, read_suite, run_suite, suite_path
from experiments.runs.console import progress
from experiments.runs.paths import SOURCE, results
from experiments.runs.row import write_frame
from experiments.runs.seeds import stream
from experiments.viewing.style import save_figure
from sim.files import write_whole
from sim.recording import Frame, LandmarkSet

Array = NDArray[np.float64]
Planted = Callable[[Estimator, np.random.Generator], AbstractContextManager[Estimator]]
Fault = Callable[[float], Planted]  # of a size

TARGET = 0.10  # worsening that faults are graded to
_NEAR = 0.01  # of it
_MOST_TRIALS = 8
_RANDOM = 10  # seedings of the pool for each recording
_FAULTY_RANDOM = 3
_CHANGE_OF_SIZE = 6.0
_N_DRAWS = 20_000  # permutations in each drawn test
_BEGIN, _END = "<!-- measured -->", "<!-- end of what was measured -->"


def changed(change: Callable[[Frame, np.random.Generator], Frame]) -> Planted:
    """Hand the estimator changed Frames."""

    @contextmanager
    def plant(estimator: Estimator, rng: np.random.Generator) -> Iterator[Estimator]:
        sound = estimator.step

        def step(frame: Frame) -> Belief:
            return sound(change(frame, rng))

        with mock.patch.object(estimator, "step", step):
            yield estimator

    return plant


def patched(*patches: tuple[Any, str, Callable[[Any], Any]]) -> Planted:
    """Put another function in place of an attribute: what `wrap(sound one)` gives."""

    @contextmanager
    def plant(estimator: Estimator, rng: np.random.Generator) -> Iterator[Estimator]:
        with ExitStack() as stack:
            for owner, name, wrap in patches:
                stack.enter_context(mock.patch.object(owner, name, wrap(getattr(owner, name))))
            yield estimator

    return plant


def lost(name: str) -> Fault:
    """Each datum of a sensor goes missing with some chance."""

    def fault(share: float) -> Planted:
        def change(frame: Frame, rng: np.random.Generator) -> Frame:
            nothing: dict[str, Any] = {name: None}
            return dataclasses.replace(frame, **nothing) if rng.random() < share else frame

        return changed(change)

    return fault


def lost_landmarks(share: float) -> Planted:
    """Each observation of a landmark goes missing with some chance."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        seen = frame.landmarks
        if seen is None:
            return frame
        kept = rng.random(len(seen.points_in_camera)) >= share
        parts = (seen.points_in_camera, seen.ids, seen.descriptors)
        left = LandmarkSet(*(None if part is None else part[kept] for part in parts))  # type: ignore[arg-type]
        return dataclasses.replace(frame, landmarks=left)

    return changed(change)


def lost_increments(share: float) -> Planted:
    """Each reading of the wheels goes missing with some chance, and its travel with it."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        gone = rng.random() < share
        return dataclasses.replace(frame, wheel_increments_m=np.zeros(2)) if gone else frame

    return changed(change)


def noisy_increments(k: float) -> Planted:
    """Wheel increments with noise of variance k |ds| added."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        travel = frame.wheel_increments_m
        noise = np.sqrt(k * np.abs(travel)) * rng.standard_normal(2)
        return dataclasses.replace(frame, wheel_increments_m=travel + noise)

    return changed(change)


def noisy_ranges(sigma_m: float) -> Planted:
    """Ranges with noise added."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        if frame.ranges_m is None:
            return frame
        noise = sigma_m * rng.standard_normal(frame.ranges_m.shape)
        return dataclasses.replace(frame, ranges_m=(frame.ranges_m + noise).astype(np.float32))

    return changed(change)


def noisy_descriptors(sigma: float) -> Planted:
    """Place descriptors with noise added, of this length on average."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        seen = frame.place_descriptor
        if seen is None:
            return frame
        noise = sigma / math.sqrt(len(seen)) * rng.standard_normal(len(seen))
        return dataclasses.replace(frame, place_descriptor=(seen + noise).astype(np.float32))

    return changed(change)


def wrong_track(share: float) -> Planted:
    """The track in the heading's row of the wheels' matrix is too long."""

    def wrap(sound: Any) -> Any:
        return lambda travel_m, track_m, form: sound(travel_m, (1.0 + share) * track_m, form)

    return patched((odometry, "relative_motion", wrap))


def wrong_mount(offset_m: float) -> Planted:
    """The laser sits elsewhere on the robot than believed."""

    @contextmanager
    def plant(estimator: Estimator, rng: np.random.Generator) -> Iterator[Estimator]:
        sound = estimator.reset

        def reset(prior: Prior, rng: np.random.Generator) -> None:
            laser = prior.sensors.laser
            assert laser is not None
            mount = dataclasses.replace(laser.mount, x_m=laser.mount.x_m + offset_m)
            laser = dataclasses.replace(laser, mount=mount)
            sensors = dataclasses.replace(prior.sensors, laser=laser)
            sound(dataclasses.replace(prior, sensors=sensors), rng)

        with mock.patch.object(estimator, "reset", reset):
            yield estimator

    return plant


def wrong_between(share: float) -> Planted:
    """The derivative of a relative heading by the robot's own is too large."""

    def wrap(sound: Any) -> Any:
        def between(first: Array, second: Array) -> tuple[Array, Array, Array]:
            pose, by_first, by_second = sound(first, second)
            by_second[2, 2] *= 1.0 + share
            return pose, by_first, by_second

        return between

    return patched((ekf_icp, "between", wrap))


def wrong_observation(share: float) -> Planted:
    """The velocity's derivative by the heading is too large."""

    def wrap(sound: Any) -> Any:
        def observation(state: Array) -> tuple[Array, Array]:
            velocity, H = sound(state)
            H[:2, 2] *= 1.0 + share
            return velocity, H

        return observation

    return patched((ekf_icp_paper, "observation", wrap))


def wrong_prediction(share: float) -> Planted:
    """The derivative of a landmark's predicted point by the heading is too large."""

    def wrap(sound: Any) -> Any:
        def predict(self: StereoModel, pose: Array, landmarks: Array) -> tuple[Array, Array, Array]:
            points, by_pose, by_landmark = sound(self, pose, landmarks)
            by_pose = by_pose * [1.0, 1.0, 1.0 + share]
            return points, by_pose, by_landmark

        return predict

    return patched((StereoModel, "predict", wrap))


def wrong_wheels(module: Any) -> Fault:
    """The heading's row of the motion's derivative by the wheels is too large."""

    def fault(share: float) -> Planted:
        scale = np.array([1.0, 1.0, 1.0 + share])

        def wrap(sound: Any) -> Any:
            def wheel_motion(*arguments: Any) -> tuple[Gaussian, Array]:
                motion, by_wheels = sound(*arguments)
                covariance = scale[:, None] * motion.covariance * scale
                return Gaussian(motion.mean, covariance), scale[:, None] * by_wheels

            return wheel_motion

        return patched((module, "wheel_motion", wrap))

    return fault


def wrong_travel(share: float) -> Planted:
    """The wheels' travel is believed too long, as by a wrong radius."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        travel = (1.0 + share) * frame.wheel_increments_m
        return dataclasses.replace(frame, wheel_increments_m=travel)

    return changed(change)


def inflated_wheels(module: Any) -> Fault:
    """The slip of the wheels is believed too large."""

    def fault(share: float) -> Planted:
        def wrap(sound: Any) -> Any:
            return lambda *arguments: (1.0 + share) * sound(*arguments)

        return patched((module, "wheel_variances", wrap))

    return fault


def inflated_registration(share: float) -> Planted:
    """The covariance of registrations is believed too large."""

    def wrap(sound: Any) -> Any:
        def match(self: ScanMatcher, *arguments: Any, **more: Any) -> Match:
            found: Match = sound(self, *arguments, **more)
            motion = Gaussian(found.motion.mean, (1.0 + share) * found.motion.covariance)
            return dataclasses.replace(found, motion=motion)

        return match

    return patched((ScanMatcher, "match", wrap))


def inflated_camera(share: float) -> Planted:
    """The camera's noise is believed too large."""

    def wrap(sound: Any) -> Any:
        def of(*arguments: Any, **more: Any) -> StereoModel:
            model: StereoModel = sound(*arguments, **more)
            return dataclasses.replace(model, variances_px2=(1.0 + share) * model.variances_px2)

        return of

    return patched((StereoModel, "of", wrap))


# Each with a size to start the search from.
FAULTS: dict[str, dict[str, tuple[Fault, float]]] = {
    "odometry": {
        "derivative": (wrong_track, 0.02),
        "lost": (lost_increments, 0.01),
        "noise": (noisy_increments, 5e-5),
    },
    "icp_odometry": {
        "derivative": (wrong_mount, 0.005),
        "lost": (lost("ranges_m"), 0.2),
        "noise": (noisy_ranges, 0.005),
    },
    "ekf_icp": {
        "derivative": (wrong_between, 0.1),
        "lost": (lost("ranges_m"), 0.2),
        "noise": (inflated_registration, 2.0),
    },
    "ekf_icp_paper": {
        "derivative": (wrong_observation, 0.1),
        "lost": (lost("ranges_m"), 0.05),
        "noise": (inflated_registration, 1.0),
    },
    "ekf_slam": {
        "derivative": (wrong_prediction, 0.05),
        "lost": (lost_landmarks, 0.2),
        "noise": (inflated_camera, 2.0),
    },
    "smoother": {
        "derivative": (wrong_wheels(smoother), 1.0),
        "lost": (lost_landmarks, 0.2),
        "noise": (inflated_camera, 2.0),
    },
    "fastslam": {
        "derivative": (wrong_wheels(fastslam), 0.5),
        "lost": (lost_landmarks, 0.2),
        "noise": (inflated_camera, 2.0),
    },
    "mcl": {
        "derivative": (wrong_wheels(mcl), 0.5),
        "lost": (lost("ranges_m"), 0.3),
        "noise": (inflated_wheels(mcl), 1.0),
    },
    "topological_mcl": {
        "derivative": (wrong_travel, 0.2),
        "lost": (lost("place_descriptor"), 0.1),
        "noise": (noisy_descriptors, 0.3),
    },
}

# Runs that equal code may well give: environment of a process, and whether it draws otherwise.
VARIANTS: dict[str, tuple[dict[str, str], bool]] = {
    "streams reseeded": ({}, False),
    "draws reordered": ({}, True),
    "NumPy and BLAS without AVX": (
        {
            "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL",
            "OPENBLAS_CORETYPE": "Nehalem",
        },
        False,
    ),
    "compiled for a generic processor": ({"NUMBA_CPU_NAME": "generic"}, False),
    "two threads": (
        {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "2"},
        False,
    ),
}


@contextmanager
def reordered(estimator: Estimator, rng: np.random.Generator) -> Iterator[Estimator]:
    """Draw a number before all others, so that each falls to another use."""
    sound = estimator.reset

    def reset(prior: Prior, stream_: np.random.Generator) -> None:
        stream_.standard_normal()
        sound(prior, stream_)

    with mock.patch.object(estimator, "reset", reset):
        yield estimator


@dataclasses.dataclass(frozen=True)
class Pool:
    """Runs of a suite, (n, runs) of each estimator and error, in the order of the recordings.

    Attributes
    ----------
    suite
        What is checked; the pool may hold fewer recordings.
    sound
        Sound runs of all estimators.
    faulty
        Of each (estimator, kind): size, and its runs.
    """

    suite: Suite
    sound: dict[tuple[str, str], Array]
    faulty: dict[tuple[str, str], tuple[float, dict[str, Array]]]


def arrays(rows: pd.DataFrame) -> dict[tuple[str, str], Array]:
    """Errors (n, runs) of each estimator and error."""
    return {
        (str(name), error): group.pivot(index="recording", columns="repeat", values=error).to_numpy(
            np.float64
        )
        for name, group in rows.groupby("estimator", sort=False)
        for error in ERRORS
    }


def worsening(then: Array, now: Array) -> float:
    """Rise of the geometric mean over the recordings, as a share; failed runs count for nothing."""
    rises = np.log(now).mean(axis=1) - np.log(then).mean(axis=1)
    return math.expm1(float(np.nanmean(rises)))


def grade(
    fault: Fault, start: float, measure: Callable[[Planted], pd.DataFrame], sound: Array, name: str
) -> tuple[float, pd.DataFrame]:
    """Size at which a fault raises the position error by TARGET, and the runs with it."""
    low, high, size = 0.0, math.inf, start
    rise_low, rise_high = 0.0, math.inf
    best: tuple[float, float, pd.DataFrame] | None = None
    for _ in range(_MOST_TRIALS):
        rows = measure(fault(size))
        rise = worsening(sound, arrays(rows)[name, "ate_rmse_m"])
        if best is None or abs(rise - TARGET) < abs(best[0] - TARGET):
            best = rise, size, rows
        if abs(rise - TARGET) < _NEAR:
            break
        if rise < TARGET:
            low, rise_low = size, rise
        else:
            high, rise_high = size, rise
        if low == 0.0 or not math.isfinite(high):  # as if the rise went with the size
            most = _CHANGE_OF_SIZE
            times = TARGET / rise if rise > 0.0 else most
            size *= min(max(times, 1.0 / most), most)
        else:
            share = (TARGET - rise_low) / (rise_high - rise_low)
            size = low + min(max(share, 0.15), 0.85) * (high - low)
    assert best is not None
    return best[1], best[2]


def pooled(suite: Suite, share: float) -> Suite:
    """Return the suite with this share of its recordings."""
    return suite.resized({group: round(share * n) for group, n in suite.counts.items()})


def fill_pool(
    suite: Suite, share: float, folder: Path, on_progress: Callable[[float], None]
) -> Pool:
    """Make the pool's runs over this share of the recordings, or read those that are there."""
    random = {entry.name for entry in suite.estimators if entry.repeats[0] > 1}
    n_runs = {entry.name: _RANDOM if entry.name in random else 1 for entry in suite.estimators}
    kinds = [(name, kind) for name in n_runs for kind in FAULTS.get(name, {})]
    sound_rows = _kept(
        folder / "sound.parquet", lambda: run_suite(pooled(suite, share), n_runs, reseed=1)
    )
    sound, faulty = arrays(sound_rows), {}
    for done, (name, kind) in enumerate(kinds, start=1):
        fault, start = FAULTS[name][kind]

        def graded(name: str = name, fault: Fault = fault, start: float = start) -> pd.DataFrame:
            def measure(planted: Planted) -> pd.DataFrame:
                runs = {name: _FAULTY_RANDOM if name in random else 1}
                return run_suite(pooled(suite, share), runs, reseed=2, planted={name: planted})

            size, rows = grade(fault, start, measure, sound[name, "ate_rmse_m"], name)
            return rows.assign(size=size)

        rows = _kept(folder / f"{name}_{kind}.parquet", graded)
        of_error = arrays(rows)
        faulty[name, kind] = float(rows["size"].iloc[0]), {e: of_error[name, e] for e in ERRORS}
        on_progress(done / len(kinds))
    return Pool(suite, sound, faulty)


def _kept(path: Path, make: Callable[[], pd.DataFrame]) -> pd.DataFrame:
    if path.exists():
        return pd.read_parquet(path)
    rows = make()
    with write_whole(path) as part:
        rows.to_parquet(part, index=False)
    return rows


def draw_check(
    pool: Pool, rng: np.random.Generator, fault: tuple[str, str] | None = None
) -> list[Finding]:
    """Draw a whole check against two baselines, with one fault planted or none."""
    n_pooled = {e.recordings: len(pool.sound[e.name, ERRORS[0]]) for e in pool.suite.estimators}
    counts = pool.suite.counts
    chosen = {group: rng.integers(n, size=counts[group]) for group, n in n_pooled.items()}
    findings = []
    for entry in pool.suite.estimators:
        name, rows = entry.name, chosen[entry.recordings]
        planted = fault is not None and fault[0] == name
        if entry.repeats[0] == 1 and not planted:
            continue  # equal to rounding, which no test is needed for
        n_then, n_now = entry.repeats
        of_error = pool.faulty[fault][1] if planted and fault is not None else None
        n_runs = pool.sound[name, ERRORS[0]].shape[1]
        order = np.argsort(rng.random((len(rows), n_runs)), axis=1)
        n_faulty = 0 if of_error is None else of_error[ERRORS[0]].shape[1]
        faulty_order = np.argsort(rng.random((len(rows), n_faulty)), axis=1)
        again = np.argsort(rng.random((len(rows), n_runs - (0 if planted else n_now))), axis=1)
        for error in ERRORS:
            runs = np.take_along_axis(pool.sound[name, error][rows], order, axis=1)
            if of_error is None:
                now, rest = runs[:, :n_now], runs[:, n_now:]
            else:
                drawn = np.take_along_axis(of_error[error][rows], faulty_order, axis=1)
                now, rest = drawn[:, :n_now], runs
            others = np.take_along_axis(rest, again, axis=1)
            for baseline, left in (("accepted", rest), ("release", others)):
                then = left[:, :n_then]
                sound = np.isfinite(then).all(axis=1) & np.isfinite(now).all(axis=1)
                found = examine(then[sound], now[sound], rng, _N_DRAWS)
                findings.append(
                    dataclasses.replace(found, estimator=name, error=error, baseline=baseline)
                )
    return judge(findings)


def alarms(
    pool: Pool, n_checks: int, seed: int, fault: tuple[str, str] | None = None
) -> tuple[int, int]:
    """Of drawn checks: how many alarm, and how many of those (also) name the faulty estimator."""
    from joblib import Parallel, delayed

    def one(i: int) -> tuple[bool, bool]:
        axis = "planted" if fault is None else f"planted/{fault[0]}/{fault[1]}"
        found = [f for f in draw_check(pool, stream(seed, axis, i), fault) if f.alarms]
        return bool(found), fault is not None and any(f.estimator == fault[0] for f in found)

    outcomes = Parallel(n_jobs=-1)(delayed(one)(i) for i in range(n_checks))
    return sum(o[0] for o in outcomes), sum(o[1] for o in outcomes)


def smallest(pool: Pool, fault: tuple[str, str]) -> float:
    """Worsening, as a share, that 95 % of checks find of a fault that spreads as this one does.

    Of each error: what the t test over the recordings finds, and of an estimator that draws at
    random what the permutation test finds at a 12th of its level; the best of the errors, by
    the position error's rise that goes with it.
    """
    entry = next(e for e in pool.suite.estimators if e.name == fault[0])
    _, of_error = pool.faulty[fault]
    found = []
    for error in ERRORS:
        then, now = np.log(pool.sound[fault[0], error]), np.log(of_error[error])
        d = now[:, : entry.repeats[1]].mean(axis=1) - then[:, : entry.repeats[0]].mean(axis=1)
        d, n = d[np.isfinite(d)], pool.suite.counts[entry.recordings]
        spread = float(d.std(ddof=1)) / math.sqrt(n)
        least = (stats.t.ppf(1.0 - ALPHA_GENERAL, n - 1) + stats.norm.ppf(0.95)) * spread
        if entry.repeats[0] > 1:
            own = float(np.nanmean(then.var(axis=1, ddof=1)))
            noise = math.sqrt(own * sum(1.0 / count for count in entry.repeats) / n)
            real = stats.norm.ppf(1.0 - ALPHA_REAL / 12.0) * noise
            least = max(least, real + stats.norm.ppf(0.95) * spread)
        rise = float(d.mean())
        if rise > 0.0:
            found.append(least / rise)
    times = min(found, default=math.inf)
    position = worsening(pool.sound[fault[0], ERRORS[0]], of_error[ERRORS[0]])
    return times * position


def power_table(pool: Pool, n_checks: int, on_progress: Callable[[float], None]) -> pd.DataFrame:
    """Each fault: its size, the worsening it makes, and the share of checks that find it."""
    rows = []
    for done, (fault, (size, of_error)) in enumerate(pool.faulty.items(), start=1):
        name, kind = fault
        _, named = alarms(pool, n_checks, 1, fault)
        share = share_interval(named, n_checks)
        rises = {e: worsening(pool.sound[name, e], of_error[e]) for e in ERRORS}
        rows.append(
            {
                "estimator": name,
                "fault": kind,
                "size": size,
                **{f"rise_{error}": rise for error, rise in rises.items()},
                "checks": n_checks,
                "found": share.value,
                "found_low": share.low,
                "found_high": share.high,
                "smallest": smallest(pool, fault),
            }
        )
        on_progress(done / len(pool.faulty))
    return pd.DataFrame(rows)


def run_variant(name: str, suite: Suite) -> pd.DataFrame:
    """Whole run of a suite as equal code may give it, in this process's environment."""
    number = 10 + list(VARIANTS).index(name)
    reorders = VARIANTS[name][1]
    repeats = {entry.name: entry.repeats[1] for entry in suite.estimators}
    planted = dict.fromkeys(repeats, reordered) if reorders else None
    return run_suite(suite, repeats, reseed=number, planted=planted)


def variants(
    suite_name: str, share: float, folder: Path, on_progress: Callable[[float], None]
) -> list[dict[str, Any]]:
    """Whole checks of equal code under other conditions, each in a process of its own."""
    rows = []
    then = {key: read_baseline(path).rows for key, path in baseline_paths(suite_name).items()}
    for done, (name, (environment, _)) in enumerate(VARIANTS.items(), start=1):
        path = folder / f"variant_{done}.parquet"
        if not path.exists():
            command = [sys.executable, "-m", "experiments.gate.faults", "--variant", name]
            command += [
                "--share",
                str(share),
                "--suite",
                suite_name,
                "--folder",
                str(folder),
                "--out",
                str(path),
            ]
            compiled = {"NUMBA_CACHE_DIR": str(folder / f"compiled_{done}")}
            own = {**environment, **(compiled if "NUMBA_CPU_NAME" in environment else {})}
            if environment:  # the last bits of recordings change too
                own["ESTIMA_RESULTS"] = str(folder / f"results_{done}")
            subprocess.run(command, check=True, env={**os.environ, **own})
        rows_now = pd.read_parquet(path)
        known = rows_now["recording"].groupby(rows_now["estimator"]).max()
        of_pool = {  # the pool may hold fewer recordings
            key: rows_then[rows_then["recording"] <= rows_then["estimator"].map(known)]
            for key, rows_then in then.items()
        }
        found = compare(of_pool, rows_now)
        fixed = [f for f in found if f.verdict == "identical"]
        rows.append(
            {
                "variant": name,
                "tests": len(found),
                "identical": len(fixed),
                "largest_change": max((abs(f.ratio - 1.0) for f in fixed), default=0.0),
                "least_p": min((f.p_real[0] for f in found if f not in fixed), default=1.0),
                "alarms": sum(f.alarms for f in found),
            }
        )
        on_progress(done / len(VARIANTS))
    return rows


def measured_text(
    pool: Pool, null: tuple[int, int], power: pd.DataFrame, equal: list[dict[str, Any]]
) -> str:
    """Markdown of what was measured, for docs/regression.md."""
    hits, n_checks = null
    share = share_interval(hits, n_checks)
    counts = ", ".join(
        f"{len(pool.sound[entry.name, ERRORS[0]])} {entry.recordings}"
        for entry in {e.recordings: e for e in pool.suite.estimators}.values()
    )
    lines = [
        f"Pool: {counts} recordings; {_RANDOM} sound seedings of each estimator that draws at "
        f"random, and {_FAULTY_RANDOM} of each of its faults.",
        "",
        f"**False alarms:** {hits} in {n_checks} whole checks drawn from reseeded runs "
        f"({100 * share.value:.2f} %, 95 % interval {100 * share.low:.2f} to "
        f"{100 * share.high:.2f} %; the goal is at most 1 in 200).",
        "",
        "Whole checks of the same code under other conditions, against the tracked baselines "
        "(every estimator reseeded, recordings made anew where the processor's part changes):",
        "",
        "| condition | tests | equal to rounding | largest change of those | least p of the others "
        "| alarms |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in equal:
        lines.append(
            f"| {row['variant']} | {row['tests']} | {row['identical']} | "
            f"{row['largest_change']:.1g} | {row['least_p']:.2g} | {row['alarms']} |"
        )
    lines += [
        "",
        "**Power** at faults graded to a rise of the position error by 10 %, in whole checks "
        f"drawn anew ({power['checks'].iloc[0]} each):",
        "",
        "| estimator | fault | size | position | aligned | heading | found | 95 % found from |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in power.to_dict("records"):
        rises = " | ".join(f"{100 * row[f'rise_{error}']:+.1f} %" for error in ERRORS)
        lines.append(
            f"| {row['estimator']} | {row['fault']} | {row['size']:.3g} | {rises} | "
            f"{100 * row['found']:.1f} % ({100 * row['found_low']:.1f} to "
            f"{100 * row['found_high']:.1f}) | {100 * row['smallest']:.1f} % |"
        )
    lines += [
        "",
        "![The worsening that 95 % of checks find, of each estimator and fault](regression.png)",
    ]
    total, n_found = power["checks"].sum(), (power["found"] * power["checks"]).sum()
    overall = share_interval(round(n_found), int(total))
    low = power[power["found"] < 0.95]
    lines += [
        "",
        f"All faults together: {100 * overall.value:.1f} % found (95 %: {100 * overall.low:.1f} to "
        f"{100 * overall.high:.1f}); {len(power) - len(low)} of {len(power)} faults reach 95 %.",
    ]
    return "\n".join(lines)


def _write_measured(page: Path, text: str) -> None:
    """Put the text between the page's marks."""
    head, _, rest = page.read_text().partition(_BEGIN)
    tail = rest.partition(_END)[2]
    with write_whole(page) as part:
        part.write_text(f"{head}{_BEGIN}\n{text}\n{_END}{tail}")


def main() -> None:
    """Run the experiment, and write its tables, the docs' section, and what each check can find."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.gate.faults",
        description="How often `estima check` alarms wrongly, and how often rightly.",
    )
    parser.add_argument("--suite", default="check")
    parser.add_argument(
        "--share", type=float, default=1.0, help="share of the recordings in the pool (0.1: quick)"
    )
    parser.add_argument("--folder", type=Path, default=results() / "runs" / "planted")
    parser.add_argument("--variant", choices=list(VARIANTS), help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    suite = read_suite(suite_path(given.suite))
    if given.variant:
        run_variant(given.variant, pooled(suite, given.share)).to_parquet(given.out, index=False)
        return
    if not 0.05 <= given.share <= 1.0:
        parser.error("--share must lie in 0.05..1")
    folder: Path = given.folder / f"{Path(given.suite).stem}_{given.share:g}"
    folder.mkdir(parents=True, exist_ok=True)
    n_null, n_power = (4000, 400) if given.share == 1.0 else (4000, 200)
    with progress("faults graded, share", 1.0) as on_progress:
        pool = fill_pool(suite, given.share, folder, on_progress)
    with progress("faults looked for, share", 1.0) as on_progress:
        power = power_table(pool, n_power, on_progress)
    hits, _ = alarms(pool, n_null, 0)
    print(f"{hits} false alarms in {n_null} checks")
    print(power.to_string(index=False))
    write_frame(power, baseline_folder() / "power.csv")
    save_figure(detectable(power, TARGET), SOURCE / "docs" / "regression.png")
    page = SOURCE / "docs" / "regression.md"
    _write_measured(page, measured_text(pool, (hits, n_null), power, []))
    with progress("conditions, share", 1.0) as on_progress:
        equal = variants(given.suite, given.share, folder, on_progress)
    _write_measured(page, measured_text(pool, (hits, n_null), power, equal))
    print(page)


if __name__ == "__main__":
    main()
