"""One page of all results, results/report.html: claims, figures, tables, and how to redo them.

It is made only of what the studies left in results/, and needs nothing beside itself to be read.
"""

from __future__ import annotations

import base64
import dataclasses
import importlib
import importlib.util
import json
import struct
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from experiments.bench.measure import machine
from experiments.report.claims import OUTCOMES, outcome
from experiments.report.claims import read as read_claims
from experiments.report.export import plain
from experiments.runs.row import read_rows
from experiments.runs.version import ROOT, code_version
from sim.errors import InputError
from sim.files import write_whole

FINDINGS = ROOT / "experiments" / "papers"
PAPERS = ("puzzlebot2024", "decristoforis2020", "gil2008", "maximo2024")
SMALL_ROWS, SMALL_COLUMNS = 60, 20  # a table up to here is shown whole
FIRST_ROWS = 5  # of a larger one
# What belongs to no paper, by the start of its files' names, and the command that makes it.
OWN = {
    "leaderboard": "estima run -m study=leaderboard",
    "all_estimators": "estima run -m study=all_estimators",
    "mcl_office": "python -m experiments.papers.mcl_office.study",
}


def write_report(results: Path, on_progress: Callable[[float], None] = lambda _: None) -> Path:
    """Write `report.html` into the folder of results and return its path.

    Parameters
    ----------
    results
        Holds claims.csv, provenance.json, figures/ and tables/; whatever is missing is named as
        missing in the page.
    on_progress
        Called with the share done.
    """
    claims = read_claims(results / "claims.csv")
    papers = [*PAPERS, *sorted(set(claims["paper"]) - set(PAPERS))]
    about = {paper: findings(paper) for paper in papers}
    made = read_provenance(results)
    missing = _without_verdict(claims, about)
    if missing:
        print(
            f"{results / 'claims.csv'}: no verdict on {', '.join(missing)}, though others of the "
            "paper have one; `git checkout results/claims.csv` or `estima reproduce`",
            file=sys.stderr,
        )
    sections = []
    for i, paper in enumerate(papers):
        part = claims[claims["paper"] == paper]
        sections.append(_paper(results, paper, about[paper], part, made.get(paper)))
        on_progress((i + 1) / len(papers))
    body = [
        '<a class="skip" href="#claims">Skip to the claims</a>',
        _header(claims, about, missing),
        "<main>",
        _claims_section(claims, about),
        *sections,
        _own(results, papers),
        _machine_section(papers, made),
        "</main>",
    ]
    path = results / "report.html"
    with write_whole(path) as part_path:
        part_path.write_text(_PAGE.format(css=_css(), body="\n".join(body)), encoding="utf-8")
    return path


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<link rel="icon" href="data:,">
<title>Estima: the papers' claims, judged</title>
<style>
{css}</style>
</head>
<body>
{body}
</body>
</html>
"""


def _css() -> str:
    return (Path(__file__).parent / "report.css").read_text(encoding="utf-8")


def findings(paper: str) -> dict[str, Any]:
    """What a paper says, in our words: `title`, `about`, `claims` by id, `figures` by file name."""
    empty = {"title": paper, "about": "", "claims": {}, "figures": {}}
    path = FINDINGS / paper / "findings.yaml"
    if not path.exists():
        return empty
    try:
        return {**empty, **yaml.safe_load(path.read_text(encoding="utf-8"))}
    except yaml.YAMLError as error:
        raise InputError(f"{path}: not YAML ({str(error).splitlines()[0]})") from error


def read_provenance(results: Path) -> dict[str, dict[str, Any]]:
    """How each paper's results were made: profile, duration, code, machine; empty if unknown."""
    path = results / "provenance.json"
    try:
        made: dict[str, dict[str, Any]] = json.loads(path.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot read ({error}); {_REMEDY}") from error
    if not isinstance(made, dict):
        raise InputError(f"{path}: must hold an object by paper; {_REMEDY}")
    for paper, how in made.items():
        lacks = [key for key in _MADE if key not in how] if isinstance(how, dict) else list(_MADE)
        if lacks:
            raise InputError(f"{path}: {paper} does not say its {', '.join(lacks)}; {_REMEDY}")
    return made


_MADE = ("profile", "seconds", "code_version")
_REMEDY = "`git checkout results`, or delete it and run `estima reproduce`"


def note_provenance(results: Path, paper: str, profile: str, seconds: float) -> None:
    """Keep how a paper's results were made, beside them."""
    made = read_provenance(results)
    made[paper] = {
        "profile": profile,
        "seconds": round(seconds),
        "code_version": code_version(),
        **machine(),
    }
    with write_whole(results / "provenance.json") as part:
        part.write_text(json.dumps(dict(sorted(made.items())), indent=2) + "\n")


def _without_verdict(claims: pd.DataFrame, about: dict[str, dict[str, Any]]) -> list[str]:
    """Claims without a verdict of papers that have some: what a cut table would lack."""
    judged, papers = set(claims["id"]), set(claims["paper"])
    return [
        key
        for paper, page in about.items()
        if paper in papers
        for key in page["claims"]
        if key not in judged
    ]


def summary(verdicts: Sequence[str]) -> tuple[str, str]:
    """A claim's verdict in words and its class, of the verdicts on its parts."""
    counts = Counter(outcome(verdict) for verdict in verdicts)
    judged = sum(counts[word] for word in OUTCOMES[:3])
    quick = " (quick)" if any(verdict.endswith("(quick)") for verdict in verdicts) else ""
    for word in OUTCOMES[:3]:
        if judged and counts[word] == judged:
            return word + quick, word.replace(" ", "-")
    if not judged:
        return "shown, not judged" + quick, "quiet"
    parts = ", ".join(f"{counts[w]} {w}" for w in OUTCOMES[:3] if counts[w])
    return f"mixed: {parts}{quick}", "partly"


def _header(claims: pd.DataFrame, about: dict[str, dict[str, Any]], missing: Sequence[str]) -> str:
    counts = Counter(claims["verdict"].map(outcome))
    tally = ", ".join(f"{counts[word]} {word}" for word in OUTCOMES if counts[word])
    quick = int(claims["verdict"].str.endswith("(quick)").sum()) if len(claims) else 0
    notes = [f"{len(claims)} statistics on {claims['id'].nunique()} claims: {tally or 'none yet'}."]
    if quick:
        notes.append(f"{quick} come from the quick profile, with few repeats, and are marked so.")
    if missing:
        notes.append(f"No verdict on {', '.join(missing)}.")
    links = [
        ("claims", "Claims"),
        *((p, p) for p in about),
        ("own", "Our own"),
        ("machine", "Versions and machine"),
    ]
    items = "".join(f'<li><a href="#{key}">{escape(name)}</a></li>' for key, name in links)
    return (
        "<header><h1>The papers' claims, judged</h1>"
        f"<p>{' '.join(notes)} Intervals, in brackets, are of 95 % unless the statistic says "
        "otherwise.</p>"
        f'<nav aria-label="Sections"><ul>{items}</ul></nav></header>'
    )


def _claims_section(claims: pd.DataFrame, about: dict[str, dict[str, Any]]) -> str:
    """Every claim with its verdict; several statistics of one fold away below it."""
    sentences = {i: text for page in about.values() for i, text in page["claims"].items()}
    order = {key: i for i, key in enumerate(sentences)}
    known = sorted({*sentences, *claims["id"]}, key=lambda i: (order.get(i, len(order)), i))
    bodies = [_claim(i, sentences.get(i, ""), claims[claims["id"] == i]) for i in known]
    return (
        '<section aria-labelledby="claims"><h2 id="claims" tabindex="-1">Claims</h2>'
        '<table class="claims stack" role="table"><caption>What the papers say, in our words, '
        "and what came out here. Of several statistics the first of the worst verdict is shown; "
        "all are below it.</caption>"
        + _stacked_head("Claim", "The paper says", "Statistic and interval", "Verdict")
        + f"{''.join(bodies)}</table></section>"
    )


def _claim(key: str, sentence: str, rows: pd.DataFrame) -> str:
    """A claim as a group of rows of the table."""
    more = ""
    if rows.empty:
        statistic, (verdict, style) = "", ("not judged yet", "quiet")
    else:
        verdict, style = summary(rows["verdict"].tolist())
        first = rows.iloc[0]
        if len(rows) == 1:
            statistic = f"{escape(first['statistic'])}: {interval(first)}"
            verdict = str(first["verdict"])
        else:
            # The first row of the worst verdict speaks for the claim.
            rank = rows["verdict"].map(outcome).map({w: i for i, w in enumerate(_RANK)})
            first = rows.loc[rank.idxmin()]
            statistic = f"{escape(first['statistic'])}: {interval(first)}"
            more = (
                f'<tr role="row"><td role="cell" colspan="4"><details><summary>{key}: all '
                f"{len(rows)} statistics</summary>{_statistics(key, rows)}</details></td></tr>"
            )
    return (
        f'<tbody role="rowgroup" id="claim-{key}"><tr role="row">'
        f'<th scope="row" role="rowheader">{key}</th>'
        f'<td role="cell">{escape(sentence)}</td><td role="cell">{statistic}</td>'
        f'<td role="cell" class="verdict {style}">{escape(verdict)}</td></tr>{more}</tbody>'
    )


_RANK = ("not reproduced", "undecided", "reproduced", "shown")


def interval(row: Any) -> str:
    """A value and its interval; the value alone where nothing is random."""
    value, low, high = (float(row[name]) for name in ("value", "low", "high"))
    alone = low == high == value
    return plain(value) if alone else f"{plain(value)} [{plain(low)}, {plain(high)}]"


def _statistics(key: str, rows: pd.DataFrame) -> str:
    """All statistics of one claim."""
    lines = "".join(
        f'<tr role="row"><th scope="row" role="rowheader">{escape(row["statistic"])}</th>'
        f'<td role="cell">{interval(row)}</td>'
        f'<td role="cell">{escape(str(row["criterion"]))}</td>'
        f'<td role="cell" class="verdict {summary([row["verdict"]])[1]}">'
        f"{escape(row['verdict'])}</td></tr>"
        for _, row in rows.iterrows()
    )
    return (
        f'<table class="rows stack" role="table"><caption>Statistics of {key}</caption>'
        + _stacked_head("Statistic", "Value [interval]", "Criterion", "Verdict")
        + f'<tbody role="rowgroup">{lines}</tbody></table>'
    )


def _stacked_head(*names: str) -> str:
    """Head of a table whose cells stand below each other on a phone; the roles outlast that."""
    cells = "".join(f'<th scope="col" role="columnheader">{name}</th>' for name in names)
    return f'<thead role="rowgroup"><tr role="row">{cells}</tr></thead>'


def _scroll(label: str, table: str) -> str:
    """A table that scrolls by itself on a narrow screen, by keyboard too."""
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(label)}">{table}</div>'
    )


