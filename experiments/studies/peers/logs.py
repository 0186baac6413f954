"""Methods of other projects and ours over real logs.

All methods of a log get one recording, one start and one calibration: that of `estima calibrate` by
the log's own scans, or of a log of landmarks by the truth of its first 300 s, which judge nothing.
An error is judged by the log's relations, else by its truth, else by how far beams end from the
walls of its map.
"""

from __future__ import annotations

import dataclasses
import functools
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy import ndimage, optimize

from estimators.base import Estimate, Prior
from experiments.calibration.from_log import calibrate_log, moved_base
from experiments.calibration.reference import names_of
from experiments.evaluation.metrics import (
    LONGEST_GAP_S,
    SCORED_EXTRAS,
    heading_errors_rad,
    nees,
    position_errors_m,
    travelled_m,
    unused_share,
)
from experiments.evaluation.relations import counted, relation_errors
from experiments.evaluation.statistics import block_interval
from experiments.evaluation.time_sync import nearest_rows
from experiments.judging.jobs import Tables
from experiments.judging.logs import (
    CALIBRATED_S,
    DATA,
    calibrate_by_truth,
    intel,
    known_start,
    landmarks,
    relations_of,
    wean_hall,
)
from experiments.runs.calibration import Calibration
from experiments.runs.evaluate import run_over, status_of
from experiments.runs.experiment import Experiment
from experiments.runs.processes import is_interrupt
from experiments.runs.row import Outcome, Row, Status
from experiments.studies.installed import why_absent
from experiments.studies.peers.settings import (
    CAP_M,
    COMPETING,
    LASER,
    MAP,
    MRCLAM_ROBOTS,
    STEREO,
    TOO_DEAR,
    TUNED,
    WEAN_SIGMAS,
    WEAN_STARTS,
    WHEELS,
)
from experiments.studies.peers.version import sensor_of, version_of
from experiments.studies.real_logs.grid_match import beam_points
from experiments.sweeps.averages import MIN_UNITS
from experiments.sweeps.plan import plan_experiments
from sim import se2
from sim.arrays import Array, Ints
from sim.errors import InputError, require
from sim.formats import wean
from sim.formats.relations import Relations
from sim.recording import Recording
from sim.sensors import Laser, StereoCamera
from sim.worlds.grid import OccupancyGrid

RELATIONS, TRUTH, POSES, FIT = "relations", "truth", "reference poses", "fit to the map"
_BLOCK_S, _MIN_BLOCKS = 60.0, 10  # of errors that stay together; of a short log, shorter ones
_RESAMPLES = 20_000
_NEAR_S = 1e-3  # between a scan and the pose at it
_EXPECTED_NEES = 3.0  # of a planar pose


@dataclass(frozen=True)
class Case:
    """A log, what every method is told of it, and what judges them.

    Attributes
    ----------
    recording
        With calibrated wheels and mount.
    calibration
        Whose noise of the wheels is believed.
    prior
        Start, sensors and, of a log with a map, that.
    T_base_judged
        (3,) Frame that is judged, in base_link: the log's, before it was calibrated.
    relations
        Of the log; None without.
    kind
        What judges: one of RELATIONS, TRUTH, POSES and FIT.
    after_s
        Errors before this do not count, s from the first Frame.
    """

    name: str
    recording: Recording
    calibration: Calibration
    prior: Prior
    kind: str
    T_base_judged: Array = dataclasses.field(default_factory=lambda: np.zeros(3))
    relations: Relations | None = None
    after_s: float = 0.0

    @property
    def lasers(self) -> list[str]:
        """Names of the lasers."""
        return names_of(self.recording, Laser)

    @property
    def sensor(self) -> str:
        """Name of the sensor at whose readings poses are judged."""
        return (self.lasers or names_of(self.recording, StereoCamera))[0]

    @property
    def boards(self) -> tuple[str, ...]:
        """What methods may read here."""
        if not self.lasers:
            return WHEELS, STEREO
        return (WHEELS, LASER, MAP) if self.prior.map is not None else (WHEELS, LASER)


# --- the logs ------------------------------------------------------------------------------------


