"""The history of a suite's estimators as text, and as one self-contained page."""

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pandas as pd
from markupsafe import Markup

from experiments.bench.against import clone_of, git
from experiments.gate.compare import Change
from experiments.gate.history import NEW, STEP, append, history_path, read_history, trace
from experiments.gate.report import LABELS
from experiments.gate.suite import suite_path
from experiments.report.export import numeric_columns, plain
from experiments.report.page import TEMPLATES, render
from experiments.report.sweep_page import as_json, rounded
from experiments.runs.columns import COLUMNS
from experiments.runs.console import show
from experiments.runs.paths import short
from sim.errors import InputError, printable, require
from sim.files import write_text
from sim.yaml_file import read_yaml

_SHORT = 10  # digits of a commit
_HOSTED = re.compile(r"(?:https?://(?:[^@/]+@)?|(?:ssh://)?git@)([\w.-]+)[:/]([\w./-]+?)(?:\.git)?")


def run_history(
    suite: str,
    revisions: Sequence[str],
    speed: str | None = None,
    file: Path | None = None,
    out: Path | None = None,
    config_dir: Path | None = None,
) -> None:
    """Do what `estima history` does: append commits, if any, then show the lines.

    Raises
    ------
    InputError
        If the history, the suite or a path cannot be used.
    """
    require(out is None or out.suffix == ".html", f"-o {out}: a page is .html")
    path = file or history_path(suite)
    require(path.suffix == ".parquet", f"{path}: a history is .parquet")
    if revisions:
        append(suite, revisions, path, speed, config_dir)
    rows = read_history(path)
    if out is None:
        show(as_text(rows))
        return
    source = suite_path(suite)
    write_history_page(rows, source.stem, out, address_of(clone_of(source)))
    show(short(out))


def titles(points: pd.DataFrame) -> dict[str, str]:
    """Name of each metric that the points have, with its unit."""
    words = {name: f"{label} error, {COLUMNS[name].unit}" for name, label in LABELS.items()}
    words[STEP] = "time of a step, ratio"
    return {name: text for name, text in words.items() if (points["metric"] == name).any()}


def latest(points: pd.DataFrame) -> pd.DataFrame:
    """Table of the lines: first and last value, their ratio, and how many changes between them."""
    rows = []
    for (estimator, metric), line in points.groupby(["estimator", "metric"], sort=False):
        line = line.iloc[line.index.get_loc(line.index[line["mark"] == NEW][-1]) :]
        first, last = line.iloc[0], line.iloc[-1]
        low, high = (last[end] / first["value"] for end in ("low", "high"))
        rows.append(
            {
                "estimator": estimator,
                "metric": titles(points)[metric],
                "first": first["value"],
                "last": last["value"],
                "last / first": last["value"] / first["value"],
                "95 % interval": "" if metric == STEP else f"{low:.3f} to {high:.3f}",
                "changes": int((line["mark"] != "").sum()) - 1,
            }
        )
    return pd.DataFrame(rows)


def changes(points: pd.DataFrame) -> pd.DataFrame:
    """The marked points, the newest first."""
    marked = points[(points["mark"] != "") & ((points["mark"] != NEW) | (points["number"] > 0))]
    return marked.sort_values("number", ascending=False, kind="stable", ignore_index=True)


def as_text(rows: pd.DataFrame) -> str:
    """The table of lines, and a line for each change."""
    points = trace(rows)
    lines = [latest(points).map(plain).to_string(index=False), ""]
    for _, each in changes(points).iterrows():
        lines.append(
            f"{each['commit'][:_SHORT]} {_day(each)} {each['estimator']}, "
            f"{titles(points)[each['metric']]}: {_said(each)}: {each['subject']}"
        )
    return "\n".join(map(printable, "\n".join(lines).split("\n")))


def _said(point: pd.Series) -> str:
    times = "" if pd.isna(point["change"]) else f", {point['change']:.3f} times"
    return f"{point['mark']}{times}"


def _day(point: pd.Series) -> str:
    return datetime.fromtimestamp(point["committed_s"], UTC).date().isoformat()


def address_of(clone: Path | None) -> str:
    """Where a browser finds the commits of a clone's origin; empty if nobody knows."""
    try:
        origin = git("remote", "get-url", "origin", folder=clone)
    except InputError:
        return ""
    found = _HOSTED.fullmatch(origin)
    return f"https://{found[1]}/{found[2]}/commit/" if found else ""


def write_history_page(rows: pd.DataFrame, name: str, out: Path, address: str = "") -> None:
    """Write the page of a history.

    Parameters
    ----------
    address
        What a commit's hash is appended to, to link it; by default it is not linked.
    """
    points = trace(rows)
    commits = points.drop_duplicates("number")
    table, found = latest(points), changes(points)
    spec = read_yaml(TEMPLATES / "history.yaml")
    data = {
        "spec": {**spec, "config": read_yaml(TEMPLATES / "chart.yaml")["config"]},
        "titles": titles(points),
        "address": address,
        "commits": [
            {"hash": c["commit"], "day": _day(c), "subject": printable(c["subject"])}
            for _, c in commits.iterrows()
        ],
        "points": [
            {key: each[key] for key in ("number", "estimator", "metric", "mark")}
            | {key: rounded(each[key]) for key in ("value", "low", "high", "change")}
            for _, each in points.iterrows()
        ],
    }
    text = render(
        "history.html",
        name=name,
        n_commits=len(commits),
        ends=[_day(commits.iloc[i]) for i in (0, -1)],
        controls=list(titles(points).items()),
        against=sorted({a[:_SHORT] for a in rows["against"] if a}),
        head=list(table),
        numeric=numeric_columns(table),
        rows=table.map(plain).to_numpy(),
        changes=[
            [
                _link(each["commit"], address),
                _day(each),
                each["estimator"],
                titles(points)[each["metric"]],
                _said(each),
                each["subject"],
            ]
            for _, each in found.iterrows()
        ],
        n_worse=int(found["mark"].isin([Change.WORSE, Change.FAILED]).sum()),
        data=as_json(data),
    )
    write_text(out, text)


def _link(commit: str, address: str) -> Any:
    text = commit[:_SHORT]
    return Markup('<a href="{}">{}</a>').format(address + commit, text) if address else text