def _paper(
    results: Path,
    paper: str,
    about: dict[str, Any],
    claims: pd.DataFrame,
    made: dict[str, Any] | None,
) -> str:
    """A paper's figures, tables, configuration and command."""
    figures = _figures(results, paper, about, claims)
    tables = [_table(path) for path in sorted((results / "tables").glob(f"{paper}_*.csv"))]
    return (
        f'<section aria-labelledby="{paper}"><h2 id="{paper}">{paper}: '
        f"{escape(about['title'])}</h2>"
        f"<p>{escape(about['about'])}</p>"
        f"<h3>Figures of {paper}</h3>{''.join(figures) or _NOTHING}"
        f"<h3>Tables of {paper}</h3>{''.join(tables) or _NOTHING}"
        f"<h3>How {paper} was made</h3>{_redo(paper, claims, made)}</section>"
    )


_NOTHING = '<p class="quiet">None yet.</p>'


def _figures(results: Path, study: str, about: dict[str, Any], claims: pd.DataFrame) -> list[str]:
    """A study's figures in the order of its findings, and which are missing."""
    names = [path.stem for path in sorted((results / "figures").glob(f"{study}_*.png"))]
    order = {name: i for i, name in enumerate(about["figures"])}
    names.sort(key=lambda name: (order.get(name, len(order)), name))
    figures = [
        _figure(results / "figures" / f"{name}.png", about["figures"].get(name, {}), claims)
        for name in names
    ]
    if missing := [name for name in order if name not in names]:
        figures.append(f'<p class="quiet">Not made yet: {escape(", ".join(missing))}.</p>')
    return figures


