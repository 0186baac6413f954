"""One run by the command line: a configuration's rows, in results/runs/NAME/KEY.DIGEST.parquet."""

import math
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean

import numpy as np

from estimators.base import Estimate
from estimators.programs.program import ProgramError
from experiments.runs import paths
from experiments.runs.columns import COLUMNS, DEPENDENCIES, REVISED
from experiments.runs.console import RunFailedError, progress, say_choice, show, warn
from experiments.runs.dependencies.recorder import recorded
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.processes import hold_interrupts
from experiments.runs.row import Outcome, Row
from experiments.runs.store import keep_dependencies, write_run
from experiments.trajectories.convert import write_estimate
from sim.errors import InputError, require
from sim.files import check_writable
from sim.recording import Recording
from sim.team import Team, save

# Of each robot: its recording and its estimate
Draw = Callable[[Sequence[tuple[Recording, Estimate]], Experiment, Path], None]


def run_once(experiment: Experiment, draw: Draw, out: Path | None = None) -> list[Row]:
    """Run an experiment, write its rows, and draw the first repeat.

    Parameters
    ----------
    draw
        Draws the recordings and estimates of an experiment into a folder.
    out
        File of the first repeat's estimate, the revised one if there is one; None for no file.
        It holds one robot.

    Raises
    ------
    RunFailedError
        If a run failed; its row says how.
    """
    folder, name = experiment.rows_folder / experiment.key, experiment.estimator_name
    require(
        out is None or experiment.team is None,
        f"-o {out}: one file holds one robot; the estimates of a team are in the folder of its run",
    )
    found: list[tuple[Recording, Estimate]] = []

    def fetch() -> Team:
        with shown("simulated seconds", expected_duration_s(experiment)) as on_progress:
            read = experiment.recordings(on_progress)
        if experiment.is_read and experiment.team is None:
            say_choice(Path(experiment.config["recording"]), read.only)
        slip = experiment.believed_slip
        if (
            len(read) == 1
            and "source" in read.only.config
            and slip
            and experiment.config["calibration"] is None
        ):
            show(
                f"assumed for this real robot: kr={slip[0]:g} and kl={slip[1]:g} m, and the "
                "geometry that the log's reader assumes; to find its own: "
                "estima calibrate LOG -o cal.yaml, then calibration=cal.yaml"
            )
        if unused := experiment.not_believed:
            show(
                f"{name} has no use for the calibration's {', '.join(unused)}; it takes the "
                "wheels, mounts and noise of sensors from it"
            )
        return read

    def keep(recording: Recording, repeat: int, online: Estimate, revised: Estimate | None) -> None:
        if repeat == 0:
            found.append((recording, online if revised is None else revised))

    with hold_interrupts() as interrupt:

        @contextmanager
        def shown(label: str, total: float | None) -> Iterator[Callable[[float], None]]:
            with progress(label, total) as on_progress:

                def update(done: float) -> None:
                    interrupt()
                    on_progress(done)

                yield update

        with recorded(evaluate.__module__) as seen:
            rows = evaluate(
                experiment,
                fetch,
                shown=lambda read: shown(name, sum(len(r.frame_stamps) for r in read.robots)),
                on_estimate=keep,
                on_error=_trace,
            )
    kept = keep_dependencies(seen.digests(), folder.parent)
    rows = [row | {DEPENDENCIES: kept} for row in rows]
    written = (write_run(rows, folder.parent), folder / "run.png", out)
    if found and out is not None:
        write_estimate(out, found[0][1])
    if found and experiment.config["picture"]:
        _draw(draw, found, experiment, folder)
    _print(rows, [file for file in written if file is not None and file.exists()])
    if found and all(recording.truth is None for recording, _ in found):
        show(
            "  no error: the recording has no true path; `estima convert` adds one from a file, or "
            "`estima score` judges by relations (docs/do/solve.md)"
        )
    for row in rows:
        if row["status"] == Outcome.FAILED:
            raise RunFailedError(f"{row['status_code']}: {row['status_detail']}")
    return rows


def _draw(
    draw: Draw, found: Sequence[tuple[Recording, Estimate]], experiment: Experiment, folder: Path
) -> None:
    """Draw a run whose results are on disk; a picture that fails is a warning."""
    try:
        draw(found, experiment, folder)
    except InputError:  # a full disk, say
        raise
    except Exception as error:
        (folder / "run.png").unlink(missing_ok=True)  # of a run before
        why = " ".join(f"{type(error).__name__}: {error}".split())
        warn(f"estima: the picture is not drawn ({why}); the results are kept")


