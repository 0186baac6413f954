"""Commands that score: score, compare, conform."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from experiments.cli import completion
from experiments.cli.flags import ConfigDir, Topic, find_own_code, gathered
from experiments.runs.console import show


@dataclass(frozen=True)
class Matching:
    """How a trajectory meets the truth."""

    align: Annotated[
        str | None,
        typer.Option("--align", help="Move it first: none (default), start (first pose), or se2."),
    ] = None
    match: Annotated[
        str | None,
        typer.Option(
            "--match",
            help="True poses: interpolated at its stamps (default) or nearest (as evo associates).",
        ),
    ] = None
    tolerance_s: Annotated[
        float | None, typer.Option("--tolerance", help="Greatest difference of nearest stamps, s.")
    ] = None
    truth_gap_s: Annotated[
        float | None,
        typer.Option("--truth-gap", help="Longest gap of the truth to interpolate over, s."),
    ] = None
    offset_s: Annotated[
        float | None, typer.Option("--offset", help="Added to the trajectory's stamps, s.")
    ] = None

    def stated(self) -> dict[str, Any]:
        """What is given; `Scoring` has the defaults."""
        return {name: value for name, value in vars(self).items() if value is not None}


@dataclass(frozen=True)
class Origin:
    """How the trajectories were made."""

    revised: Annotated[
        bool, typer.Option("--revised", help="They are revised paths, not online ones.")
    ] = False
    cpu_seconds: Annotated[
        float | None, typer.Option(help="Processor time that making the trajectory took, s.")
    ] = None
    topic: Topic = None
    estimator: Annotated[
        str | None,
        typer.Option("--as", help="Name of the estimator in the row (default: the file's)."),
    ] = None


@gathered
def score(
    recording: Annotated[Path, typer.Argument(help="A recording (.npz) or a log with its truth.")],
    trajectories: Annotated[
        list[Path],
        typer.Argument(help="Estimated trajectories: .tum, our .csv, .mcap, .bag."),
    ],
    *,
    matching: Matching,
    made: Origin,
    relations: Annotated[
        Path | None,
        typer.Option(
            help="True relations between poses (lines of t1 t2 x y z roll pitch yaw): score "
            "by them too, or alone where the recording has no truth."
        ),
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

      estima score fr079.npz mine.tum --relations fr079.relations.gz
    """
    from experiments.runs.score import Scoring, as_text, score_files

    how = Scoring(**matching.stated(), revised=made.revised, cpu_seconds=made.cpu_seconds)
    results = score_files(
        recording,
        trajectories,
        how,
        topic=made.topic,
        estimator=made.estimator,
        name=name,
        relations=relations,
    )
    if as_json:
        print(json.dumps([row for _, row, _ in results], indent=2))
        return
    for path, row, scored in results:
        show(f"{path}\n{as_text(row, scored, how)}")
    print(f"rows: estima table {name}")


@gathered
def compare(
    trajectories: Annotated[list[Path], typer.Argument(help="Trajectories of one drive.")],
    recording: Annotated[
        Path | None,
        typer.Option(help="Recording with the truth; without it the first is the reference."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Picture to write.")] = Path(
        "compare.png"
    ),
    *,
    matching: Matching,
    topic: Topic = None,
) -> None:
    """Draw trajectories over one another with their errors over time, and print a table.

    Examples
    --------
      estima compare mine.tum theirs.mcap --recording run.npz -o both.png

      estima compare reference.tum mine.tum --align se2
    """
    from experiments.runs.score import Scoring
    from experiments.viewing.compare import compare_files

    how = Scoring(**matching.stated())
    table = compare_files(trajectories, recording, out, how, topic)
    show(table.to_string(index=False, na_rep="-", float_format=lambda v: f"{v:.4g}"))
    print(out)


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
    from experiments.runs.compose import searched

    find_own_code()
    results = conform_target(target, arguments or [], searched(config_dir))
    for result in results:
        print(f"{'pass' if result.passed else 'FAIL':<5}{result.name}: {result.message}")
    if not all(result.passed for result in results):
        raise typer.Exit(1)
