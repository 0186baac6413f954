"""The report, results/report.html: claims, figures, tables, and how to redo them.

It is made only from what the studies left in results/.
"""

from __future__ import annotations

import base64
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import pandas as pd
from PIL import Image, UnidentifiedImageError

from experiments.judging.claim import Role, Verdict, headline_verdict
from experiments.judging.claims_file import read_claims, read_provenance, read_verdicts, this_code
from experiments.judging.folders import code_folder, findings
from experiments.judging.free_settings import FreeSettings, as_words, free_settings
from experiments.judging.results import Profile, reproduce_command
from experiments.report.export import as_text, fold_intervals, numeric_columns, plain
from experiments.report.leaderboard import by_world, on_lasers
from experiments.report.page import render
from experiments.runs.console import warn
from experiments.runs.paths import CONF
from experiments.runs.row import read_rows
from experiments.sweeps.summary import COUNT_WORDS
from experiments.viewing.panels import read_panels
from sim.errors import InputError, require
from sim.files import require_file, write_text

Entry = Mapping[str, Any]
_LAST = b"IEND\xaeB`\x82"  # bytes of a whole PNG
PAPERS = ("puzzlebot2024", "decristoforis2020", "gil2008", "maximo2024")

# What belongs to no paper, by the prefix of its files' names, and the commands that make it.
OWN = {
    "leaderboard": [
        "estima run -m study=leaderboard",
        "estima table leaderboard --against smoother --times --efficiency "
        "-o results/tables/leaderboard_means.csv",
        "estima reproduce --figures-only --paper leaderboard",
    ],
    "peers": [
        "make setup EXTRAS=peers,tune && make peers",
        reproduce_command("peers"),
        "estima tune peers -o conf/estimator",
    ],
    "all_estimators": [
        "estima run -m study=all_estimators",
        "estima table all_estimators -o results/tables/all_estimators_means.csv",
        "estima reproduce --figures-only --paper all_estimators",
    ],
    "mcl_office": [reproduce_command("mcl_office")],
    "fastslam_consistency": [reproduce_command("fastslam_consistency")],
    "self_knowledge": [reproduce_command("self_knowledge")],
}
FIRST = (
    "real_logs_building",
    "leaderboard_errors",
)  # pictures for the first screen, the best first
SMALL_ROWS, SMALL_COLUMNS = 60, 20  # a table up to here is shown whole
FIRST_ROWS = 5  # of a larger one
_REMEDY = "restore it by `git checkout`, or delete it and run `estima reproduce --full`"


def write_report(results: Path, on_progress: Callable[[float], None] = lambda _: None) -> Path:
    """Write `report.html` into the folder of results and return its path.

    Parameters
    ----------
    results
        Folder of claims.csv, provenance.json, figures/ and tables/; the page names what is missing.
    on_progress
        Called with the share done.
    """
    found = contents(results, on_progress)
    if found["missing"]:
        warn(
            f"{results / 'claims.csv'}: no verdict on {', '.join(found['missing'])}, though others "
            "of the paper have one; `git checkout results/claims.csv` or "
            f"`{reproduce_command(None)}`"
        )
    path = results / "report.html"
    write_text(path, render("page.html", **found))
    return path


def contents(results: Path, on_progress: Callable[[float], None]) -> dict[str, Any]:
    """Read all that the report shows, under its names in the templates."""
    table = read_claims(results / "claims.csv")
    made = read_provenance(results)
    papers = [*PAPERS, *sorted(set(table["paper"]) - set(PAPERS))]
    about = {name: findings(name) for name in (*papers, *OWN)}
    verdicts = read_verdicts(results / "verdicts.csv").set_index("id")
    claims = judged_claims(table, about, verdicts)
    commands = {name: [reproduce_command(name)] for name in papers} | OWN
    commands |= {str(k): list(v.unique()) for k, v in table.groupby("paper")["command"]}
    studies = {}
    for done, (name, page) in enumerate(about.items(), start=1):
        judged = [claims[key] for key in page["claims"]]
        judged += [c for c in claims.values() if c["paper"] == name and c not in judged]
        studies[name] = {
            **study(results, name, page, claims),
            "commands": commands[name],
            "claims": judged,
            "is_paper": name in PAPERS,
            "tally": tally(claim for claim in judged if not claim["own"]),
            "own_tally": tally(claim for claim in judged if claim["own"]),
        }
        on_progress(done / len(about))
    pictures = {figure["name"]: figure for found in studies.values() for figure in found["figures"]}
    known = tuple(f"{name}_" for name in about)
    files = [*(results / "figures").glob("*.png"), *(results / "tables").glob("*.csv")]
    origins = made | {"this page": this_code()}
    return {
        "claims": claims,
        "by_world": by_world(results / "tables" / "leaderboard_means.csv"),
        "first": next((pictures[name] for name in FIRST if name in pictures), None),
        "on_lasers": on_lasers(results / "tables" / "peers_methods.csv"),
        "n_statistics": len(table),
        "n_judged": table["id"].nunique(),
        "n_quick": int((table["profile"] == Profile.QUICK).sum()),
        # a table that was cut off lacks these: claims without a verdict in papers that have some
        "missing": [
            key
            for paper in dict.fromkeys(table["paper"])
            for key in about[paper]["claims"]
            if not claims[key]["statistics"]
        ],
        "papers": [studies[name] for name in papers],
        "own": [studies[name] for name in OWN],
        "others": sorted(path.name for path in files if not path.name.startswith(known)),
        "made": made,
        "origins": origins,
        "details": list(dict.fromkeys(key for how in origins.values() for key in how)),
        "unknown": [paper for paper in papers if paper not in made],
    }