def _own(results: Path, papers: Sequence[str]) -> str:
    """Figures and tables that belong to no paper, with the command that makes them."""
    parts = []
    for study, command in OWN.items():
        about = findings(study)
        tables = [_table(path) for path in sorted((results / "tables").glob(f"{study}_*.csv"))]
        parts.append(
            f"<h3>{escape(study)}: {escape(about['title'])}</h3><p>{escape(about['about'])}</p>"
            f"{''.join(_figures(results, study, about, _NO_CLAIMS))}{''.join(tables)}"
            f"<pre><code>{escape(command)}</code></pre>"
        )
    known = tuple(f"{study}_" for study in (*papers, *OWN))
    files = [*(results / "figures").glob("*.png"), *(results / "tables").glob("*.csv")]
    others = sorted(path.name for path in files if not path.name.startswith(known))
    if others:
        parts.append(f'<p class="quiet">Of no study here: {escape(", ".join(others))}.</p>')
    return (
        '<section aria-labelledby="own"><h2 id="own">Our own</h2>'
        f"<p>Made apart from the papers' studies, by their own commands.</p>{''.join(parts)}"
        "</section>"
    )


_NO_CLAIMS = pd.DataFrame({"id": []})


def _figure(path: Path, about: dict[str, Any], claims: pd.DataFrame) -> str:
    """A figure with the paper's finding beside ours, which is what its claims came to."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read ({error.strerror}); {_REMEDY}") from error
    width, height = png_size(data, path)
    words = path.stem.split("_", 1)[-1].replace("_", " ")
    title, alt = about.get("title", words), about.get("alt", f"Figure: {words}")
    ours = [_ours(key, claims[claims["id"] == key]) for key in about.get("claims", [])]
    sides = ""
    if about.get("paper"):
        here = f"<ul>{''.join(ours)}</ul>" if ours else "<p>Shown; no claim is judged by it.</p>"
        sides = (
            f'<div class="findings"><div><p><strong>The paper</strong></p>'
            f"<p>{escape(about['paper'])}</p></div>"
            f"<div><p><strong>Here</strong></p>{here}</div></div>"
        )
    return (
        f'<figure id="{path.stem}"><h4>{escape(title)}</h4>'
        f'<img alt="{escape(alt)}" width="{width}" height="{height}" '
        f'src="data:image/png;base64,{base64.b64encode(data).decode()}">'
        f"<figcaption>{sides}</figcaption></figure>"
    )


def _ours(key: str, rows: pd.DataFrame) -> str:
    """What came of a claim: the verdict, and the first statistic of each outcome below it."""
    verdict, style = ("not judged yet", "quiet")
    if not rows.empty:
        verdict, style = summary(rows["verdict"].tolist())
    outcomes = rows["verdict"].map(outcome)
    first = [rows[outcomes == word].iloc[0] for word in OUTCOMES if (outcomes == word).any()]
    lines = "".join(
        f"<li>{escape(row['verdict']) + ': ' if len(first) > 1 else ''}"
        f"{escape(row['statistic'])}: {interval(row)}</li>"
        for row in first
    )
    return (
        f'<li><a href="#claim-{key}">{key}</a>: '
        f'<span class="verdict {style}">{escape(verdict)}</span><ul>{lines}</ul></li>'
    )


def png_size(data: bytes, path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the head of a PNG file that is whole."""
    if data[:8] != b"\x89PNG\r\n\x1a\n" or len(data) < 24:
        raise InputError(f"{path}: not a PNG; {_REMEDY}")
    if data[-8:] != b"IEND\xaeB`\x82":
        raise InputError(f"{path}: the picture is cut off; {_REMEDY}")
    width, height = struct.unpack(">II", data[16:24])
    return width, height


