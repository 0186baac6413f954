"""What the report shows, read from results/ into plain data."""

from __future__ import annotations

import ast
import base64
import struct
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from experiments.evaluation.verdict import Profile, Verdict
from experiments.report.claims import read_claims
from experiments.report.export import as_text, numeric
from experiments.report.provenance import read_provenance, this_code
from experiments.runs.paths import CONF, SOURCE
from experiments.runs.row import read_rows
from sim.errors import InputError

PAPERS = ("puzzlebot2024", "decristoforis2020", "gil2008", "maximo2024")
# What belongs to no paper, by the start of its files' names, and the commands that make it.
OWN = {
    "leaderboard": ["estima run -m study=leaderboard"],
    "all_estimators": ["estima run -m study=all_estimators"],
    "mcl_office": ["estima reproduce --paper mcl_office"],
}
SMALL_ROWS, SMALL_COLUMNS = 60, 20  # a table up to here is shown whole
FIRST_ROWS = 5  # of a larger one
_FOLDER = SOURCE / "experiments" / "papers"
_WORST_FIRST = (Verdict.NOT_REPRODUCED, Verdict.UNDECIDED, Verdict.REPRODUCED, Verdict.SHOWN)
_REMEDY = "`git checkout results`, or delete it and run `estima reproduce`"


@dataclass(frozen=True)
class JudgedClaim:
    """A claim in our words, and the rows of claims.csv that judge it."""

    id: str
    sentence: str = ""
    statistics: tuple[dict[str, Any], ...] = ()

    @property
    def verdict(self) -> str:
        """The verdicts on its statistics in words."""
        if not self.statistics:
            return "not judged yet"
        counts = self._counts()
        words = "shown, not judged"
        if len(counts) == 1:
            words = next(verdict.label for verdict in counts)
        elif counts:
            words = "mixed: " + ", ".join(f"{n} {v.label}" for v, n in counts.items())
        quick = any(row["profile"] == Profile.QUICK for row in self.statistics)
        return f"{words} (quick)" if quick else words

    @property
    def style(self) -> str:
        """Class of the verdict in the style sheet."""
        counts = self._counts()
        if len(counts) > 1:
            return "partly"
        return next((verdict.value for verdict in counts), "quiet")

    @property
    def worst(self) -> dict[str, Any]:
        """The first statistic of the worst verdict: it speaks for the claim."""
        return min(self.statistics, key=lambda row: _WORST_FIRST.index(row["verdict"]))

    @property
    def examples(self) -> list[dict[str, Any]]:
        """The first statistic of each verdict."""
        first = {row["verdict"]: row for row in reversed(self.statistics)}
        return [first[verdict] for verdict in Verdict if verdict in first]

    def _counts(self) -> dict[Verdict, int]:
        """How many statistics have each verdict; those that are only shown do not count."""
        found = Counter(row["verdict"] for row in self.statistics)
        return {v: found[v] for v in Verdict if found[v] and v is not Verdict.SHOWN}


@dataclass(frozen=True)
class Picture:
    """A figure as base64 PNG, its size in pixels, and the claims it stands for."""

    name: str
    title: str
    alt: str
    paper: str
    claims: list[JudgedClaim]
    width: int
    height: int
    png: str


@dataclass(frozen=True)
class Table:
    """A table's size, what is left out of it, and the rest as text."""

    name: str
    size: str
    note: str
    headings: list[str]
    numeric: list[bool]
    rows: list[list[str]]


@dataclass(frozen=True)
class Study:
    """What a study left, and how to make it again."""

    name: str
    about: Mapping[str, Any]
    figures: list[Picture]
    missing: list[str]
    tables: list[Table]
    commands: list[str]
    files: dict[str, str]
    constants_file: str
    constants: dict[str, str]


def contents(results: Path, on_progress: Callable[[float], None]) -> dict[str, Any]:
    """Read all that the report shows, by its names in the templates."""
    claims = read_claims(results / "claims.csv")
    made = read_provenance(results)
    papers = [*PAPERS, *sorted(set(claims["paper"]) - set(PAPERS))]
    about = {name: findings(name) for name in (*papers, *OWN)}
    judged = _judged(claims, {k: v for page in about.values() for k, v in page["claims"].items()})
    commands = {name: [f"estima reproduce --paper {name}"] for name in papers} | OWN
    commands |= {str(k): list(v.unique()) for k, v in claims.groupby("paper")["command"]}
    studies = {}
    for done, (name, page) in enumerate(about.items(), start=1):
        studies[name] = study(results, name, page, commands[name], judged)
        on_progress(done / len(about))
    known = tuple(f"{name}_" for name in about)
    files = [*(results / "figures").glob("*.png"), *(results / "tables").glob("*.csv")]
    origins = made | {"this page": this_code()}
    counts = Counter(claims["verdict"])
    begun = set(claims["paper"])
    return {
        "claims": judged,
        "statistics": len(claims),
        "judged": claims["id"].nunique(),
        "tally": [f"{counts[verdict]} {verdict.label}" for verdict in Verdict if counts[verdict]],
        "quick": int((claims["profile"] == Profile.QUICK).sum()),
        # what a cut table would lack: claims without a verdict of papers that have some
        "missing": [
            key
            for paper in papers
            for key in about[paper]["claims"]
            if paper in begun and not judged[key].statistics
        ],
        "papers": [studies[name] for name in papers],
        "own": [studies[name] for name in OWN],
        "others": sorted(path.name for path in files if not path.name.startswith(known)),
        "made": made,
        "origins": origins,
        "details": list(dict.fromkeys(key for how in origins.values() for key in how)),
        "unknown": [paper for paper in papers if paper not in made],
    }


