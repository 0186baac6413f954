"""What a check says: to people, to GitHub (annotations, a summary), and as JUnit XML."""

from __future__ import annotations

import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from experiments.console import progress
from experiments.regress import BASELINES, Finding, Verdict, accept, check
from experiments.suite import ERRORS
from sim.errors import InputError
from sim.files import write_whole

LABELS = {"ate_rmse_m": "position", "ate_aligned_rmse_m": "aligned", "heading_rmse_rad": "heading"}
POWER = BASELINES / "power.csv"  # what experiments.planted measured
_RANK: tuple[Verdict, ...] = ("failed", "worse", "better", "changed", "equal", "identical")
_MEANING = {
    "identical": "same errors to rounding",
    "equal": "no difference shown",
    "changed": "other errors, neither worse nor better on the whole",
}


def run_check(
    suite: str,
    reason: str | None,
    only: Sequence[str] = (),
    *,
    release: bool = False,
    junit: Path | None = None,
    summary: Path | None = None,
) -> bool:
    """Do what `estima check` does; return whether it found a worsening."""
    if release and reason is None:
        raise InputError("--release goes with --accept REASON")
    with progress("estimators over recordings, share", 1.0) as on_progress:
        if reason is not None:
            for path in accept(suite, reason, only, release=release, on_progress=on_progress):
                print(path)
            return False
        findings = check(suite, only, on_progress)
    print(as_text(findings))
    if junit is not None:
        write_text(as_junit(findings), junit)
    if summary is not None:
        write_text(as_markdown(findings), summary)
    if os.environ.get("GITHUB_ACTIONS") == "true":
        print(as_annotations(findings))
        if page := os.environ.get("GITHUB_STEP_SUMMARY"):
            with Path(page).open("a") as file:
                file.write(as_markdown(findings))
    return any(finding.alarms for finding in findings)


def smallest_found() -> dict[str, float]:
    """Smallest worsening of each estimator, as a share, that is found in 95 % of checks."""
    if not POWER.exists():
        return {}
    table = pd.read_csv(POWER, comment="#")
    return {str(k): float(v) for k, v in table.groupby("estimator")["smallest"].max().items()}


def sentence(finding: Finding) -> str:
    """One finding in one line."""
    who = f"{finding.estimator}, {LABELS[finding.error]} error"
    if finding.verdict == "failed":
        return f"{finding.estimator}: {finding.message}"
    if finding.verdict in _MEANING:
        return f"{who}: {_MEANING[finding.verdict]}"
    low, high = (_percent(v) for v in (finding.low, finding.high))
    side = 0 if finding.verdict == "worse" else 1
    return (
        f"{who} {finding.verdict} by {_percent(finding.ratio)} (95 %: {low} to {high}; "
        f"{finding.n_recordings} recordings, p {finding.p_general[side]:.1g}) than the "
        f"{finding.baseline} baseline"
    )


def as_text(findings: Sequence[Finding]) -> str:
    """Tables for a terminal, a line for each finding that counts, and a last line."""
    found = smallest_found()
    lines: list[str] = []
    for baseline, rows in _tables(findings):
        heads = " ".join(f"{LABELS[error]:>9}" for error in ERRORS)
        lines += [f"now / {baseline} baseline", f"  {'':<16} {heads}  {'finds':>7}  verdict"]
        for estimator, of_error, verdict in rows:
            ratios = " ".join(f"{_ratio(of_error[error]):>9}" for error in ERRORS)
            lines.append(f"  {estimator:<16} {ratios}  {_finds(found, estimator):>7}  {verdict}")
        lines.append("")
    lines += [sentence(f) for f in _told(findings)]
    if found:
        lines.append("finds: the smallest worsening that 95 % of checks find (docs/regression.md)")
    return "\n".join([*lines, last_line(findings)])


