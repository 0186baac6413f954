"""All papers' tables, figures and claims into results/: what `make reproduce` runs."""

from __future__ import annotations

import importlib
import sys
import time
from types import ModuleType

from experiments.claims import Claim, write
from experiments.console import progress
from experiments.figures.style import save_figure
from experiments.report import note_provenance, write_report
from experiments.version import ROOT
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
    for paper in known if only is None else (only,):
        begun, profile = time.monotonic(), "full" if full else "quick"
        study = _study(paper)
        if paper in LOGS and (why := study.missing()):
            print(f"{paper}: left out, {why}", file=sys.stderr)
            continue
        claims = reproduce_paper(study, paper, profile)
        write(claims, RESULTS / "claims.csv")
        seconds = time.monotonic() - begun
        note_provenance(RESULTS, paper, profile, seconds)
        _print(claims)
        print(f"{paper}: {seconds:.0f} s", file=sys.stderr)
    write_report(RESULTS)
    print(
        "report: results/report.html, claims: results/claims.csv, figures: results/figures, "
        "tables: results/tables"
    )


def reproduce_paper(study: ModuleType, paper: str, profile: str) -> list[Claim]:
    """Run one paper's study; write its tables and figures; return its claims."""
    with progress(paper, 1.0) as on_progress:
        tables = study.run(profile, RESULTS / "tables", on_progress)
    for name, page in study.figures(tables).items():
        save_figure(page, RESULTS / "figures" / f"{name}.png")
    claims: list[Claim] = study.claims(tables, quick=profile == "quick")
    return claims


def _study(paper: str) -> ModuleType:
    return importlib.import_module(f"experiments.studies.{paper}")


def _print(claims: list[Claim]) -> None:
    for claim in claims:
        interval = f"{claim.value:.4g} [{claim.low:.4g}, {claim.high:.4g}]"
        print(f"{claim.id}  {claim.verdict:<24} {claim.statistic}: {interval} ({claim.criterion})")