def tally(claims: Iterable[Entry]) -> list[tuple[Verdict, int]]:
    """How many claims came to each verdict; those that were not judged are left out."""
    counts = Counter(claim["ruling"] for claim in claims if claim["statistics"])
    return [(verdict, counts[verdict]) for verdict in Verdict if counts[verdict]]


def judged_claims(
    table: pd.DataFrame, about: Mapping[str, Entry], verdicts: pd.DataFrame
) -> Mapping[str, Entry]:
    """Every claim by its id: those of the papers' findings in their order, then the others.

    Each has what the paper `says`, and whether that is our `own`; its `statistics`, the rows of the
    table, headlines first; its `ruling`, the verdict that follows from the headlines and from the
    region of free settings if it has one, also in words (`verdict`) with a `style`; the
    `sentence` on what came out; and its free `settings`.
    """
    sentences = verdicts["sentence"].to_dict()
    decided = verdicts.loc[verdicts["region_share"].notna(), "verdict"]
    by_region = {key: Verdict(text) for key, text in decided.items()}
    says = {key: text for page in about.values() for key, text in page["claims"].items()}
    own = {key for page in about.values() for key in page["own"]}
    open_settings = {
        key: settings_of(each) for name in about for key, each in free_settings(name).items()
    }
    rows: dict[str, list[Entry]] = {key: [] for key in says}
    ordered = table.sort_values(["id", "role"], ascending=[True, False], kind="stable")
    for row in ordered.to_dict("records"):
        typed = {"verdict": Verdict(row["verdict"]), "role": Role(row["role"])}
        rows.setdefault(row["id"], []).append({**row, **typed})
    return {
        key: {
            "id": key,
            "says": says.get(key, ""),
            "own": key in own,
            "sentence": sentences.get(key, ""),
            "paper": statistics[0]["paper"] if statistics else "",
            "statistics": statistics,
            "settings": open_settings.get(key, []),
            **verdict_on(statistics, by_region.get(key)),
        }
        for key, statistics in rows.items()
    }


def settings_of(free: FreeSettings) -> list[Entry]:
    """Each free setting in words: its name, range, value at the anchor, and the range's source."""
    return [
        {
            "words": each.called,
            "range": ", ".join(map(as_words, each.choices))
            or " to ".join(map(as_words, (each.low, each.high))),
            "anchor": free.anchor.of(each.name) if free.anchor else "",
            "source": each.source,
        }
        for each in free.settings
    ]


def verdict_on(statistics: Sequence[Entry], by_region: Verdict | None = None) -> Entry:
    """The one verdict on a claim, also in words, and its style."""
    ruling = by_region or headline_verdict([(row["role"], row["verdict"]) for row in statistics])
    quick = " (quick)" if any(row["profile"] == Profile.QUICK for row in statistics) else ""
    words, style = ruling.label + quick, ruling.value
    if ruling is Verdict.SHOWN:
        words, style = f"shown, not judged{quick}" if statistics else "not judged yet", "quiet"
    return {"ruling": ruling, "verdict": words, "style": style}


def study(results: Path, name: str, about: Entry, claims: Mapping[str, Entry]) -> Entry:
    """Read a study's figures in the order of its findings, its tables and its settings."""
    there = {path.stem: path for path in sorted((results / "figures").glob(f"{name}_*.png"))}
    figures = {figure: about["figures"].get(figure, {}) for figure in [*about["figures"], *there]}
    settings = [
        *sorted((CONF / "study").glob(f"{name}*.yaml")),
        *sorted((CONF / "study" / name).glob("*.yaml")),
        code_folder(name) / "settings.py",
    ]
    tables = {path.stem: table(path) for path in sorted((results / "tables").glob(f"{name}_*.csv"))}
    return {
        "name": name,
        "about": about,
        "figures": [
            {
                **picture(there[figure], words, claims),
                "table": tables.get(words.get("table", "")),
            }
            for figure, words in figures.items()
            if figure in there
        ],
        "missing": [figure for figure in about["figures"] if figure not in there],
        "tables": list(tables.values()),
        "settings": {
            "/".join(path.parts[-3:]): path.read_text(encoding="utf-8").strip()
            for path in settings
            if path.exists()
        },
    }