def _table(path: Path) -> str:
    """A table, folded: whole if it is small, else its first rows and where the rest is."""
    frame = read_rows(path)
    small = len(frame) <= SMALL_ROWS and frame.shape[1] <= SMALL_COLUMNS
    shown = frame if small else frame.head(FIRST_ROWS)
    numbers = [dtype.kind in "iuf" for dtype in frame.dtypes]
    styles = [' class="number"' if number else "" for number in numbers]
    head = "".join(
        f'<th scope="col"{style}>{escape(str(name))}</th>'
        for name, style in zip(frame.columns, styles, strict=True)
    )
    columns = [[escape(plain(v)) for v in shown.iloc[:, i]] for i in range(shown.shape[1])]
    lines = "".join(
        "<tr>" + "".join(f"<td{s}>{c}</td>" for c, s in zip(cells, styles, strict=True)) + "</tr>"
        for cells in zip(*columns, strict=True)
    )
    size = f"{len(frame)} rows, {frame.shape[1]} columns"
    part = "" if small else f"; the first {len(shown)}, the rest in the file"
    link = f'<a href="tables/{escape(path.name)}">tables/{escape(path.name)}</a>'
    return (
        f"<details><summary>{escape(path.stem)} ({size})</summary>"
        + _scroll(
            path.stem,
            f'<table class="rows"><caption>{link}: {size}{part}{_seeds(frame)}</caption>'
            f"<thead><tr>{head}</tr></thead><tbody>{lines}</tbody></table>",
        )
        + "</details>"
    )


