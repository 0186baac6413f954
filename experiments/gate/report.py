"""What a check says: to people, to GitHub (annotations, a summary), and as JUnit XML."""

from __future__ import annotations

import math
import os
import sys
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas as pd

from experiments.gate.baseline import accept, baseline_folder, baseline_paths, check, is_main
from experiments.gate.compare import Finding, Verdict
from experiments.gate.suite import ERRORS, printable
from experiments.report.export import to_markdown
from experiments.runs.console import progress
from sim.errors import InputError
from sim.files import write_whole

LABELS = {"ate_rmse_m": "position", "ate_aligned_rmse_m": "aligned", "heading_rmse_rad": "heading"}
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
    on_github = os.environ.get("GITHUB_ACTIONS") == "true"
    page = os.environ.get("GITHUB_STEP_SUMMARY") if on_github else None
    for path in (junit, summary, Path(page) if page else None):
        if path is not None and reason is None:
            _writable(path)
    found = smallest_found() if is_main(suite) and reason is None else {}
    paths = baseline_paths(suite)
    if reason is None and paths["accepted"].exists() and not paths["release"].exists():
        print(
            f"estima: {paths['release']}: no release baseline, so small steps can add "
            "up unseen; pin one with --accept REASON --release",
            file=sys.stderr,
        )
    with progress("estimators over recordings, share", 1.0) as on_progress:
        if reason is not None:
            for path in accept(suite, reason, only, release=release, on_progress=on_progress):
                print(path)
            return False
        findings = check(suite, only, on_progress)
    _say(as_text(findings, found))
    if junit is not None:
        write_text(as_junit(findings), junit)
    if summary is not None:
        write_text(as_markdown(findings, found), summary)
    if on_github:
        _say(as_annotations(findings))
        if page:
            with Path(page).open("a", encoding="utf-8") as file:
                file.write(as_markdown(findings, found))
    return any(finding.alarms for finding in findings)


def _writable(path: Path) -> None:
    """Tell before a run, and not after it, that a report has no place."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") if path.exists() else tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InputError(
            f"{path}: cannot write a report there ({error.strerror}); choose another place"
        ) from error


def _say(text: str) -> None:
    """Print, with ? for letters that the terminal does not have."""
    encoding = sys.stdout.encoding or "utf-8"
    print(text.encode(encoding, "replace").decode(encoding))


def smallest_found() -> dict[str, float]:
    """Smallest worsening of each estimator, as a share, that 95 % of checks of the suite find."""
    power = baseline_folder() / "power.csv"  # what experiments.gate.power measured
    if not power.exists():
        return {}
    try:
        table = pd.read_csv(power, comment="#")
        return {str(k): float(v) for k, v in table.groupby("estimator")["smallest"].max().items()}
    except (OSError, ValueError, TypeError, KeyError) as error:
        why = str(error).splitlines()[0]
        raise InputError(
            f"{power}: damaged ({why}); restore it, e.g. git checkout -- {power}"
        ) from error


def sentence(finding: Finding) -> str:
    """One finding in one line of printable characters."""
    who = f"{finding.estimator}, {LABELS[finding.error]} error"
    if finding.verdict == "failed":
        return printable(f"{finding.estimator}: {finding.message}")
    if finding.verdict in _MEANING:
        return printable(f"{who}: {_MEANING[finding.verdict]}")
    side, ends = (0, (finding.low, finding.high))
    if finding.verdict == "better":
        side, ends = (1, (finding.high, finding.low))
    by, least, most = (abs(100.0 * (ratio - 1.0)) for ratio in (finding.ratio, *ends))
    return printable(
        f"{who} {finding.verdict} by {by:.1f} % (90 % interval: {least:.1f} to {most:.1f} %; "
        f"{finding.n_recordings} recordings, p {finding.p_general[side]:.1g}) than the "
        f"{finding.baseline} baseline"
    )


def as_text(findings: Sequence[Finding], found: Mapping[str, float] | None = None) -> str:
    """Tables for a terminal, a line for each finding that counts, and a last line.

    Parameters
    ----------
    found
        What `smallest_found` gives, if the suite is the one it was measured on.
    """
    lines: list[str] = []
    for baseline, rows in _tables(findings):
        heads = " ".join(f"{LABELS[error]:>9}" for error in ERRORS)
        finds = f"{'finds':>7}  " if found else ""
        lines += [f"now / {baseline} baseline", f"  {'':<16} {heads}  {finds}verdict"]
        for estimator, of_error, verdict in rows:
            ratios = " ".join(f"{_ratio(of_error[error]):>9}" for error in ERRORS)
            finds = f"{_finds(found, estimator):>7}  " if found else ""
            lines.append(f"  {estimator:<16} {ratios}  {finds}{verdict}{_share(of_error)}")
        lines.append("")
    lines += [sentence(f) for f in _told(findings)]
    if found:
        lines.append("finds: the smallest worsening that 95 % of checks find (docs/regression.md)")
    return "\n".join([*lines, last_line(findings)])


def as_markdown(findings: Sequence[Finding], found: Mapping[str, float] | None = None) -> str:
    """Give the same as Markdown, for a pull request's summary."""
    lines = ["## estima check", "", last_line(findings), ""]
    lines += [*(f"- {sentence(f)}" for f in _told(findings)), ""]
    for baseline, rows in _tables(findings):
        table = []
        for estimator, of_error, verdict in rows:
            mark = f"**{verdict}**" if verdict in ("worse", "failed") else verdict
            table.append(
                {
                    f"now / {baseline}": estimator,
                    **{LABELS[error]: _ratio(of_error[error]) for error in ERRORS},
                    **({"finds": _finds(found, estimator)} if found else {}),
                    "verdict": mark + _share(of_error),
                }
            )
        lines.append(to_markdown(pd.DataFrame(table)))
    return "\n".join(lines)


def as_annotations(findings: Sequence[Finding]) -> str:
    """Give GitHub's workflow commands: an error for each alarm, a notice for each improvement."""
    lines = []
    for finding in _told(findings):
        level = "error" if finding.alarms else "notice"
        text = sentence(finding).replace("%", "%25")
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
        part.write_text(text, encoding="utf-8")


def last_line(findings: Sequence[Finding]) -> str:
    """Say how the check ended."""
    alarmed = list(dict.fromkeys(f.estimator for f in findings if f.alarms))
    better = list(dict.fromkeys(f.estimator for f in findings if f.verdict == "better"))
    parts = [f"worse: {', '.join(alarmed)}" if alarmed else "nothing is worse"]
    if better:
        parts.append(f"better: {', '.join(better)}")
    if alarmed:
        parts.append('if it is meant: check with --accept "REASON"')
    return "; ".join(parts)


def _told(findings: Sequence[Finding]) -> list[Finding]:
    """Findings worth a line: alarms and improvements; a failure is told once for all baselines."""
    told, seen = [], set()
    for finding in findings:
        key = (finding.estimator, finding.message)
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


def _share(of_error: Mapping[str, Finding]) -> str:
    """How many recordings were compared, where it is not all of them."""
    n, n_suite = min((f.n_recordings, f.n_suite) for f in of_error.values())
    return f" ({n} of {n_suite} recordings)" if n < n_suite else ""


def _finds(found: Mapping[str, float], estimator: str) -> str:
    return f"{100.0 * found[estimator]:.1f} %" if estimator in found else "-"
