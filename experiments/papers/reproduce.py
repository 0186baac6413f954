"""All papers' tables, figures and claims into results/: what `make reproduce` runs."""

from __future__ import annotations

import importlib
import os
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType

from experiments.report.claims import Claim, read, write
from experiments.report.page import note_provenance, read_provenance, write_report
from experiments.runs.console import progress
from experiments.runs.version import ROOT
from experiments.viewing.style import save_figure
from sim.errors import InputError

PAPERS = ("puzzlebot2024", "decristoforis2020", "maximo2024", "gil2008")
LOGS = ("real_logs",)  # run only where the logs are
RESULTS = ROOT / "results"


def reproduce(*, full: bool = False, only: str | None = None) -> None:
    """Run the studies, judge the claims, draw the figures, write the report.

    Parameters
    ----------
    full
        The judged profile; else the quick one, whose verdicts are marked quick.
    only
        A paper's short name, or None for all of them.
    """
    known = (*PAPERS, *LOGS)
    if only is not None and only not in known:
        raise InputError(f"--paper must be one of {', '.join(known)}, got {only!r}")
    read(RESULTS / "claims.csv")  # what cannot be added to is said before hours are spent
    profile, made = "full" if full else "quick", read_provenance(RESULTS)
    for paper in known if only is None else (only,):
        begun, study = time.monotonic(), _study(paper)
        if paper in LOGS and (why := study.missing()):
            print(f"{paper}: left out, {why}", file=sys.stderr)
            continue
        if not full and made.get(paper, {}).get("profile") == "full":
            print(
                f"{paper}: replaces the judged results of {paper}; `git checkout results` brings "
                "them back",
                file=sys.stderr,
            )
        claims = reproduce_paper(study, paper, profile)
        seconds = time.monotonic() - begun
        _print(claims)
        print(f"{paper}: {seconds:.0f} s", file=sys.stderr)
    write_report(RESULTS)
    print(
        "report: results/report.html, claims: results/claims.csv, figures: results/figures, "
        "tables: results/tables"
    )


def reproduce_paper(study: ModuleType, paper: str, profile: str) -> list[Claim]:
    """Run one paper's study, and put its tables, figures, claims and origin in place.

    All are made apart first, so an end in between leaves the results as they were.
    """
    begun, aside = time.monotonic(), RESULTS / "cache"  # which is not committed
    aside.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=aside, prefix=f"{paper}-") as name:
        folder = Path(name)
        with progress(paper, 1.0) as on_progress:
            tables = study.run(profile, folder / "tables", on_progress)
        for title, page in study.figures(tables).items():
            save_figure(page, folder / "figures" / f"{title}.png")
        claims: list[Claim] = study.claims(tables, quick=profile == "quick")
        for kind in ("tables", "figures"):
            _put_in_place(folder / kind, RESULTS / kind, paper)
        write(claims, RESULTS / "claims.csv")
        note_provenance(RESULTS, paper, profile, time.monotonic() - begun)
    return claims


def _put_in_place(new: Path, old: Path, paper: str) -> None:
    """Move a paper's new files over its old ones; old ones that were not made again go."""
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


_APART = "_tuning"  # a table made on other seeds, that parameters were chosen by


def _study(paper: str) -> ModuleType:
    return importlib.import_module(f"experiments.papers.{paper}.study")


def _print(claims: list[Claim]) -> None:
    for claim in claims:
        interval = f"{claim.value:.4g} [{claim.low:.4g}, {claim.high:.4g}]"
        print(f"{claim.id}  {claim.verdict:<24} {claim.statistic}: {interval} ({claim.criterion})")