def case_by_scans(
    name: str, logged: Recording, relations: Relations, found: Calibration | None = None
) -> Case:
    """A log with relations, calibrated by its own scans if that is not given."""
    blind = dataclasses.replace(logged, truth=None)
    found = found or calibrate_log(blind).calibration
    calibrated = found.apply_to(blind)
    start = known_start(calibrated, np.zeros(3))
    moved = moved_base(logged, calibrated)
    return Case(name, calibrated, found, start, RELATIONS, moved, relations)


def _mrclam(robot: int) -> Case:
    logged = landmarks(robot, False, True)
    found = calibrate_by_truth(logged)
    recording = found.apply_to(logged)
    start = known_start(recording)
    return Case(f"mrclam {robot}", recording, found, start, TRUTH, after_s=CALIBRATED_S)


def _wean(number: int) -> Case:
    logged = wean_hall(number)
    # corridors hide how far scans are apart, so the wheels' gains and the mount are the log's own
    found = calibrate_log(logged).calibration
    grid = wean.read_grid(DATA / "wean_hall_mcl" / "wean.dat.gz").grid
    mean = _refined(logged, np.array(WEAN_STARTS[number]), grid)
    prior = Prior(logged.robot, logged.sensors, mean, np.diag(np.square(WEAN_SIGMAS)), grid)
    return Case(f"wean {number}", logged, found, prior, FIT)


def _refined(recording: Recording, start: Array, grid: OccupancyGrid) -> Array:
    """The start (3,) near a coarse one from which the scans of the first 3 m fit the map best."""
    scans, laser = recording.log("laser"), recording.sensor("laser", Laser)
    rolled = recording.wheels.at(scans.stamps) - recording.wheels.at(recording.frame_stamps[:1])
    turn = (rolled[:, 0] - rolled[:, 1]) / recording.robot.track_m
    steps = np.diff(rolled.mean(axis=1), prepend=0.0)
    poses = np.stack([np.cumsum(steps * np.cos(turn)), np.cumsum(steps * np.sin(turn)), turn], 1)
    near = travelled_m(poses) < 3.0
    walls = _wall_distance_m(grid)

    def misfit_m(pose: Array) -> float:
        at = se2.compose(pose, poses[near])
        return float(_misfit_m(walls, grid, laser, scans["ranges_m"][near], at).mean())

    steps_of = start + np.vstack([np.zeros(3), np.diag(WEAN_SIGMAS)])
    found = optimize.minimize(
        misfit_m, start, method="Nelder-Mead", options={"initial_simplex": steps_of}
    )
    return np.asarray(found.x)


LOGS: dict[str, Callable[[], Case]] = {
    "intel": lambda: case_by_scans("intel", intel("logged"), relations_of("intel")),
    **{f"wean {n}": functools.partial(_wean, n) for n in WEAN_STARTS},
    **{f"mrclam {robot}": functools.partial(_mrclam, robot) for robot in MRCLAM_ROBOTS},
}


# --- what is judged ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Errors:
    """What of a path was judged.

    Attributes
    ----------
    rows
        (N,) numbers of the relations or readings, the same of all methods of a log.
    stamps
        (N,) s, of the reading, or when the relation begins.
    translation_m, rotation_rad
        (N,) sizes of the errors; no rotation of a fit to the map.
    nees
        Mean over the readings, NaN where not known.
    """

    rows: Ints
    stamps: Array
    translation_m: Array
    rotation_rad: Array | None = None
    nees: float = np.nan


def errors_of(case: Case, path: Estimate) -> Errors:
    """Errors of a path at the readings of the log's sensor.

    Raises
    ------
    InputError
        If nothing of it can be judged.
    """
    readings = case.recording.log(case.sensor).stamps
    at = nearest_rows(path.stamps, readings)
    rows = np.flatnonzero(np.abs(path.stamps[at] - readings) <= _NEAR_S)
    require(len(rows) >= 2, "it has no poses at the readings of the log")
    stamps, means = readings[rows], path.means[at[rows]]
    poses = se2.compose(means, case.T_base_judged)
    if case.relations is not None:
        relations, stamps, poses = counted(case.recording, case.relations, stamps, poses)
        found = relation_errors(relations, stamps, poses)
        begun = relations.stamps[found.rows, 0]
        return Errors(found.rows, begun, found.translation_m, found.rotation_rad)
    after = stamps >= case.recording.frame_stamps[0] + case.after_s
    if case.kind == FIT:
        misfit_m = fit_errors_m(case, rows, poses)
        return Errors(rows[after], stamps[after], misfit_m[after])
    truth = case.recording.truth_at(stamps, LONGEST_GAP_S)
    known = np.flatnonzero(after & np.isfinite(truth).all(axis=1))
    require(len(known) >= 2, "it has no poses where the truth is known")
    squares = nees(truth[known], poses[known], path.covariances[at[rows]][known])
    return Errors(
        rows[known],
        stamps[known],
        position_errors_m(truth[known], poses[known]),
        np.abs(heading_errors_rad(truth[known], poses[known])),
        float(np.nanmean(squares)) if np.isfinite(squares).any() else np.nan,
    )


