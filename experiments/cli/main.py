"""The command `estima`. Heavy libraries are imported inside the commands, so that help is quick."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from experiments.cli import completion
from experiments.runs import columns, paths
from experiments.runs.console import counted, end, progress, show
from experiments.runs.row import Outcome, write_frame
from experiments.runs.version import code_version
from sim.errors import InputError, require

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pandas import DataFrame

    from estimators.base import Estimate
    from experiments.runs.experiment import Experiment
    from experiments.sweeps.again import Again
    from sim.recording import Recording
    from sim.robot.drive import DifferentialDrive

app = typer.Typer(
    help="Estima: simulate differential-drive robots, run localization on the same recordings, "
    "sweep parameters, and judge the papers' claims.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)

_PASS_ON = {
    "allow_extra_args": True,
    "ignore_unknown_options": True,
    "help_option_names": ["-h", "--help"],
}
Overrides = Annotated[
    list[str] | None,
    typer.Argument(
        help="Hydra overrides, such as world=office seed=3.",
        autocompletion=completion.overrides,
    ),
]
ConfigDir = Annotated[
    Path | None, typer.Option("--config-dir", "-cd", help="Folder with options of your own.")
]

WhichRobot = Annotated[
    int | None,
    typer.Option(
        help="Which robot of an MRCLAM set (from 1; default: 1), or of a team's file (from 0)."
    ),
]


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"estima {version('estima')}, code {code_version()}")
        raise typer.Exit


@app.callback()
def options_of_all(
    results: Annotated[
        Path | None,
        typer.Option(
            "--results",
            envvar="ESTIMA_RESULTS",
            file_okay=False,
            help="Folder of results; `results` unless set. Before or after the command's name.",
        ),
    ] = None,
    _: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Options of all commands."""
    if results is not None:
        os.environ["ESTIMA_RESULTS"] = str(results.absolute())


@app.command(context_settings=_PASS_ON)
def run(
    context: typer.Context,
    overrides: Overrides = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="File of the estimate to write too: .tum, .csv, .json, .mcap, .bag."
        ),
    ] = None,
) -> None:
    """Make or read a recording, run an estimator over it, and write its row of results.

    With -o it also writes the estimate, the revised one of an estimator that has it. The other
    arguments are Hydra's: `group=option`, `key=value`, `-m` for a sweep over values.

    Examples
    --------
      estima run (a first look: study=first_run)

      estima run estimator=odometry world=office seed=3

      estima run robot.kr=1e-4 estimator.kr=1e-5 (truth and belief apart)

      estima run estimator=ekf_icp sensors=hokuyo -o est.tum

      estima run -m robot.kr=1e-5,1e-4 seed="range(0,5)"

      estima run --config-dir mine estimator=mine (your own estimator)

      estima run --cfg job (print the configuration; estima options lists the groups)
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors come to `main`, which puts them in a line
    arguments = [*(overrides or []), *context.args]
    many = {"-m", "--multirun"} & set(arguments)
    shown = {"--cfg", "-c", "--info", "-i"} & set(arguments)
    if many and shown:
        raise InputError(f"{shown.pop()} shows one configuration; leave out -m and the lists")
    if out is not None:
        from experiments.trajectories.convert import check_estimate_name

        require(not many, f"-o {out}: one file is of one run; leave out -m")
        check_estimate_name(out)
    if many and "--hydra-help" not in arguments:
        from experiments.sweeps.launch import sweep_arguments

        sweep_arguments([a for a in arguments if a not in many], _show_sweep)
        return
    if not arguments:
        arguments = ["study=first_run"]
        print("estima run study=first_run (estima options lists what else there is)")
    from experiments.runs.run import application

    application(arguments, _draw_run, out)


_FEW_RUNS, _FEW_LINES = 2000, 30


def _show_sweep(folder: Path, n_runs: int) -> None:
    """Print a sweep's small table, and what can be done next."""
    from experiments.report.table import as_lines, notes, statuses
    from experiments.sweeps.collect import collect
    from experiments.sweeps.summary import ERROR, summary

    against = ""
    if n_runs <= _FEW_RUNS:
        rows = collect(str(folder))
        if (rows["status"] == Outcome.FAILED).all():
            (why, count), *_ = statuses(rows)
            reason = why.removeprefix("failed: ")
            often = f"All {len(rows)} runs failed, most often ({count}) so"
            show(f"{often if len(rows) > 1 else 'The run failed'}: {reason}")
            print(f"\nNext: estima table {folder.name} --rows -o rows.csv  (how each run ended)")
            return
        found = summary(rows, metrics=[ERROR] if "ate_rmse_m" in rows else [])
        if len(found) <= _FEW_LINES:
            show(as_lines(found, notes(found, None)))
        sound = rows[rows["status"] != Outcome.FAILED]
        estimators = sound["choice.estimator"].unique()
        against = f" --against {estimators[0]}" if len(estimators) > 1 else ""
    print(f"\nNext: estima table {folder.name}{against} -o table.tex")
    print(f"      estima plot {folder.name}")
    print(f"      estima report {folder.name}")


def _draw_run(
    found: Sequence[tuple[Recording, Estimate]], experiment: Experiment, folder: Path
) -> None:
    """Write the picture of a single run, and the trajectory of each of its robots."""
    from experiments.trajectories.convert import write_estimate
    from experiments.viewing.run_figure import figure_of
    from experiments.viewing.style import save_figure

    for number, (recording, estimate) in enumerate(found):
        name = "estimate.csv" if len(found) == 1 else f"estimate_{number}.csv"
        write_estimate(folder / name, estimate, recording, slip=experiment.believed_slip)
    revised = " (revised)" if found[0][1].kind == "revised" else ""
    save_figure(figure_of(found, f"{experiment.estimator_name}{revised}"), folder / "run.png")