def _seeds(frame: pd.DataFrame) -> str:
    """Which seeds a table holds, if it says."""
    if "seed" not in frame or frame.empty:
        return ""
    low, high = frame["seed"].min(), frame["seed"].max()
    return f"; seed {low}" if low == high else f"; seeds {low} to {high}"


def _redo(paper: str, claims: pd.DataFrame, made: dict[str, Any] | None) -> str:
    """Command, profile, and the settings of a paper's studies."""
    commands = list(dict.fromkeys(claims["command"].dropna()))
    commands = commands or [f"estima reproduce --paper {paper}"]
    parts = [f"<pre><code>{escape(chr(10).join(commands))}</code></pre>"]
    if made:
        parts.append(
            f"<p>{escape(str(made['profile']))} profile, {escape(str(made['seconds']))} s, code "
            f"<code>{escape(str(made['code_version']))}</code>.</p>"
        )
    for path in sorted((ROOT / "conf" / "study").glob(f"{paper}*.yaml")):
        text = escape(path.read_text(encoding="utf-8").strip())
        parts.append(
            f"<details><summary>conf/study/{path.name}</summary><pre><code>{text}</code></pre>"
            "</details>"
        )
    lines = "".join(
        f'<tr><th scope="row"><code>{name}</code></th><td><code>{escape(value)}</code></td></tr>'
        for name, value in constants(paper).items()
    )
    table = (
        f'<table class="rows"><caption>Constants of experiments/papers/{paper}/study.py</caption>'
        '<thead><tr><th scope="col">Name</th><th scope="col">Value</th></tr></thead>'
        f"<tbody>{lines}</tbody></table>"
    )
    parts.append(
        "<details><summary>Seeds and other constants of the studies</summary>"
        f"{_scroll(f'Constants of {paper}', table)}</details>"
    )
    return "".join(parts)


def constants(paper: str) -> dict[str, str]:
    """The constants that a paper's study is run with, as Python would print them."""
    name = f"experiments.papers.{paper}.study"
    if importlib.util.find_spec(name) is None:
        return {}
    study = importlib.import_module(name)
    kept = (int, float, str, tuple, dict)
    found = {}
    for name, value in vars(study).items():
        named = name.isupper() and not name.startswith("_") and name != "PAPER"
        if named and (isinstance(value, kept) or dataclasses.is_dataclass(value)):
            found[name] = repr(value)
    return found


def _machine_section(papers: Sequence[str], made: dict[str, dict[str, Any]]) -> str:
    """Versions and machine of every paper's results, and of this page."""
    now = {"this page": {"code_version": code_version(), **machine()}}
    columns = made | now
    names = list(dict.fromkeys(key for column in columns.values() for key in column))
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in columns)
    lines = "".join(
        f'<tr><th scope="row">{escape(name.replace("_", " "))}</th>'
        + "".join(f"<td>{escape(plain(column.get(name)))}</td>" for column in columns.values())
        + "</tr>"
        for name in names
    )
    unknown = [paper for paper in papers if paper not in made]
    note = f"<p>Not noted for {escape(', '.join(unknown))}.</p>" if unknown else ""
    table = (
        '<table class="rows"><caption>Where the results of each paper come from</caption>'
        f"<thead><tr><td></td>{head}</tr></thead><tbody>{lines}</tbody></table>"
    )
    return (
        '<section aria-labelledby="machine"><h2 id="machine">Versions and machine</h2>'
        f"{_scroll('Versions and machine', table)}{note}"
        "<p>Packages are pinned in requirements.lock. Seeds below 100 are for tuning, those from "
        "1000 on for judging.</p></section>"
    )