def expected_duration_s(experiment: Experiment) -> float | None:
    """About how long the simulated drive will be; None if that is not known before."""
    one = experiment.of_robot(0)
    about_s = None if experiment.from_file else getattr(one.route(), "about_s", None)
    return None if about_s is None else round(about_s(one.world(), one.robot()), 1)


def record(experiment: Experiment, out: Path) -> bool:
    """Simulate what an experiment reads, save it and say so; return whether all drives were ok."""
    require(out.suffix == ".npz", f"{out}: a recording is an .npz file")
    check_writable(out)
    with progress("simulated seconds", expected_duration_s(experiment)) as on_progress:
        made = experiment.simulate_team(on_progress)
    checksum = save(made, out)
    drives = [f"{robot.status}, {robot.duration_s:.1f} s" for robot in made.robots]
    if experiment.team is not None:
        drives = [f"robot {number}: {drive}" for number, drive in enumerate(drives)]
    show(f"{out}: {'; '.join(drives)}, checksum {checksum}")
    return all(robot.status == "ok" for robot in made.robots)


def _trace(error: BaseException) -> None:
    """Print where an error came from, unless it is a program's, whose own message says so."""
    if not isinstance(error, ProgramError):
        traceback.print_exception(error)


_SHOWN = (
    "distance_m",
    "ate_rmse_m",
    "heading_rmse_rad",
    "final_position_error_m",
    "nees_mean",
    "revised_ate_rmse_m",
    "step_time_us",
    "cpu_time_us",
)


_SUMMARIZED = ("distance_m", "ate_rmse_m", "nees_mean")  # by `summarize`
_REVISED_ERROR = f"{REVISED}ate_rmse_m"
_CONSISTENT = (1.5, 6.0)  # mean NEES of a run, half and twice the expected
_CONSISTENCY = ("too cautious", "consistent", "too sure of itself")
_DOF = 3
_ALL = 0.99  # share of poses with a covariance, below which it is said


def _print(rows: Sequence[Row], files: Sequence[Path]) -> None:
    first = rows[0]
    where = first.get("choice.world") or first.get("recording") or "a recording"
    where = f"{where}, {first['team.size']} robots" if "team.size" in first else where
    failed = [row for row in rows if row["status"] == Outcome.FAILED]
    sound = [row for row in rows if row["status"] != Outcome.FAILED]
    status = ", with a remark" if first["status"] == Outcome.REMARK else ""
    if failed:
        how_many = f"{len(failed)} of {len(rows)} repeats " if len(rows) > 1 else ""
        status = f": {how_many}failed, {failed[0]['status_detail']}"
    show(f"{first['choice.estimator']} on {where}, seed {first['seed']}{status}")
    if words := summarize(sound):
        show(f"  {words}")
    if first.get("stamps_left_out"):
        scored, left_out = first["stamps_scored"], first["stamps_left_out"]
        show(f"  scored at {scored:.0f} frames; {left_out:.0f} others have no true pose")
    said = () if not words or any(_REVISED_ERROR in row for row in sound) else _SUMMARIZED
    for name in (name for name in _SHOWN if name not in said):
        values = [float(v) for row in sound if isinstance(v := row.get(name), (int, float))]
        if values:
            column, mean = COLUMNS[name], fmean(values)
            show(f"  {column.label:<30} {mean:10.4g} {column.unit}")
    for path in files:
        show(f"  {paths.short(path)}")
    if first["status"] == Outcome.REMARK:
        show(f"  remark: {first['status_detail']}")


def summarize(rows: Sequence[Row]) -> str:
    """What came out, in a sentence; errors over repeats are pooled by squares."""

    def mean(name: str, power: int = 1) -> float:
        every = [row.get(f"{REVISED}{name}", row.get(name)) for row in rows]
        powers = [float(v) ** power for v in every if isinstance(v, (int, float))]
        return float(fmean(powers) ** (1.0 / power)) if powers else math.nan

    error_m = mean("ate_rmse_m", power=2)
    distance_m, nees = mean("distance_m"), mean("nees_mean")
    if not math.isfinite(error_m):
        return ""
    revised = any(_REVISED_ERROR in row for row in rows)
    words = f"{'revised path: ' if revised else ''}position RMSE {error_m:.3g} m"
    if distance_m > 0.0:
        words += f", {100.0 * error_m / distance_m:.2g} % of {distance_m:.3g} m"
    if math.isfinite(nees):
        kind = _CONSISTENCY[int(np.searchsorted(_CONSISTENT, nees))]
        share = mean("nees_counted_share")
        of_some = "" if not share < _ALL else f", by {100.0 * share:.2g} % of the poses"
        words += f"; {kind} (NEES {nees:.2g} of {_DOF}{of_some})"
    return words