def findings(name: str) -> dict[str, Any]:
    """What a paper says, in our words: `title`, `about`, `claims` by id, `figures` by file name."""
    empty = {"title": name, "about": "", "claims": {}, "figures": {}}
    path = _FOLDER / name / "findings.yaml"
    if not path.exists():
        return empty
    try:
        return {**empty, **yaml.safe_load(path.read_text(encoding="utf-8"))}
    except yaml.YAMLError as error:
        raise InputError(f"{path}: not YAML ({str(error).splitlines()[0]})") from error


def _judged(claims: pd.DataFrame, sentences: Mapping[str, str]) -> dict[str, JudgedClaim]:
    """Every claim by its id: those with a sentence in its order, then the others."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for row in claims.sort_values("id", kind="stable").to_dict("records"):
        rows.setdefault(row["id"], []).append({**row, "verdict": Verdict(row["verdict"])})
    return {
        key: JudgedClaim(key, sentences.get(key, ""), tuple(rows.get(key, ())))
        for key in dict.fromkeys([*sentences, *rows])
    }


def study(
    results: Path,
    name: str,
    about: Mapping[str, Any],
    commands: list[str],
    judged: Mapping[str, JudgedClaim],
) -> Study:
    """Read a study's figures in the order of its findings, its tables and its settings."""
    there = {path.stem: path for path in sorted((results / "figures").glob(f"{name}_*.png"))}
    order = [*(figure for figure in about["figures"] if figure in there), *there]
    constants_file, constants = _constants(name)
    return Study(
        name,
        about,
        figures=[
            picture(there[figure], about["figures"].get(figure, {}), judged)
            for figure in dict.fromkeys(order)
        ],
        missing=[figure for figure in about["figures"] if figure not in there],
        tables=[table(path) for path in sorted((results / "tables").glob(f"{name}_*.csv"))],
        commands=commands,
        files={
            f"conf/study/{path.name}": path.read_text(encoding="utf-8").strip()
            for path in sorted((CONF / "study").glob(f"{name}*.yaml"))
        },
        constants_file=constants_file,
        constants=constants,
    )


def picture(path: Path, about: Mapping[str, Any], judged: Mapping[str, JudgedClaim]) -> Picture:
    """Read a figure; one without findings is named after its file.

    Raises
    ------
    InputError
        If it is not a whole PNG.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read ({error.strerror}); {_REMEDY}") from error
    if data[:8] != b"\x89PNG\r\n\x1a\n" or len(data) < 24:
        raise InputError(f"{path}: not a PNG; {_REMEDY}")
    if data[-8:] != b"IEND\xaeB`\x82":
        raise InputError(f"{path}: the picture is cut off; {_REMEDY}")
    width, height = struct.unpack(">II", data[16:24])
    words = path.stem.split("_", 1)[-1].replace("_", " ")
    return Picture(
        path.stem,
        about.get("title", words),
        about.get("alt", f"Figure: {words}"),
        about.get("paper", ""),
        [judged.get(key, JudgedClaim(key)) for key in about.get("claims", [])],
        width,
        height,
        base64.b64encode(data).decode(),
    )


def table(path: Path) -> Table:
    """Read a table: whole if it is small, else its first rows."""
    frame = read_rows(path)
    small = len(frame) <= SMALL_ROWS and frame.shape[1] <= SMALL_COLUMNS
    shown = as_text(frame if small else frame.head(FIRST_ROWS))
    note = "" if small else f"; the first {len(shown)}, the rest in the file"
    if "seed" in frame and len(frame):
        low, high = frame["seed"].min(), frame["seed"].max()
        note += f"; seed {low}" if low == high else f"; seeds {low} to {high}"
    return Table(
        path.stem,
        f"{len(frame)} rows, {frame.shape[1]} columns",
        note,
        list(shown.columns),
        numeric(frame),
        shown.to_numpy().tolist(),
    )


def _constants(name: str) -> tuple[str, dict[str, str]]:
    """File of the constants that a study is run with, and their source by name."""
    path = _FOLDER / name / "settings.py"
    path = path if path.exists() else path.with_name("study.py")
    if not path.exists():
        return "", {}
    found = {}
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.value is not None:
            target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            found[ast.unparse(target)] = ast.unparse(node.value)
    public = {k: v for k, v in found.items() if k.isupper() and k[0] != "_" and k != "PAPER"}
    return str(path.relative_to(SOURCE)), public
