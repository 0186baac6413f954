"""Make all papers' tables, figures and claims in results/, as `make reproduce` does."""

import importlib
import os
import re
import tempfile
import time
from collections import Counter
from pathlib import Path
from types import ModuleType

from experiments.judging.claim import Claim, Verdict
from experiments.judging.claims_file import (
    note_provenance,
    read_claims,
    read_verdicts,
    write_claims,
    write_verdicts,
)
from experiments.judging.folders import code_folder, findings
from experiments.judging.logs import why_missing
from experiments.judging.results import Profile, Results, reproduce_command
from experiments.judging.sentences import Conclusion, conclude
from experiments.report.page import write_report
from experiments.runs.console import progress, show, warn
from experiments.runs.paths import results, short
from experiments.viewing.style import save_figure
from sim.errors import InputError

PAPERS = ("puzzlebot2024", "decristoforis2020", "maximo2024", "gil2008")
LOGS = ("real_logs", "twins")  # run only where the logs are
NAMED = ("teams", "exploration")  # judged, run when named
OWN = (
    "mcl_office",
    "fastslam_consistency",
    "peers",
)  # our own, which judge no claim: run when named
_APART = "_tuning"  # the table on other seeds from which parameters were chosen


def reproduce(*, full: bool = False, only: str | None = None) -> None:
    """Run the studies, judge the claims, draw the figures, write the report.

    The quick profile has a folder of its own, `results/quick`.

    Parameters
    ----------
    full
        Run the full profile, not the quick one, whose verdicts are marked quick.
    only
        A paper's short name, or None for all papers.
    """
    profile = Profile.FULL if full else Profile.QUICK
    place = folder_of(profile)
    read_claims(place / "claims.csv")  # a damaged table ends the command before hours are spent
    read_verdicts(place / "verdicts.csv")
    lines = []
    for paper in _chosen(only):
        begun = time.monotonic()
        if paper in LOGS and (why := why_missing()):
            warn(f"{paper}: left out, {why}")
            continue
        conclusions = reproduce_paper(paper, profile)
        for each in conclusions:
            show(f"{each.id:<4} {each.verdict.label:<15} {first_sentence(each.sentence)}")
        counts = Counter(each.verdict for each in conclusions)
        ruled = ", ".join(
            f"{counts[verdict]} {verdict.label}" for verdict in Verdict if verdict in counts
        )
        lines.append(f"{paper}: {ruled or 'judges no claim'} ({time.monotonic() - begun:.0f} s)")
    page = write_report(place)
    show("\n".join(["", *lines]))
    show(f"{short(page)} has the figures and tables behind them; open it in a browser")


def redraw(only: str | None = None) -> None:
    """Draw the figures again, from the tables and arrays that the studies left.

    Raises
    ------
    InputError
        If there are none, or they are damaged.
    """
    place = results()
    present = [p for p in _chosen(only) if any((place / "tables").glob(f"{p}_*.csv"))]
    if not present:
        raise InputError(
            f"{short(place / 'tables')}: no tables of {only or 'any paper'}; "
            f"run `{reproduce_command(only, full=True)}`"
        )
    for paper in _chosen(only):
        begun = time.monotonic()
        if paper not in present:
            warn(f"{paper}: left out, no tables in {short(place)}")
            continue
        made = Results(place, paper)
        if paper in LOGS and only is None and not any((place / "arrays").glob(f"{paper}_*.npz")):
            warn(f"{paper}: left out, what it draws of the logs is not here")
            continue
        with made.blaming_files():
            _draw(made)
        warn(f"{paper}: {time.monotonic() - begun:.0f} s")


def reproduce_paper(paper: str, profile: Profile) -> list[Conclusion]:
    """Run one paper's study, and put its files, claims, verdicts and origin in place.

    The files are written elsewhere first, so an interrupted run leaves the results as they were.
    """
    begun, place = time.monotonic(), folder_of(profile)
    aside = results() / "cache"  # which is not committed
    aside.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=aside, prefix=f"{paper}-") as name:
        made = Results(Path(name), paper)
        with progress(paper, 1.0) as on_progress:
            _part(paper, "study").run(profile, made, on_progress)
        _draw(made)
        claims, conclusions = ([], []) if paper in OWN else judgement(made)
        for kind in ("tables", "arrays", "figures"):
            _put_in_place(made.folder / kind, place / kind, paper)
        _write(claims, conclusions, place, paper, profile)
        note_provenance(place, paper, profile, time.monotonic() - begun)
    return conclusions


def folder_of(profile: Profile) -> Path:
    """Return the folder of the judged results, or of the quick ones, which leave those alone."""
    return results() if profile is Profile.FULL else results() / "quick"


def judgement(made: Results) -> tuple[list[Claim], list[Conclusion]]:
    """Statistics of a paper's claims by its tables, and the one verdict on each claim."""
    part = _part(made.paper, "claims")
    claims = part.judge(made)
    regions = part.regions(made) if hasattr(part, "regions") else {}
    return claims, conclude(claims, findings(made.paper), regions)


def _write(
    claims: list[Claim], conclusions: list[Conclusion], place: Path, paper: str, profile: Profile
) -> None:
    command = reproduce_command(paper, full=profile is Profile.FULL)
    write_claims(claims, place / "claims.csv", paper=paper, profile=profile, command=command)
    says = findings(paper)["claims"]
    write_verdicts(conclusions, place / "verdicts.csv", paper=paper, says=says, profile=profile)


def _draw(made: Results) -> None:
    for title, page in _part(made.paper, "figures").draw(made).items():
        save_figure(page, made.folder / "figures" / f"{title}.png")


def _put_in_place(new: Path, old: Path, paper: str) -> None:
    """Move a paper's new files over its old ones, and delete the old ones without a new one."""
    made = {path.name for path in new.glob(f"{paper}_*")}
    try:
        old.mkdir(parents=True, exist_ok=True)
        for path in old.glob(f"{paper}_*"):
            if path.name not in made and not path.stem.endswith(_APART):
                path.unlink()
        for name in sorted(made):
            os.replace(new / name, old / name)
    except OSError as error:
        raise InputError(
            f"{error.filename2 or error.filename}: cannot be replaced ({error.strerror}); move it "
            "away and run again"
        ) from error


def _chosen(only: str | None) -> tuple[str, ...]:
    known = (*PAPERS, *LOGS, *NAMED, *OWN)
    if only is not None and only not in known:
        raise InputError(f"the paper must be one of {', '.join(known)}, got {only!r}")
    return (*PAPERS, *LOGS) if only is None else (only,)


def _part(paper: str, name: str) -> ModuleType:
    room = code_folder(paper).parent.name
    return importlib.import_module(f"experiments.{room}.{paper}.{name}")


def first_sentence(text: str) -> str:
    """Return the text up to its first full stop that ends a sentence."""
    return re.split(r"(?<=[a-z0-9)%]\.) (?=[A-Z])", text, maxsplit=1)[0]