@app.command()
def record(
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write, .npz.")],
    overrides: Overrides = None,
    config_dir: ConfigDir = None,
) -> None:
    """Simulate a recording and save it.

    Example: estima record -o office.npz world=office sensors=lms291 seed=3
    """
    from experiments.runs.experiment import Experiment, searched
    from experiments.runs.run import expected_s
    from experiments.runs.team import TeamExperiment
    from sim import recording, team

    if out.suffix != ".npz":
        raise InputError(f"-o {out}: a recording is an .npz file")
    experiment = Experiment.compose([*searched(config_dir), *(overrides or [])])
    with progress("simulated seconds", expected_s(experiment)) as on_progress:
        if experiment.team is None:
            made = experiment.simulate(on_progress)
            robots, checksum = {"": made}, recording.save(made, out)
        else:
            several = TeamExperiment(experiment).record(on_progress)
            robots = {f"robot {n}: ": robot for n, robot in enumerate(several.robots)}
            checksum = team.save(several, out)
    said = [f"{whose}{robot.status}, {robot.duration_s:.1f} s" for whose, robot in robots.items()]
    print(f"{out}: {'; '.join(said)}, checksum {checksum}")
    if any(robot.status != "ok" for robot in robots.values()):
        raise typer.Exit(1)


@app.command()
def info(
    log: Annotated[list[Path], typer.Argument(help="A recording (.npz) or a log of any format.")],
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
    from sim.team import Team

    recording = read_all(log, robot)
    if isinstance(recording, Team):
        require(not check, "--check is of one robot; name it by --robot")
        for number, own in enumerate(recording.robots):
            show(f"robot {number}\n{describe(own)}\n")
        return
    show(describe(recording))
    if check:
        from experiments.calibration.log_check import check_log

        warnings = check_log(recording)
        for warning in warnings or ["nothing odd found"]:
            show(f"check       {warning}")


@app.command()
def convert(
    log: Annotated[list[Path], typer.Argument(help="A recording (.npz) or a log of any format.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="File to write: .npz, .mcap, .bag, .db3, .log (CARMEN), .tum."
        ),
    ],
    robot: WhichRobot = None,
    whole: Annotated[
        bool, typer.Option("--team", help="All robots of an MRCLAM set, in one .npz.")
    ] = False,
    topic: Annotated[
        str | None, typer.Option(help="Of a bag, the nav_msgs/Odometry to convert alone.")
    ] = None,
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

      estima convert estimate.csv -o estimate.tum
    """
    from experiments.trajectories.convert import is_estimate, write_estimate, write_recording
    from sim.formats.detect import kind_of, read_any
    from sim.formats.mrclam import read_team
    from sim.team import save

    if not out.name:
        raise InputError(f"-o {out}: name the file to write, such as run.mcap")
    if out.exists() and any(path.exists() and out.samefile(path) for path in log):
        raise InputError(f"-o {out}: that is the log itself; give another name")
    if topic is not None or is_estimate(log):
        from experiments.trajectories.read import read_trajectory

        require(len(log) == 1, f"{log[0]}: an estimate is one file, got {len(log)}")
        estimate = read_trajectory(log[0], topic)
        write_estimate(out, estimate)
        print(
            f"{out}: {len(estimate.stamps)} poses, {estimate.stamps[-1] - estimate.stamps[0]:.1f} s"
        )
        return
    if whole:
        require(robot is None, "--team takes all robots; leave out --robot")
        require(out.suffix == ".npz", f"-o {out}: a team is an .npz file")
        require(
            len(log) == 1 and kind_of(log[0]) == "mrclam",
            f"{log[0]}: --team is of MRCLAM sets; `estima record study=teams` simulates a team",
        )
        team = read_team(log[0])
        print(f"{out}: a team of {len(team)} robots, {team.duration_s:.1f} s, {save(team, out)}")
        return
    recording = read_any(log, robot)
    write_recording(out, recording)
    print(f"{out}: {recording.duration_s:.1f} s, {len(recording.frame_stamps)} frames")
    dropped = [name for name in recording.logs if name != "laser"] if out.suffix == ".log" else []
    if dropped:
        print(f"left out, since a CARMEN log holds one laser: {', '.join(dropped)}")


@app.command()
def options(
    group: Annotated[
        str | None,
        typer.Argument(
            help="world, robot, ..., study; or metrics.", autocompletion=completion.groups
        ),
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """List the configuration groups and their options, or the metrics of a run.

    Examples
    --------
      estima options estimator

      estima options metrics
    """
    groups = completion.GROUPS
    if group == "metrics":
        show(columns.as_text())
        return
    if config_dir is not None and not config_dir.is_dir():
        raise InputError(f"--config-dir must name a folder, got {config_dir}")
    if group not in (None, *groups):
        raise InputError(f"no group {group}; there are: {', '.join(groups)}, metrics")
    for name in groups if group is None else (group,):
        folders = [paths.CONF, *([config_dir] if config_dir else [])]
        names = sorted({n for folder in folders for n in paths.option_names(name, folder)})
        print(f"{name:>10}: {', '.join(names)}")


@app.command()
def view(
    what: Annotated[
        list[str] | None,
        typer.Argument(
            help="A recording or a log of any format, then Hydra overrides; or a sweep's NAME/KEY."
        ),
    ] = None,
    estimate: Annotated[
        str | None,
        typer.Option(
            "--estimate",
            "-e",
            help="A trajectory (.csv, .tum, .mcap), a run's folder, or an estimator to run now.",
            autocompletion=completion.estimators,
        ),
    ] = None,
    world: Annotated[
        bool, typer.Option("--world", help="Draw the world of the overrides instead.")
    ] = False,
    grid: Annotated[
        Path | None,
        typer.Option("--map", help="An occupancy grid (.yaml) to draw underneath, or alone."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File to write: .mp4, .gif, .html; a world or map: .png."),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(help="Duration (default: real time; of a drive over 70 s in a file, 20)."),
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """Show a run as an animation, in a window or in a file; or draw a world or a map.

    It shows robot, scan, particles or landmarks, truth and estimate. Without -o it opens a window.
    A run of a sweep is called by the first digits of its key, as `estima report NAME` gives them.

    Examples
    --------
      estima view run.npz

      estima view run.npz --estimate fastslam -o run.html

      estima view run.npz --estimate mcl prior.map=world estimator.n_most=2000 -o run.mp4

      estima view --world world=office seed=3 -o office.png

      estima view run.npz -e ekf_icp --map map.yaml -o run.html

      estima view slip/1f0c33ab -o run.html (a run of the sweep slip)

      estima view --map map.yaml -o map.png
    """
    from experiments.runs.experiment import searched
    from experiments.sweeps.again import noted_config_dir, row_of, run_again
    from experiments.sweeps.collect import folder_of

    if world and grid is not None:
        raise InputError("--world and --map: draw one at a time")
    if grid is not None and not what:
        _draw_map(grid, out or Path("map.png"))
        return
    if world:
        _draw_world([*searched(config_dir), *(what or [])], out or Path("world.png"))
        return
    if not what or "=" in what[0]:
        raise InputError("name a recording to view, such as run.npz, or say --world")
    if seconds is not None and not 0.0 < seconds <= 3600.0:
        raise InputError(f"--seconds must lie between 0 and 3600, got {seconds:g}")
    if not Path(what[0]).exists() and (row := row_of(what[0])) is not None:
        require(
            estimate is None and len(what) == 1,
            f"{what[0]}: a run of a sweep has its estimator and its settings; leave out others",
        )
        noted = noted_config_dir(folder_of(str(Path(what[0]).parent)))
        _show_run(run_again(row, config_dir, noted), None, [], out, seconds, grid, what[0])
        return
    if estimate is None and len(what) > 1:
        raise InputError(f"{what[1]}: overrides need an estimator; add --estimate NAME")
    overrides = [*searched(config_dir), *what[1:]]
    _show_run(Path(what[0]), estimate, overrides, out, seconds, grid, Path(what[0]).name)


def _draw_world(overrides: list[str], out: Path) -> None:
    from experiments.runs.experiment import Experiment
    from experiments.viewing.style import save_figure
    from experiments.viewing.world import world_figure

    given = [f"world={o}" if "=" not in o else o for o in overrides]
    save_figure(world_figure(Experiment.compose(given).world()), out)
    print(out)


def _draw_map(path: Path, out: Path) -> None:
    from experiments.viewing.grid import grid_figure
    from experiments.viewing.style import save_figure
    from sim.worlds.grid_file import read_grid

    save_figure(grid_figure(read_grid(path), path.stem), out)
    print(out)


def _show_run(
    what: Path | Again,
    source: str | None,
    overrides: list[str],
    out: Path | None,
    seconds: float | None,
    grid: Path | None,
    called: str,
) -> None:
    from dataclasses import replace

    from experiments.runs.team import TeamExperiment
    from experiments.viewing import live, team_view, view
    from sim.formats.detect import read_all
    from sim.team import Team
    from sim.worlds.grid_file import read_grid

    if out is None and grid is not None:
        raise InputError("--map is drawn in files only; add -o run.html, run.gif or run.mp4")
    if out is not None:
        view.check_output(out)
    known = None if grid is None else read_grid(grid)
    again = None if isinstance(what, Path) else what
    read = read_all([what]) if isinstance(what, Path) else what.recording()
    name = source if again is None else again.experiment.estimator_name
    if isinstance(read, Team):
        require(out is not None, "a team is drawn in files; add -o team.html, .gif or .mp4")
    elif out is None:
        live.check_display()
    drive_s = read.duration_s
    in_real_time = out is None or drive_s <= view.REAL_TIME_S
    length_s = seconds or (drive_s if in_real_time else view.SECONDS)
    n_shown = int(length_s * (live.FPS if out is None else view.FPS))
    if out is not None and seconds is None:
        n_shown = min(n_shown, view.MOST_PICTURES)
    if isinstance(read, Team):
        several = team_view.TeamPlayback.of(read, n_shown)
        if name is not None:
            with progress(name, sum(len(r.frame_stamps) for r in read.robots)) as on_step:
                if again is None:
                    several = team_view.with_estimates(several, read, name, overrides, on_step)
                else:
                    team = TeamExperiment(again.experiment)
                    answers = team.run(read, again.repeat, on_step=on_step)
                    several = several.beside([online for online, _ in answers], name)
        several = replace(several, grid=known, seconds=length_s)
        run: view.Played = several
        images = team_view.pictures(several)
    else:
        rows = view.shown_rows(read, n_shown)
        shown = view.Playback(read, rows)
        if name is not None:
            with progress(name, len(read.frame_stamps)) as on_step:
                if again is None:
                    found = view.estimate_of(read, name, overrides, rows, on_step)
                else:
                    experiment, repeat = again.experiment, again.repeat
                    found = view.estimate_by(experiment, read, rows, on_step, repeat), name
            shown = view.Playback(read, rows, *found)
        if out is None:
            live.watch(shown, seconds)
            return
        run = shown = replace(shown, grid=known, seconds=length_s)
        images = view.pictures(shown)
    assert out is not None
    with progress(f"drawing {out.name}", 1.0) as on_progress:
        title = f"{Path(name).name}: {called}" if name is not None else called
        view.save(run, images, out, on_progress, title)
    said = f"{len(run.stamps)} pictures, {length_s:.1f} s, {view.speed(run)}"
    print(f"{paths.short(out)}: {said}")


@app.command("map")
def build_map(
    what: Annotated[
        list[str],
        typer.Argument(help="A recording or a log of any format, then Hydra overrides."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write, .yaml; beside it .pgm.")],
    estimate: Annotated[
        str,
        typer.Option(
            "--estimate",
            "-e",
            help="truth, a trajectory (.csv, .tum), a run's folder, or an estimator to run now.",
            autocompletion=completion.estimators,
        ),
    ] = "truth",
    resolution_m: Annotated[float, typer.Option("--resolution", help="Side of a cell, m.")] = 0.05,
    max_range_m: Annotated[
        float | None,
        typer.Option(
            "--max-range",
            help="Beams longer than this only clear cells; metres (default: the laser's range).",
        ),
    ] = None,
    raw: Annotated[
        bool,
        typer.Option("--raw", help="Keep probabilities in percent (mode raw), not three states."),
    ] = False,
    laser: Annotated[str, typer.Option(help="Name of the laser in the recording.")] = "laser",
    config_dir: ConfigDir = None,
) -> None:
    """Build an occupancy grid from a recording's laser scans and any estimate of its path.

    The files are those of ROS's map server. An estimator with a revised path gives that one.

    Examples
    --------
      estima map run.npz -e ekf_icp -o map.yaml

      estima map fr079.log.gz -e truth -o fr079.yaml --max-range 20

      estima run world=office seed=3 sensors=lms291 estimator=mcl prior.map=map.yaml
    """
    from experiments.runs.experiment import searched
    from experiments.viewing.grid import described
    from experiments.viewing.map import grid_along, laser_scans, path_of
    from sim.formats.detect import read_any
    from sim.worlds.grid_file import check_name, write_grid

    check_name(out)
    if "=" in what[0]:
        raise InputError(f"{what[0]}: name a recording first, such as run.npz")
    recording = read_any([Path(what[0])])
    n_all = len(laser_scans(recording, laser)[0])
    with progress(estimate, len(recording.frame_stamps)) as on_step:
        overrides = [*searched(config_dir), *what[1:]]
        stamps, poses = path_of(recording, estimate, overrides, on_step)
    with progress("mapping", n_all, "scans") as on_progress:
        grid, n_scans = grid_along(
            recording,
            stamps,
            poses,
            resolution_m=resolution_m,
            max_range_m=max_range_m,
            laser=laser,
            on_progress=on_progress,
        )
    write_grid(grid, out, "raw" if raw else "trinary")
    print(f"{out}: {described(grid)}, from {n_scans} of {n_all} scans")


Topic = Annotated[
    str | None, typer.Option(help="Of a bag, the nav_msgs/Odometry to read (default: estimate).")
]
AlignBy = Annotated[
    str, typer.Option("--align", help="Move it first: none, start (first pose), or se2.")
]
MatchBy = Annotated[
    str,
    typer.Option(
        "--match",
        help="True poses: interpolated at its stamps, or nearest (as evo associates).",
    ),
]
Tolerance = Annotated[
    float, typer.Option("--tolerance", help="Greatest difference of nearest stamps, s.")
]
Offset = Annotated[float, typer.Option("--offset", help="Added to the trajectory's stamps, s.")]


@app.command()
def score(
    recording: Annotated[Path, typer.Argument(help="A recording (.npz) or a log with its truth.")],
    trajectories: Annotated[
        list[Path],
        typer.Argument(help="What programs made of it: .tum, .csv of ours, .mcap, .bag."),
    ],
    align: AlignBy = "none",
    match: MatchBy = "interpolated",
    tolerance_s: Tolerance = 0.01,
    offset_s: Offset = 0.0,
    revised: Annotated[
        bool, typer.Option("--revised", help="They are revised paths, not online ones.")
    ] = False,
    cpu_seconds: Annotated[
        float | None, typer.Option(help="Processor time that making the trajectory took, s.")
    ] = None,
    topic: Topic = None,
    estimator: Annotated[
        str | None,
        typer.Option("--as", help="Name of the estimator in the row (default: the file's)."),
    ] = None,
    name: Annotated[str, typer.Option(help="Folder of the rows in results/runs.")] = "score",
    as_json: Annotated[bool, typer.Option("--json", help="Print the rows as JSON.")] = False,
) -> None:
    """Score trajectories of any program against a recording's truth, and write their rows.

    It says what was scored, and the statistics that evo_ape and evo_rpe (pairs from the reference)
    print. The rows are like those of `estima run`: `estima table` and `estima plot` take them.

    Examples
    --------
      estima score run.npz mine.tum

      estima score run.npz theirs.mcap --topic odometry/filtered --align start --as their_filter

      estima score run.npz batch.tum --revised --cpu-seconds 2.5 --name leaderboard
    """
    import json

    from experiments.runs.score import as_scoring, as_text, score_files

    how = as_scoring(
        align=align,
        match=match,
        tolerance_s=tolerance_s,
        offset_s=offset_s,
        revised=revised,
        cpu_seconds=cpu_seconds,
    )
    results = score_files(recording, trajectories, how, topic=topic, estimator=estimator, name=name)
    if as_json:
        print(json.dumps([row for _, row, _ in results], indent=2))
        return
    for path, _, scored in results:
        show(f"{path}\n{as_text(scored, how)}")
    print(f"rows: estima table {name}")


@app.command()
def compare(
    trajectories: Annotated[list[Path], typer.Argument(help="Trajectories of one drive.")],
    recording: Annotated[
        Path | None,
        typer.Option(help="Recording with the truth; without it the first is the reference."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Picture to write.")] = Path(
        "compare.png"
    ),
    align: AlignBy = "none",
    match: MatchBy = "interpolated",
    tolerance_s: Tolerance = 0.01,
    offset_s: Offset = 0.0,
    topic: Topic = None,
) -> None:
    """Draw trajectories over one another with their errors over time, and print a table.

    Examples
    --------
      estima compare mine.tum theirs.mcap --recording run.npz -o both.png

      estima compare reference.tum mine.tum --align se2
    """
    from experiments.runs.score import as_scoring
    from experiments.viewing.compare import compare_files

    how = as_scoring(align=align, match=match, tolerance_s=tolerance_s, offset_s=offset_s)
    table = compare_files(trajectories, recording, out, how, topic)
    show(table.to_string(index=False, na_rep="-", float_format=lambda v: f"{v:.4g}"))
    print(out)


@app.command()
def calibrate(
    what: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="RECORDINGS...",
            help="Recordings with truth, .npz. With -o: one log of any format. With --sheet: "
            "overrides of the robot.",
        ),
    ] = None,
    sheet: Annotated[
        Path | None,
        typer.Option(
            help="End poses of open-loop runs, CSV: case, v_mps, omega_radps, duration_s, x_m, "
            "y_m, heading_rad."
        ),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="wheel-truth, or end-poses (only commands and final poses) (default: wheel-truth)."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Of a real log: YAML file to write, for `estima run calibration=`; a picture of "
            "the residuals goes beside it.",
        ),
    ] = None,
    robot: WhichRobot = None,
    until_s: Annotated[
        float | None, typer.Option("--until", help="Of a real log: its first seconds only.")
    ] = None,
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
    import numpy as np

    from experiments.calibration.calibrate import calibrate_recordings
    from experiments.calibration.sheet import calibrate_sheet
    from sim.recording import load

    if out is not None:
        others = {"--sheet": sheet, "--method": method, "--config-dir": config_dir}
        given = {**others, "--joint": joint or None, "--json": as_json or None}
        for option in (name for name, value in given.items() if value is not None):
            raise InputError(f"{option} is not of a real log; leave it or -o out")
        _calibrate_log([Path(path) for path in what or []], out, robot, until_s)
        return
    require(robot is None and until_s is None, "--robot and --until are of a real log; give -o too")
    if method not in (None, "wheel-truth", "end-poses"):
        raise InputError(f"--method must be wheel-truth or end-poses, got {method!r}")
    if sheet is not None:
        if method == "wheel-truth":
            raise InputError("--sheet holds end poses only; leave out --method wheel-truth")
        result = calibrate_sheet(
            sheet, _robot_of(what or [], config_dir), np.random.default_rng(0), geometry=joint
        )
    else:
        if config_dir is not None:
            raise InputError("--config-dir is for the robot of a --sheet; leave it out")
        loaded = [load(Path(path)) for path in what or []]
        first: dict[str, str] = {}
        for path, recording in zip(what or [], loaded, strict=True):
            if recording.checksum in first:
                raise InputError(f"{path} is the same recording as {first[recording.checksum]}")
            first[recording.checksum] = path
        kind: Any = (method or "wheel-truth").replace("-", "_")
        result = calibrate_recordings(loaded, kind, geometry=joint)
    print(result.as_json() if as_json else result.as_text())


def _calibrate_log(log: list[Path], out: Path, robot: int | None, until_s: float | None) -> None:
    """Calibrate a real log, and write its YAML file and its picture."""
    from experiments.calibration.from_log import calibrate_log
    from experiments.calibration.residual_figure import residual_figure
    from experiments.runs.calibration import write_calibration
    from experiments.viewing.style import save_figure
    from sim.formats.detect import read_any

    require(log, "no log to calibrate; name one")
    require(out.suffix in (".yaml", ".yml"), f"-o {out}: a calibration is a .yaml file")
    found = calibrate_log(read_any(log, robot), until_s)
    show(found.as_text())
    intervals = {name: [x.low, x.high] for name, x in found.intervals.items()}
    write_calibration(out, found.calibration, intervals)
    save_figure(residual_figure(found.residuals), out.with_suffix(".png"))
    show(f"{out}, {out.with_suffix('.png')}")


@app.command()
def twin(
    log: Annotated[list[Path], typer.Argument(help="A recording (.npz) or a log of any format.")],
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
    from sim.formats.detect import read_any

    check_name(out)
    made = make_twin(read_any(log, robot), split_s)
    show(made.found.as_text())
    for path in write_twin(made, out):
        show(paths.short(path))
    show(f"Next: what it predicts: estima run -m study={out} estimator=odometry 'seed=range(0,20)'")
    if made.rest.truth is not None:
        beside = out.with_name(f"{out.stem}_log.npz")
        show(f"      and the log: estima run study={out} estimator=odometry recording={beside}")


def _robot_of(overrides: list[str], config_dir: Path | None) -> DifferentialDrive:
    """Make the robot that overrides choose; they may say nothing else."""
    from experiments.runs.experiment import Experiment, searched

    for override in overrides:
        if not override.lstrip("+~").startswith(("robot=", "robot.")):
            raise InputError(
                f"{override}: with --sheet give the robot alone, such as robot=puzzlebot or "
                "robot.track_m=0.19"
            )
    return Experiment.compose([*searched(config_dir), *overrides]).robot()


@app.command()
def tune(
    study: Annotated[
        str,
        typer.Argument(
            help="A study of conf/study that has a tune.", autocompletion=completion.studies
        ),
    ],
    only: Annotated[list[str] | None, typer.Option(help="Only this estimator; repeat it.")] = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", help="Processes.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder of the YAMLs (default: results/tuned/estimator)."),
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """Tune a study's estimators on seeds below 100, with one budget, and judge them on its own.

    The trials are kept, so that the command goes on where it was interrupted. It writes
    ESTIMATOR_tuned.yaml, tables of trials and gains, and their figure.

    Examples
    --------
      estima tune peers --jobs 2

      estima run --config-dir results/tuned estimator=ekf_icp_tuned sensors=hokuyo
    """
    from experiments.sweeps import tune as tuning
    from experiments.viewing.style import save_figure

    folder = str(config_dir) if config_dir else None
    plan, place = tuning.tuning_of(study, folder), paths.results()
    found, written = [], []
    with progress(f"tune {study}", 1.0) as on_progress:
        for tuned in tuning.tune(
            study, only or (), jobs=jobs, config_dir=folder, on_progress=on_progress
        ):
            found.append(tuned)
            written.append(tuning.write(tuned, study, plan, out or place / "tuned" / "estimator"))
    tables = place / "tables"
    trials, gains = (
        tuning.written_beside(table, tables / f"{study}_{name}.csv", plan)
        for table, name in (
            (tuning.trials_table(found), "trials_tuning"),
            (tuning.gains_table(found), "tuning"),
        )
    )
    save_figure(tuning.curves(trials, gains), place / "figures" / f"{study}_tuning.png")
    show(gains.to_string(index=False, float_format=lambda v: f"{v:.4g}"))
    print("\n".join(map(paths.short, written)))


@app.command()
def conform(
    target: Annotated[
        str,
        typer.Argument(
            help="An option of conf/estimator, or MODULE:CLASS of an estimator.",
            autocompletion=completion.estimators,
        ),
    ],
    arguments: Annotated[
        list[str] | None,
        typer.Argument(
            help="Overrides of the option, or the constructor's arguments, key=value.",
            autocompletion=completion.overrides,
        ),
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """Run the checks that every estimator must pass.

    Examples
    --------
      estima conform ekf_icp estimator.gate_probability=null

      estima conform estimators.odometry:Odometry kr=1e-5 kl=1e-5
    """
    from experiments.gate.conform import conform_target
    from experiments.runs.experiment import searched

    results = conform_target(target, arguments or [], searched(config_dir))
    for result in results:
        print(f"{'pass' if result.passed else 'FAIL':<5}{result.name}: {result.message}")
    if not all(result.passed for result in results):
        raise typer.Exit(1)


@app.command()
def check(
    suite: Annotated[
        str,
        typer.Option(
            help="Suite of conf/suite, or a .yaml file; baselines lie beside it.",
            autocompletion=completion.suites,
        ),
    ] = "check",
    accept: Annotated[
        str | None, typer.Option(help="Make this the baseline; the reason is kept in it.")
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(
            help="An estimator; repeat it. Else all of the suite.",
            autocompletion=completion.estimators,
        ),
    ] = None,
    release: Annotated[
        bool, typer.Option("--release", help="With --accept: pin the release baseline too.")
    ] = False,
    junit: Annotated[Path | None, typer.Option(help="JUnit XML to write.")] = None,
    summary: Annotated[Path | None, typer.Option(help="Markdown to write.")] = None,
    candidate: Annotated[
        Path | None,
        typer.Option(help="Folder of trajectories that were made elsewhere, to judge instead."),
    ] = None,
    recordings: Annotated[
        Path | None,
        typer.Option(help="Only write the recordings for them, without the truth, to this folder."),
    ] = None,
) -> None:
    """Compare all estimators' errors with the baseline; code 1 if one is worse.

    Of a suite's entries with `elsewhere: true`, --candidate judges the trajectories GROUP_SEED.tum
    (or .csv, .mcap; of several repeats GROUP_SEED.0.tum and so on) that any program made. Under
    GitHub Actions it also annotates, and adds to the job's summary.

    Examples
    --------
      estima check

      estima check --junit check.xml

      estima check --accept "descriptors of half the size: 2 % worse, twice as fast"

      estima check --suite mine.yaml --recordings in

      estima check --suite mine.yaml --candidate out
    """
    if recordings is not None:
        from experiments.gate.candidate import write_recordings
        from experiments.gate.suite import read_suite, suite_path

        chosen = read_suite(suite_path(suite)).of(only or []).made(elsewhere=True)
        with progress("recordings", 1.0) as on_progress:
            print(f"{recordings}: {write_recordings(chosen, recordings, on_progress)} recordings")
        return
    from experiments.gate.report import run_check

    reports = {"junit": junit, "summary": summary}
    if run_check(suite, accept, only or [], release=release, candidate=candidate, **reports):
        raise typer.Exit(1)


@app.command()
def bench(
    name: Annotated[
        str,
        typer.Argument(
            help="compile, external, fastslam, formats, graph_slam, growth, icp, mcl, sim, "
            "smoothing, sweep, sweep_scale, teams, topological, or all."
        ),
    ] = "all",
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Measure speeds and accuracies on one core, beside their goals.

    Example: estima bench sim --json
    """
    from experiments.bench import run_bench

    print(run_bench(name, as_json=as_json))


AllVersions = Annotated[
    bool, typer.Option("--all-versions", help="Keep rows of other versions of the code.")
]
Where = Annotated[
    list[str] | None,
    typer.Option(
        "--where", help="Rows to keep, such as estimator.metric=point_to_line; repeat it."
    ),
]


@app.command()
def table(
    name: Annotated[
        str,
        typer.Argument(
            help="A sweep's name, or a folder or file of rows.", autocompletion=completion.sweeps
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File to write: .tex, .md, .html, .csv, .parquet."),
    ] = None,
    against: Annotated[
        str | None,
        typer.Option(
            help="Compare with this estimator: relative errors, and paired tests.",
            autocompletion=completion.estimators,
        ),
    ] = None,
    metric: Annotated[
        list[str] | None,
        typer.Option(
            help="Result to show instead of the main ones; repeat it.",
            autocompletion=completion.metrics,
        ),
    ] = None,
    all_versions: AllVersions = False,
    times: Annotated[bool, typer.Option("--times", help="Keep computing times.")] = False,
    every: Annotated[
        bool, typer.Option("--rows", help="With -o: write every row, with all its columns.")
    ] = False,
    size: Annotated[
        str | None,
        typer.Option(
            help="Of a .tex: column or page of an IEEE paper (252, 516 pt), or text of an article "
            "(345 pt), the default."
        ),
    ] = None,
    only: Where = None,
) -> None:
    """Show a sweep's mean errors with 95 % intervals, or write them for a paper.

    Errors are those of the best answers: of the revised path of a method that has one. The best on
    the same recordings is bold. A .tex file goes into a LaTeX article by `input` as it is; what is
    too wide for one table becomes several.

    Examples
    --------
      estima table leaderboard --against smoother

      estima table slip --metric answer_ate_rmse_m --metric answer_nees_mean -o slip.tex

      estima table slip --rows -o slip.csv
    """
    from experiments.report.table import as_lines, check_name, notes, statuses, write_table
    from experiments.sweeps.collect import collect, where
    from experiments.sweeps.summary import summary

    check_name(out, size)
    require(not every or out is not None, "--rows: name the file to write, such as -o rows.csv")
    timed = times or any(column.endswith("_time_us") for column in metric or [])
    rows = where(collect(name, all_versions=all_versions, times=timed), only or [])
    if every and out is not None:
        require(out.suffix in (".csv", ".parquet"), f"-o {out}: with --rows it is .csv or .parquet")
        write_frame(rows, out)
        print(f"{out}: {counted(len(rows), 'row')}, {len(rows.columns)} columns")
        return
    found = summary(rows, against, metric or [])
    note = notes(found, against)
    if out is None:
        show(as_lines(found, note))
        if (rows["status"] != Outcome.OK).any():
            show("\n" + "\n".join(f"{count} {words}" for words, count in statuses(rows)))
        return
    write_table(found, note, out, Path(name).name, size)
    print(f"{out}: {counted(len(found), 'row')}")


@app.command()
def plot(
    name: Annotated[
        str,
        typer.Argument(
            help="A sweep's name, or a folder or file of rows.", autocompletion=completion.sweeps
        ),
    ],
    x: Annotated[
        str | None,
        typer.Option(
            help="Swept setting, such as robot.kr; without it one is chosen and said.",
            autocompletion=completion.settings,
        ),
    ] = None,
    y: Annotated[
        str,
        typer.Option(help="Result (estima options metrics).", autocompletion=completion.metrics),
    ] = "answer_ate_rmse_m",
    by: Annotated[
        list[str] | None,
        typer.Option(
            help="One line a value of this; repeat it for combinations.",
            autocompletion=completion.settings,
        ),
    ] = None,
    row: Annotated[
        str | None,
        typer.Option(help="One row of panels a value.", autocompletion=completion.settings),
    ] = None,
    col: Annotated[
        str | None,
        typer.Option(help="One column of panels a value.", autocompletion=completion.settings),
    ] = None,
    size: Annotated[
        str, typer.Option(help="screen, or column or page of a paper (3.5 in, 7.16 in).")
    ] = "screen",
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Picture to write: .png, .pdf, .svg.")
    ] = Path("plot.png"),
    pool: Annotated[
        bool, typer.Option("--pool", help="Average over other settings that differ too.")
    ] = False,
    all_versions: AllVersions = False,
    only: Where = None,
) -> None:
    """Draw a column of a sweep against a swept setting, with 95 % intervals.

    By default it is the position error of the best answers: of the revised path of a method that
    has one, else of the online one.

    Examples
    --------
      estima plot slip

      estima plot slip --x robot.kr --y heading_rmse_rad --by choice.estimator

      estima plot slip --x robot.kr --by choice.estimator --col choice.world --size page -o a.pdf
    """
    from experiments.report.plot import Size, sweep_figure
    from experiments.sweeps.collect import collect, suggested, where
    from experiments.viewing.style import save_figure

    if size not in list(Size):
        raise InputError(f"--size must be {', '.join(Size)}, got {size}")
    rows = where(collect(name, all_versions=all_versions, times=True), only or [])
    failed = rows["status"] == Outcome.FAILED
    if failed.all():
        every = f"all {len(rows)} runs" if len(rows) > 1 else "the run"
        raise InputError(f"{name}: {every} failed; `estima table {name}` says how")
    if failed.any():
        print(f"{failed.sum()} of {len(rows)} runs failed; left out", file=sys.stderr)
        rows = rows[~failed]
    chosen = ""
    if x is None:
        taken = [each for each in (*(by or []), row, col) if each]
        x, *others = suggested(rows, taken)
        if not taken:
            by, col = others[:1], next(iter(others[1:]), None)
        words = [f"--x {x}", *(f"--by {each}" for each in by or []), f"--col {col}" if col else ""]
        chosen = f"drawn with {' '.join(filter(None, words))}"
    page = sweep_figure(rows, x, y, by, row=row, col=col, size=size, pool=pool)
    save_figure(page, out)
    if chosen:
        print(chosen, file=sys.stderr)
    print(out)


@app.command()
def reproduce(
    full: Annotated[bool, typer.Option("--full", help="The judged profile.")] = False,
    paper: Annotated[str | None, typer.Option(help="Only this paper.")] = None,
    figures_only: Annotated[
        bool, typer.Option("--figures-only", help="Draw again what is in results/.")
    ] = False,
) -> None:
    """Make the papers' figures, tables and claims, in results/quick/ or, in full, in results/.

    Examples
    --------
      estima reproduce --paper puzzlebot2024

      estima reproduce --full

      estima reproduce --figures-only
    """
    from experiments.reproduce import redraw
    from experiments.reproduce import reproduce as reproduce_papers

    if figures_only:
        redraw(only=paper)
    else:
        reproduce_papers(full=full, only=paper)


@app.command()
def report(
    name: Annotated[
        str | None,
        typer.Argument(
            help="A sweep's name, or a folder or file of rows; else all studies of the papers.",
            autocompletion=completion.sweeps,
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write, .html.")] = None,
    pictures: Annotated[
        bool,
        typer.Option(
            "--pictures", help="Draw the best and worst run of each estimator as they move."
        ),
    ] = False,
    all_versions: AllVersions = False,
    only: Where = None,
    config_dir: ConfigDir = None,
) -> None:
    """Write one page to open in a browser: of a sweep, or of the papers' studies in results/.

    A sweep's page has a chart whose axes, colours, panels and filters can be chosen, its means, its
    best and worst runs, and its command. It needs no network. With --pictures it links the best and
    the worst run of each estimator as they move, drawn into PAGE/pictures beside it.

    Examples
    --------
      estima report

      estima report slip

      estima report slip --pictures

      estima report slip --where choice.world=office -o office.html
    """
    if out is not None and name is None:
        raise InputError(f"-o {out} is for the page of a sweep: estima report NAME -o {out}")
    if out is not None and out.suffix != ".html":
        raise InputError(f"-o {out}: a page is .html")
    if name is not None:
        from experiments.report.sweep_page import write_sweep_page
        from experiments.sweeps.collect import collect, folder_of, where

        folder, called = folder_of(name), Path(name).name
        written = out or folder.parent / f"{called}.html"
        rows = where(collect(name, all_versions=all_versions, times=True), only or [])
        called = called if folder.parent == paths.results() / "runs" else name
        if pictures:
            _draw_extremes(rows, called, folder, written, config_dir)
        write_sweep_page(rows, called, folder, written, config_dir)
        print(paths.short(written))
        return
    require(
        not (only or all_versions or pictures or config_dir),
        "--where, --all-versions, --pictures, --config-dir: name the sweep of the runs",
    )
    if not any((paths.results() / name).exists() for name in ("claims.csv", "figures", "tables")):
        raise InputError(
            f"{paths.short(paths.results())}: no claims, figures or tables to report; "
            "`estima reproduce` makes them, and `estima table NAME` shows a sweep"
        )
    from experiments.report.page import write_report

    with progress("report", 1.0) as on_progress:
        print(write_report(paths.results(), on_progress))


def _draw_extremes(
    rows: DataFrame, called: str, folder: Path, page: Path, config_dir: Path | None
) -> None:
    """Draw the best and the worst run of each estimator, unless they are there."""
    from experiments.report.sweep_page import extremes, picture_path
    from experiments.sweeps.again import noted_config_dir, run_again, short_key

    noted = noted_config_dir(folder)
    runs = extremes(rows)
    for _, row in runs[runs["first"] & (runs["kind"] != "failed")].iterrows():
        out = picture_path(row, page)
        if out.exists():
            continue
        out.parent.mkdir(parents=True, exist_ok=True)
        try:
            again = run_again(row, config_dir, noted)
            _show_run(again, None, [], out, None, None, f"{called}/{short_key(row)}")
        except InputError as error:
            print(f"{out.name} is not drawn: {error}", file=sys.stderr)


@app.command()
def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Delete the recordings.")] = False,
) -> None:
    """Show the cache of simulated recordings, or clear it.

    ESTIMA_CACHE_GIB sets its limit; the least recently used recordings are dropped first.

    Example: estima cache --clear
    """
    from experiments.runs.cache import files, folder, limit_bytes, trim

    if clear:
        print(f"{trim(0.0)} recordings deleted")
    kept = files()
    size, limit = sum(size for _, size in kept) / 2**30, limit_bytes() / 2**30
    print(f"{paths.short(folder())}: {len(kept)} recordings, {size:.2f} of {limit:g} GiB")


@app.command("export-table")
def export_table(
    tables: Annotated[list[Path], typer.Argument(help="Tables, .csv or .parquet.")],
    form: Annotated[str, typer.Option("--format", help="markdown, or latex (booktabs).")] = (
        "markdown"
    ),
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder to write to; else they are printed.")
    ] = None,
    digits: Annotated[int, typer.Option(min=1, max=17, help="Significant digits.")] = 4,
) -> None:
    """Print tables as Markdown or LaTeX, or write them to a folder.

    Example: estima export-table results/tables/*.csv --format latex -o tables
    """
    from experiments.report.export import export

    export(tables, form, out, digits)


def main() -> None:
    """Run the command line; wrong input ends in one line and code 2, a failed run in code 1."""
    try:
        app(_results_first(sys.argv[1:]))
    except (Exception, KeyboardInterrupt) as error:
        end(error)
    except SystemExit as ended:
        if ended.code == _INTERRUPTED:  # Typer has caught the interrupt, which may hold a message
            end(ended)
        raise


def _results_first(arguments: list[str]) -> list[str]:
    """Move `--results DIR`, which may be anywhere, before the command's name."""
    for i, argument in enumerate(arguments):
        if argument.partition("=")[0] == "--results":
            n_words = 1 if "=" in argument else 2
            given = [*argument.split("=", 1)[1:], *arguments[i + 1 :]]
            if not given or not given[0]:
                raise InputError("--results must name a folder")
            return [*arguments[i : i + n_words], *arguments[:i], *arguments[i + n_words :]]
    return arguments


_INTERRUPTED = 128 + 2  # by SIGINT