def picture(path: Path, about: Entry, claims: Mapping[str, Entry]) -> Entry:
    """Read a figure; without findings, its title is the file's name.

    Raises
    ------
    InputError
        If it is not a whole PNG.
    """
    require_file(path)
    try:
        data = path.read_bytes()
        with Image.open(BytesIO(data), formats=["PNG"]) as image:
            width, height, parts = *image.size, read_panels(image)
            require(data[-8:] == _LAST, f"{path}: the picture is cut off; {_REMEDY}")
            small = _shrunk(image)
    except UnidentifiedImageError as error:
        raise InputError(f"{path}: not a PNG; {_REMEDY}") from error
    except (OSError, SyntaxError) as error:  # the latter where a checksum is wrong
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot read ({why}); {_REMEDY}") from error
    words = path.stem.split("_", 1)[-1].replace("_", " ")
    return {
        "title": words,
        "alt": f"Figure: {words}",
        "paper": "",
        **about,
        "name": path.stem,
        "claims": [claims[key] for key in about.get("claims", [])],
        "width": width,
        "height": height,
        "panels": parts,
        "webp": base64.b64encode(small).decode(),
    }


def _shrunk(image: Image.Image) -> bytes:
    """The picture in 256 colours as WebP, a third of its PNG: a page of all stays below 5 MB."""
    colours = image.convert("RGB").quantize(256, dither=Image.Dither.NONE)
    data = BytesIO()
    colours.convert("RGB").save(data, "WEBP", lossless=True)
    return data.getvalue()


def with_spread(frame: pd.DataFrame) -> pd.DataFrame:
    """Put means and their standard deviations, and values and their bounds, into one cell each."""
    shown = frame.copy()
    for name in frame:
        spread = name.replace("_mean_", "_sd_")
        stem, _, unit = name.rpartition("_")
        bounds = [f"{stem}_{end}_{unit}" for end in ("low", "high")]
        if spread != name and spread in frame:
            pairs = zip(frame[name], frame[spread], strict=True)
            shown[name] = [_beside_spread(a, b) for a, b in pairs]
            shown = shown.drop(columns=spread).rename(columns={name: name.replace("_mean_", "_")})
        elif {*bounds} <= {*frame}:
            triples = zip(frame[name], *(frame[end] for end in bounds), strict=True)
            shown[name] = [f"{plain(a, 3)} [{plain(b, 3)}, {plain(c, 3)}]" for a, b, c in triples]
            shown = shown.drop(columns=bounds)
    return shown


def _beside_spread(mean: float, deviation: float) -> str:
    """Write a mean to the digits that its standard deviation leaves: two of the latter's."""
    if not math.isfinite(mean) or not math.isfinite(deviation) or deviation <= 0.0:
        return f"{plain(mean, 3)} ± {plain(deviation, 2)}"
    digits = max(0, 1 - math.floor(math.log10(deviation)))
    return f"{mean:z.{digits}f} ± {deviation:.{digits}f}"


def table(path: Path) -> Entry:
    """Read a table: whole if it is small, else its first rows."""
    written = read_rows(path)
    read = fold_intervals(written).rename(columns=COUNT_WORDS)
    frame = with_spread(read)
    joined = [c for c in frame if c not in read or frame[c].dtype != read[c].dtype]
    small = len(frame) <= SMALL_ROWS and frame.shape[1] <= SMALL_COLUMNS
    shown = as_text(frame if small else frame.head(FIRST_ROWS))
    note = "" if small else f"; the first {len(shown)}, the rest in the file"
    if "seed" in frame and len(frame):
        low, high = frame["seed"].min(), frame["seed"].max()
        note += f"; seed {low}" if low == high else f"; seeds {low} to {high}"
    if written.filter(regex="_differs$").to_numpy(bool).any():
        note += "; *: differs from the reference of the last column, by paired tests"
    return {
        "name": path.stem,
        "size": f"{len(frame)} rows, {frame.shape[1]} columns",
        "note": note,
        "head": list(shown.columns),
        "numeric": [n or c in joined for n, c in zip(numeric_columns(frame), frame, strict=True)],
        "cells": shown.to_numpy().tolist(),
    }
