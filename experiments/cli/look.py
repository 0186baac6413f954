"""Commands that display options, runs and maps: options, recommend, view, map."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

import typer

from experiments.cli import completion
from experiments.cli.flags import ConfigDir, Overrides, check_once
from experiments.runs import columns, paths
from experiments.runs.console import no_option, progress, show
from sim.errors import nearest, require
from sim.files import read_text


def options(
    group: Annotated[
        str | None,
        typer.Argument(
            help="world, robot, ..., study; or metrics.", autocompletion=completion.groups
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Argument(help="An option whose keys to show; its group may be left out."),
    ] = None,
    config_dir: ConfigDir = None,
) -> None:
    """List the configuration groups and their options, or the keys of an option, or the metrics.

    Of each key it shows the default, what it accepts, and what it means.

    Examples
    --------
      estima options estimator

      estima options ekf_slam

      estima options laser (a sensor; or that of a preset: lms291.laser)

      estima options simulation (keys without options: prior, people, scoring too)

      estima options metrics
    """
    from experiments.runs.schema import OPTIONS, describe_option

    if group == "metrics":
        require(name is None, f"{name}: metrics have no options of their own")
        show(columns.as_text())
        return
    if group in OPTIONS and name is None:
        show(describe_option(group, group))
        return
    if group is not None and name is None and group not in completion.GROUPS:
        group, name = _group_of(group, config_dir), group
    if group is not None and name is not None:
        _describe(group, name, config_dir)
        return
    if group is not None:
        names = completion.options(group, config_dir)
        width = max(map(len, names))
        said = (paths.about(_file_of(group, n, config_dir))["what"] for n in names)
        show("\n".join(f"{n:{width}}  {what}" for n, what in zip(names, said, strict=True)))
        return
    for one in completion.GROUPS:
        print(f"{one:>10}: {', '.join(completion.options(one, config_dir))}")
    print(f"{'keys':>10}: {', '.join(OPTIONS)}")
    print("Next: estima options GROUP says what each is, estima options NAME its keys.")


def _file_of(group: str, name: str, config_dir: Path | None) -> Path:
    """YAML of an option, the user's own first."""
    files = (folder / group / f"{name}.yaml" for folder in (config_dir, paths.CONF) if folder)
    return next(file for file in files if file.exists())


def _describe(group: str, name: str, config_dir: Path | None) -> None:
    """Print an option's keys; a study states its own."""
    from experiments.runs.compose import searched
    from experiments.runs.schema import describe_option

    names = completion.options(group, config_dir)
    known = no_option(group, name, names)
    require(name in names or group in _groups_of(name, config_dir), known)
    if group == "study":
        show(read_text(_file_of(group, name, config_dir)).rstrip())
    else:
        show(describe_option(group, name, searched(config_dir)))


def _groups_of(name: str, config_dir: Path | None) -> list[str]:
    """Groups of an option that is called by its name alone, or of a sensor."""
    from experiments.runs.schema import sensor_class

    groups = [g for g in completion.GROUPS if name in completion.options(g, config_dir)]
    preset = name.rpartition(".")[0] in completion.options("sensors", config_dir)
    return groups or ["sensors"] * (preset or sensor_class(name) is not None)


def _group_of(name: str, config_dir: Path | None) -> str:
    """The one group of an option or a sensor that is called by its name alone."""
    from experiments.runs.schema import OPTIONS

    groups = _groups_of(name, config_dir)
    options = [n for g in completion.GROUPS for n in completion.options(g, config_dir)]
    known = [*completion.GROUPS, *OPTIONS, "metrics", *options]
    listed = nearest(name, known)
    remedy = "; `estima options` lists all" if listed.endswith(" more") else ""
    require(groups, f"no group or option {name}; {listed}{remedy}")
    several = " or ".join(f"`estima options {group} {name}`" for group in groups)
    require(len(groups) == 1, f"{name} is an option of several groups: {several}")
    return groups[0]


def recommend(
    overrides: Overrides = None,
) -> None:
    """Say which estimators fit a robot and its sensors, and how they did in the nearest settings.

    The errors and times are those of the project's own tables, with how far their settings are from
    yours; the last lines are the sweep that settles it.

    Examples
    --------
      estima recommend sensors=hokuyo robot.kr=2e-5

      estima recommend sensors=hokuyo prior.map=world world=office
    """
    from experiments.report.recommend import SURE, recommend

    with progress("comparing estimators", 1.0) as on_progress:
        advice = recommend(overrides or [], on_progress)
    show(advice.text)
    if advice.sweep:
        show(
            "\nTo be sure, run the best in your own setting:\n"
            f"  {shlex.join(['estima', 'run', '-m', *advice.sweep])}\n"
            f"  estima table {SURE} --times"
        )


def view(
    what: Annotated[
        list[str] | None,
        typer.Argument(
            help="A recording or a log of any format, then Hydra overrides; or a sweep's NAME/KEY.",
            callback=check_once,
        ),
    ] = None,
    estimate: Annotated[
        list[str] | None,
        typer.Option(
            "--estimate",
            "-e",
            help="A trajectory (.csv, .tum, .mcap), a run's folder, or an estimator to run now; "
            "repeat it to see them over one another.",
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
        typer.Option(
            "--out",
            "-o",
            help="File to write: .mp4, .gif, .html, .rrd (for Rerun); a world or map: .png.",
        ),
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

      estima view run.npz --estimate mcl prior.map=world estimator.max_particles=2000 -o run.mp4

      estima view run.npz --estimate ekf_icp -o run.rrd

      estima view --world world=office seed=3 -o office.png

      estima view run.npz -e ekf_icp -e odometry --map map.yaml -o run.html

      estima view slip/1f0c33ab -o run.html (a run of the sweep slip)

      estima view --map map.yaml -o map.png
    """
    from experiments.runs.compose import searched
    from experiments.sweeps.again import draw_recorded_run, row_of
    from experiments.viewing import play

    if world or (grid is not None and not what):
        require(not (world and grid), "--world and --map: draw one at a time")
        print(
            play.draw_world([*searched(config_dir), *(what or [])], out or Path("world.png"))
            if grid is None
            else play.draw_map(grid, out or Path("map.png"))
        )
        return
    first, *overrides = what or [""]
    require(first and "=" not in first, "name a recording to view, such as run.npz, or say --world")
    how = play.Showing(out, seconds, grid)
    if not Path(first).exists() and (row := row_of(first)) is not None:
        own = "a run of a sweep has its estimator and its settings; leave out others"
        require(not estimate and not overrides, f"{first}: {own}")
        said = draw_recorded_run(row, how, first, config_dir)
    else:
        ran = estimate or not overrides
        require(
            bool(ran), f"{[*overrides, ''][0]}: overrides need an estimator; add --estimate NAME"
        )
        given = [*searched(config_dir), *overrides]
        said = play.play_file(Path(first), estimate or [], given, how)
    if said:
        print(said)


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
    from experiments.runs.compose import searched
    from experiments.viewing.map import Gridding, map_file

    how = Gridding(resolution_m, max_range_m, laser, raw)
    print(map_file(what[0], estimate, [*searched(config_dir), *what[1:]], out, how))