def fit_errors_m(case: Case, rows: Ints, poses: Array) -> Array:
    """Mean distance (N,) of the beams' ends of scans `rows` at poses (N, 3) from walls, capped."""
    laser, grid = case.recording.sensor(case.sensor, Laser), case.prior.map
    ranges_m = case.recording.log(case.sensor)["ranges_m"][rows]
    return _misfit_m(_wall_distance_m(grid), grid, laser, ranges_m, poses)


def _wall_distance_m(grid: OccupancyGrid) -> Array:
    """Distance (rows, columns) of each cell from the nearest occupied one, m."""
    found = ndimage.distance_transform_edt(~grid.occupied) * grid.resolution_m
    return np.asarray(np.minimum(found, CAP_M))


def _misfit_m(
    walls_m: Array, grid: OccupancyGrid, laser: Laser, ranges_m: Array, poses: Array
) -> Array:
    """Mean distance (S,) of beam ends of scans (S, beams) at poses (S, 3) from walls, m."""
    seen = np.isfinite(ranges_m)
    ends = beam_points(ranges_m.astype(float), laser.bearings_rad, laser.mount.pose, poses)[:, 0]
    in_grid = se2.transform(se2.inverse(grid.origin), ends)
    column, row = np.floor(in_grid / grid.resolution_m).astype(int).T
    inside = (row >= 0) & (column >= 0) & (row < walls_m.shape[0]) & (column < walls_m.shape[1])
    off = np.full(len(ends), CAP_M)
    off[inside] = walls_m[row[inside], column[inside]]
    scan, n = np.nonzero(seen)[0], seen.sum(axis=1)
    sums = np.bincount(scan, off, minlength=len(poses))
    return np.asarray(np.where(n > 0, sums / np.maximum(n, 1), CAP_M))


# --- the methods ---------------------------------------------------------------------------------


def methods_of(case: Case) -> Iterator[Experiment]:
    """Methods of the study that read what the log has, believing its calibrated wheels."""
    slip = case.calibration.slip
    believed = [f"robot.kr={slip.kr}", f"robot.kl={slip.kl}"]
    for one in plan_experiments(["study=peers", "study/board=rooms", "seed=1000", *believed]):
        name = one.estimator_name
        takes_part = one.label("arm") in COMPETING and name.removesuffix(TUNED) not in TOO_DEAR
        if takes_part and sensor_of(name) in case.boards:
            yield one


def over_log(name: str) -> Tables:
    """Rows of all methods on one of `LOGS`."""
    case = LOGS[name]()
    return {"logs": rows_of(case, methods_of(case))}


def rows_of(case: Case, methods: Iterator[Experiment]) -> list[Row]:
    """A row a method and answer, best first by board; `level` with the best of its board.

    The best and another are level unless the bootstrap interval of the difference of their errors,
    over what both are judged by, lies above 0; Bonferroni's share of 5 % counts.
    """
    rows, errors = list[Row](), list[Errors | None]()
    for one in methods:
        for row, found in run_method(case, one):
            rows.append(row)
            errors.append(found)
    table = pd.DataFrame(rows)
    ranked = [
        {**row, **part}
        for (_, _), group in table.groupby(["sensor", "answer"], sort=False)
        for row, part in _ranked([(rows[i], errors[i]) for i in group.index])
    ]
    return sorted(ranked, key=lambda row: (str(row["sensor"]), str(row["answer"])))