def as_markdown(findings: Sequence[Finding]) -> str:
    """Give the same as Markdown, for a pull request's summary."""
    found = smallest_found()
    lines = ["## estima check", "", last_line(findings), ""]
    lines += [*(f"- {sentence(f)}" for f in _told(findings)), ""]
    for baseline, rows in _tables(findings):
        heads = " | ".join(LABELS[error] for error in ERRORS)
        lines += [f"| now / {baseline} | {heads} | finds | verdict |", "| --- |" + " --- |" * 5]
        for estimator, of_error, verdict in rows:
            ratios = " | ".join(_ratio(of_error[error]) for error in ERRORS)
            mark = f"**{verdict}**" if verdict in ("worse", "failed") else verdict
            lines.append(f"| {estimator} | {ratios} | {_finds(found, estimator)} | {mark} |")
        lines.append("")
    return "\n".join(lines)


def as_annotations(findings: Sequence[Finding]) -> str:
    """Give GitHub's workflow commands: an error for each alarm, a notice for each improvement."""
    lines = []
    for finding in _told(findings):
        level = "error" if finding.alarms else "notice"
        text = sentence(finding).replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")
        lines.append(f"::{level} title=estima check::{text}")
    return "\n".join(lines)


def as_junit(findings: Sequence[Finding]) -> str:
    """Give JUnit XML: a case for each error of each estimator, a suite for each baseline."""
    root = ET.Element("testsuites", name="estima check")
    for baseline in dict.fromkeys(f.baseline for f in findings):
        group = [f for f in findings if f.baseline == baseline]
        n_failures = sum(f.alarms for f in group)
        suite = ET.SubElement(
            root,
            "testsuite",
            name=f"estima check, {baseline}",
            tests=str(len(group)),
            failures=str(n_failures),
            errors="0",
        )
        for finding in group:
            case = ET.SubElement(
                suite, "testcase", classname=f"{baseline}.{finding.estimator}", name=finding.error
            )
            if finding.alarms:
                failure = ET.SubElement(
                    case, "failure", message=sentence(finding), type=finding.verdict
                )
                failure.text = f"p real {finding.p_real[0]:.2g}, p {finding.p_general[0]:.2g}"
            else:
                ET.SubElement(case, "system-out").text = sentence(finding)
    ET.indent(root)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def write_text(text: str, path: Path) -> None:
    """Write a report, whole or not at all."""
    with write_whole(path) as part:
        part.write_text(text)


def last_line(findings: Sequence[Finding]) -> str:
    """Say how the check ended."""
    alarmed = list(dict.fromkeys(f.estimator for f in findings if f.alarms))
    better = list(dict.fromkeys(f.estimator for f in findings if f.verdict == "better"))
    parts = [f"worse: {', '.join(alarmed)}" if alarmed else "nothing is worse"]
    if better:
        parts.append(f"better: {', '.join(better)}")
    if alarmed:
        parts.append('if it is meant: estima check --accept "REASON"')
    return "; ".join(parts)


def _told(findings: Sequence[Finding]) -> list[Finding]:
    """Findings worth a line: alarms and improvements; an estimator that fails is told once."""
    told, seen = [], set()
    for finding in findings:
        key = (finding.estimator, finding.baseline, finding.message)
        if finding.verdict in ("worse", "better") or (finding.alarms and key not in seen):
            told.append(finding)
            seen.add(key)
    return told


def _tables(
    findings: Sequence[Finding],
) -> list[tuple[str, list[tuple[str, dict[str, Finding], Verdict]]]]:
    tables = []
    for baseline in dict.fromkeys(f.baseline for f in findings):
        rows = []
        for estimator in dict.fromkeys(f.estimator for f in findings):
            group = [f for f in findings if (f.baseline, f.estimator) == (baseline, estimator)]
            verdict = min((f.verdict for f in group), key=_RANK.index)
            rows.append((estimator, {f.error: f for f in group}, verdict))
        tables.append((baseline, rows))
    return tables


def _ratio(finding: Finding) -> str:
    return "-" if math.isnan(finding.ratio) else f"{finding.ratio:.3f}"


def _percent(ratio: float) -> str:
    return f"{100.0 * (ratio - 1.0):+.1f} %"


def _finds(found: dict[str, float], estimator: str) -> str:
    return f"{100.0 * found[estimator]:.1f} %" if estimator in found else "-"
