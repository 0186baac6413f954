"""Commands on logs: info, convert, calibrate, twin."""

from __future__ import annotations

import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from experiments.cli.flags import ConfigDir, Log, WhichRobot, gathered
from experiments.runs import paths
from experiments.runs.console import read_log, say_choice, show
from sim.errors import require


def info(
    log: Log,
    robot: WhichRobot = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Warn of odd clocks, and of sensors that do not agree with the motion."
        ),
    ] = False,
) -> None:
    """Check a recording or a log and say what it holds.

    Formats of several files take them all; docs/formats.md gives their order. With --check it also
    warns, a line each, of gaps, repeated and coarse stamps, delays between wheels and sensors,
    gains, and ranges of a wrong scale.
    """
    from experiments.viewing.describe import describe
    from sim.formats.detect import read_all

    robots = read_all(log, robot).robots
    if robot is None:
        say_choice(log[0], robots[0], by_flag=True)
    require(len(robots) == 1 or not check, "--check takes one robot; choose it with --robot")
    for number, own in enumerate(robots):
        show(describe(own) if len(robots) == 1 else f"robot {number}\n{describe(own)}\n")
    if check:
        from experiments.calibration.log_check import check_log

        for warning in check_log(robots[0]) or ["nothing is odd"]:
            show(f"check       {warning}")


def solve(
    log: Log,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write.")],
    relations: Annotated[
        Path | None,
        typer.Option(help="Relations to judge the path by; lines of t1 t2 x y z roll pitch yaw."),
    ] = None,
    robot: WhichRobot = None,
    override: Annotated[
        list[str] | None,
        typer.Option("--set", help="Override, such as estimator.kr=1e-3; repeat it."),
    ] = None,
) -> None:
    """Find the path and the map of a log: check it, calibrate its robot, run graph SLAM.

    The folder gets page.html, trajectory.tum, map.yaml and .pgm, recording.npz, calibration.yaml,
    summary.json and summary.csv. Of a log of landmarks with ids the path is EKF-SLAM's. A truth
    that the log has judges the path alone.

    Examples
    --------
      estima solve fr079.log.gz -o fr079

      estima solve fr079.log.gz -o fr079 --relations fr079.relations.gz

      estima solve MRCLAM_Dataset6.tar.xz --robot 3 -o robot3
    """
    from experiments.solve import as_text, solve_log

    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGINT))  # end as by Ctrl-C
    row = solve_log(log, out, relations, robot, override or ())
    show(as_text(row, out))


@dataclass(frozen=True)
class KeptPart:
    """What of a log is converted."""

    truth: Annotated[
        Path | None,
        typer.Option(help="Trajectory to take for the truth: .tum, .csv, .mcap, .bag."),
    ] = None
    from_s: Annotated[
        float | None, typer.Option("--from", help="Where it begins, s after the first Frame.")
    ] = None
    until_s: Annotated[
        float | None, typer.Option("--until", help="Where it ends, s after the first Frame.")
    ] = None


@gathered
def convert(
    log: Log,
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            "-o",
            help="File to write: .npz, .mcap, .bag, .db3, .log (CARMEN), .tum; .yaml of a map.",
        ),
    ],
    robot: WhichRobot = None,
    whole: Annotated[
        bool, typer.Option("--team", help="All robots of an MRCLAM set, in one .npz.")
    ] = False,
    topic: Annotated[
        str | None, typer.Option(help="Of a bag, the nav_msgs/Odometry to convert alone.")
    ] = None,
    *,
    kept: KeptPart,
) -> None:
    """Convert a log to a recording, or a recording or an estimate to a standard file.

    The ending of the output chooses its format; without one it is a folder as `ros2 bag` writes.
    `.tum` holds the reference trajectory of a recording. An estimate (.tum, .csv, or a --topic of a
    bag) becomes .tum, .csv, .json or a bag.

    Examples
    --------
      estima convert fr079.log.gz -o fr079.npz

      estima convert raw.json.gz corrected.json.gz -o intel.mcap

      estima convert MRCLAM_Dataset6.tar.xz --robot 3 -o robot3.npz

      estima convert MRCLAM_Dataset6.tar.xz --team -o team.npz

      estima convert run.mcap --truth reference.tum --from 12 --until 300 -o run.npz

      estima convert estimate.csv -o estimate.tum

      estima convert wean.dat.gz -o wean.yaml
    """
    from experiments.trajectories.convert import convert_log, convert_team
    from experiments.trajectories.part import WHOLE, Part

    part = Part(kept.truth, kept.from_s, kept.until_s)
    if whole:
        require(robot is None, "--team takes all robots; leave out --robot")
        require(part == WHOLE, "--truth, --from and --until are for one robot; leave out --team")
        print(convert_team(log, out))
    else:
        print(convert_log(log, out, robot, topic, part))