def _ranked(board: Sequence[tuple[Row, Errors | None]]) -> Iterator[tuple[Row, dict[str, bool]]]:
    """Rows of a board, the best first, each with whether it is level with the best."""
    able = sorted(
        ((row, found) for row, found in board if found is not None),
        key=lambda pair: float(np.mean(pair[1].translation_m)),
    )
    for row, found in able:
        best = able[0][1]
        _, i, j = np.intersect1d(best.rows, found.rows, return_indices=True)
        level = found is best or not len(i)
        if not level:
            over_m = found.translation_m[j] - best.translation_m[i]
            share = 1.0 - 0.05 / max(len(able) - 1, 1)
            low = _interval(over_m, found.stamps[j], share)[0]
            level = not low > 0.0
        yield row, {"level": level}
    yield from ((row, {"level": False}) for row, found in board if found is None)


def _interval(errors: Array, stamps: Array, share: float = 0.95) -> tuple[float, float]:
    """Ends of the interval of a mean; the whole line of fewer blocks than decide anything."""
    span_s = float(np.ptp(stamps))
    block_s = min(_BLOCK_S, max(span_s / _MIN_BLOCKS, 1e-3))
    if span_s < MIN_UNITS * block_s:
        return -np.inf, np.inf
    found = block_interval(errors, stamps, block_s=block_s, share=share, n_resamples=_RESAMPLES)
    return found.low, found.high


def run_method(case: Case, one: Experiment) -> list[tuple[Row, Errors | None]]:
    """Rows of a method on a log with its errors, one an answer; a failure has one without."""
    name, board = one.estimator_name, sensor_of(one.estimator_name)
    n_readings = len(case.recording.log(case.sensor).stamps)
    row: Row = {
        "log": case.name,
        "sensor": board if board == MAP else (LASER if case.lasers else STEREO),
        "estimator": name,
        "arm": one.label("arm"),
        "answer": "online",
        "project": "",
        "kind": case.kind,
        "n_readings": n_readings,
    }
    if why := why_absent(one):
        return [({**row, "status": "missing", "reason": why}, None)]
    row["project"] = version_of(name)
    try:
        estimator: Any = one.estimator()
        if hasattr(estimator, "forward_slip_m"):
            slip_m = case.calibration.slip.forward_slip_m
            estimator = one.with_estimator(forward_slip_m=slip_m).estimator()
        rng = np.random.default_rng(0)
        online, revised = run_over(case.recording, estimator, case.prior, rng, SCORED_EXTRAS)
        status = status_of(case.recording, online, revised)
    except BaseException as error:
        if is_interrupt(error):
            raise
        status, online, revised = Status.of_error(error), None, None
    row |= {"status": str(status.outcome), "reason": textwrap.shorten(status.detail, 120)}
    if status.outcome is Outcome.FAILED or online is None:
        return [(row, None)]
    unused = unused_share(online)
    row["used_share"] = np.nan if unused is None else 1.0 - unused
    row["cpu_ms"] = 1e3 * (online.cpu_seconds or np.nan) / n_readings
    answers = {"online": online} if revised is None else {"online": online, "revised": revised}
    return [_judged(case, {**row, "answer": said}, path) for said, path in answers.items()]


def _judged(case: Case, row: Row, path: Estimate) -> tuple[Row, Errors | None]:
    """The row with its errors."""
    try:
        found = errors_of(case, path)
    except InputError as error:
        return {**row, "status": str(Outcome.FAILED), "reason": str(error)}, None
    low, high = _interval(found.translation_m, found.stamps)
    turn = np.nan if found.rotation_rad is None else float(found.rotation_rad.mean())
    return {
        **row,
        "n_judged": len(found.rows),
        "error_m": float(found.translation_m.mean()),
        "error_low_m": low,
        "error_high_m": high,
        "error_rad": turn,
        "nees_over_3": found.nees / _EXPECTED_NEES,
    }, found


_COLUMNS = (
    *("log", "sensor", "answer", "estimator", "arm", "project", "kind", "status", "level"),
    *("error_m", "error_low_m", "error_high_m", "error_rad", "nees_over_3"),
    *("used_share", "cpu_ms", "n_judged", "n_readings", "reason"),
)


def ordered(tables: dict[str, pd.DataFrame]) -> dict[str, pd.DataFrame]:
    """The table with its columns in order, infinite ends left out."""
    table = tables["logs"].reindex(columns=list(_COLUMNS))
    return {"logs": table.replace([np.inf, -np.inf], np.nan)}
