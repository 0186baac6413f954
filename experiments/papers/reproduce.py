"""Make all papers' tables, figures and claims in results/, as `make reproduce` does."""

import importlib
import os
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType

from experiments.evaluation.verdict import Claim, Conclusion, Profile
from experiments.papers.results import Results
from experiments.report.claims import (
    note_provenance,
    read_claims,
    read_provenance,
    read_verdicts,
    write_claims,
    write_verdicts,
)
from experiments.report.contents import findings
from experiments.report.page import write_report
from experiments.runs.console import progress
from experiments.runs.paths import results, short
from experiments.viewing.style import save_figure
from sim.errors import InputError

PAPERS = ("puzzlebot2024", "decristoforis2020", "maximo2024", "gil2008")
LOGS = ("real_logs",)  # run only where the logs are
OWN = ("mcl_office", "fastslam_consistency")  # our own, which judge no claim: run when named
Judgement = tuple[list[Claim], list[Conclusion]]
_APART = "_tuning"  # the table on other seeds from which parameters were chosen


def reproduce(*, full: bool = False, only: str | None = None) -> None:
    """Run the studies, judge the claims, draw the figures, write the report.

    Parameters
    ----------
    full
        Run the full profile, not the quick one, whose verdicts are marked quick.
    only
        A paper's short name, or None for all papers.
    """
    place = results()
    read_claims(place / "claims.csv")  # a damaged table ends the command before hours are spent
    read_verdicts(place / "verdicts.csv")
    profile, made = Profile.FULL if full else Profile.QUICK, read_provenance(place)
    for paper in _chosen(only):
        begun = time.monotonic()
        if paper in LOGS and (why := _part(paper, "study").missing()):
            print(f"{paper}: left out, {why}", file=sys.stderr)
            continue
        if not full and made.get(paper, {}).get("profile") == Profile.FULL:
            print(
                f"{paper}: replaces the judged results of {paper}; `git checkout results` brings "
                "them back",
                file=sys.stderr,
            )
        _print(*reproduce_paper(paper, profile))
        print(f"{paper}: {time.monotonic() - begun:.0f} s", file=sys.stderr)
    write_report(place)
    names = ("report.html", "verdicts.csv", "claims.csv", "figures", "tables")
    print(", ".join(f"{name.split('.')[0]}: {short(place / name)}" for name in names))


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
        command = f"estima reproduce --paper {only}" if only else "estima reproduce"
        raise InputError(
            f"{short(place / 'tables')}: no tables of {only or 'any paper'}; run `{command}`"
        )
    for paper in _chosen(only):
        begun = time.monotonic()
        if paper not in present:
            print(f"{paper}: left out, no tables in {short(place)}", file=sys.stderr)
            continue
        made = Results(place, paper)
        if paper in LOGS and only is None and not any((place / "arrays").glob(f"{paper}_*.npz")):
            print(f"{paper}: left out, what it draws of the logs is not here", file=sys.stderr)
            continue
        with made.as_found():
            _draw(made)
        print(f"{paper}: {time.monotonic() - begun:.0f} s", file=sys.stderr)


def judge_again(only: str | None = None) -> None:
    """Judge the claims again, from the tables that the studies left, and write the report.

    Raises
    ------
    InputError
        If the tables are damaged.
    """
    place, made = results(), read_provenance(results())
    for paper in _chosen(only):
        if paper in OWN or not any((place / "tables").glob(f"{paper}_*.csv")):
            continue
        profile = Profile(made.get(paper, {}).get("profile", Profile.QUICK))
        tables = Results(place, paper)
        with tables.as_found():
            judged = _judgement(tables)
        _write(judged, place, paper, profile)
        _print(*judged)
    write_report(place)


def reproduce_paper(paper: str, profile: Profile) -> Judgement:
    """Run one paper's study, and put its files, claims, verdicts and origin in place.

    The files are written elsewhere first, so an interrupted run leaves the results as they were.
    """
    begun, place = time.monotonic(), results()
    aside = place / "cache"  # which is not committed
    aside.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=aside, prefix=f"{paper}-") as name:
        made = Results(Path(name), paper)
        with progress(paper, 1.0) as on_progress:
            _part(paper, "study").run(profile, made, on_progress)
        _draw(made)
        judged: Judgement = ([], []) if paper in OWN else _judgement(made)
        for kind in ("tables", "arrays", "figures"):
            _put_in_place(made.folder / kind, place / kind, paper)
        _write(judged, place, paper, profile)
        note_provenance(place, paper, profile, time.monotonic() - begun)
    return judged


def _judgement(made: Results) -> Judgement:
    """Statistics of a paper's claims, and the one verdict on each claim."""
    module = _part(made.paper, "claims")
    claims = module.judge(made)
    return claims, module.conclusions(made, claims)


def _write(judged: Judgement, place: Path, paper: str, profile: Profile) -> None:
    claims, conclusions = judged
    command = f"estima reproduce --paper {paper}{' --full' * (profile is Profile.FULL)}"
    write_claims(claims, place / "claims.csv", paper=paper, profile=profile, command=command)
    says = findings(paper)["claims"]
    path = place / "verdicts.csv"
    write_verdicts(conclusions, path, paper=paper, says=says, profile=profile)


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
    known = (*PAPERS, *LOGS, *OWN)
    if only is not None and only not in known:
        raise InputError(f"--paper must be one of {', '.join(known)}, got {only!r}")
    return (*PAPERS, *LOGS) if only is None else (only,)


def _part(paper: str, name: str) -> ModuleType:
    return importlib.import_module(f"experiments.papers.{paper}.{name}")


def _print(claims: list[Claim], conclusions: list[Conclusion]) -> None:
    for claim in claims:
        found = claim.found
        interval = f"{found.value:.4g} [{found.low:.4g}, {found.high:.4g}]"
        said = "; ".join(filter(None, [claim.criterion, claim.reason]))
        print(
            f"{claim.id}  {claim.role:<8}  {claim.verdict.label:<15} {claim.statistic}: {interval} "
            f"({said})"
        )
    for each in conclusions:
        print(f"{each.id}: {each.verdict.label}. {each.sentence}")