@dataclass(frozen=True)
class EndPoses:
    """Alternatives to the wheels' true travel as a reference for calibration."""

    sheet: Annotated[
        Path | None,
        typer.Option(
            help="End poses of open-loop runs, CSV: case, v_mps, omega_radps, duration_s, x_m, "
            "y_m, heading_rad."
        ),
    ] = None
    method: Annotated[
        str | None,
        typer.Option(
            help="wheel-truth, or end-poses (only commands and final poses) (default: wheel-truth)."
        ),
    ] = None


@dataclass(frozen=True)
class RealLog:
    """The calibration of a real log."""

    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Of a real log: YAML file to write, for `estima run calibration=`; a picture of "
            "the residuals goes beside it.",
        ),
    ] = None
    robot: WhichRobot = None
    until_s: Annotated[
        float | None, typer.Option("--until", help="Of a real log: its first seconds only.")
    ] = None


@gathered
def calibrate(
    what: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="RECORDINGS...",
            help="Recordings with truth, .npz. With -o: one log of any format. With --sheet: "
            "overrides of the robot.",
        ),
    ] = None,
    *,
    by: EndPoses,
    real: RealLog,
    joint: Annotated[
        bool, typer.Option("--joint", help="Estimate wheel gains and the track too.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    config_dir: ConfigDir = None,
) -> None:
    """Estimate kr, kl (and wheel gains, track) with 95 % intervals.

    With -o, of a real log: its wheels are compared with its truth, else its scans, else its
    landmarks, and the delay of the wheels, the mount of the sensor and its noise are found too.

    The geometry of a sheet's robot is its nominal one: that which its controller uses.

    Examples
    --------
      estima calibrate run1.npz run2.npz --joint

      estima calibrate --sheet runs.csv robot=puzzlebot --joint

      estima calibrate intel.log.gz -o intel.yaml (a real log)
    """
    from experiments.calibration.files import METHODS, calibrate_files, calibrate_sheet_file
    from experiments.calibration.files import calibrate_log_file as calibrate_log

    if real.out is not None:
        flags: dict[str, object] = {
            "--sheet": by.sheet,
            "--method": by.method,
            "--config-dir": config_dir,
        }
        flags |= {"--joint": joint or None, "--json": as_json or None}
        wrong = next((name for name, value in flags.items() if value is not None), None)
        require(wrong is None, f"{wrong} does not go with a real log; leave it or -o out")
        show(calibrate_log([Path(path) for path in what or []], real.out, real.robot, real.until_s))
        return
    require(
        real.robot is None and real.until_s is None,
        "--robot and --until go with a real log; give -o too",
    )
    require(
        by.method in (None, *METHODS),
        f"--method must be {' or '.join(METHODS)}, got {by.method!r}",
    )
    if by.sheet is not None:
        require(
            by.method != "wheel-truth",
            "--sheet holds end poses only; leave out --method wheel-truth",
        )
        result = calibrate_sheet_file(by.sheet, what or [], config_dir, joint)
    else:
        require(config_dir is None, "--config-dir is for the robot of a --sheet; leave it out")
        result = calibrate_files(what or [], by.method or METHODS[0], joint)
    print(result.as_json() if as_json else result.as_text())


def twin(
    log: Log,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="Study to write, .yaml; its world, way and log go beside it."
        ),
    ],
    robot: WhichRobot = None,
    split_s: Annotated[
        float | None,
        typer.Option(
            "--split", help="Seconds of the log that it is calibrated on (default: half of it)."
        ),
    ] = None,
) -> None:
    """Make a twin of a real log: a simulation of what comes after its first half.

    How the robot slips and its sensors err is found in the first half. The world and the way that
    is driven are the log's. docs/twins.md says what a twin is and what it predicts.

    Examples
    --------
      estima twin fr079.log.gz -o fr079.yaml

      estima run -m study=fr079.yaml estimator=ekf_icp seed="range(0,20)" (what it predicts)

      estima run study=fr079.yaml estimator=ekf_icp recording=fr079_log.npz (what the log shows)
    """
    from experiments.twin.make import make_twin
    from experiments.twin.write import check_name, write_twin

    check_name(out)
    made = make_twin(read_log(log, robot), split_s)
    show(made.found.as_text())
    for path in write_twin(made, out):
        show(paths.short(path))
    show(f"Next: what it predicts: estima run -m study={out} estimator=odometry 'seed=range(0,20)'")
    if made.rest.truth is not None:
        beside = out.with_name(f"{out.stem}_log.npz")
        show(f"      and the log: estima run study={out} estimator=odometry recording={beside}")
