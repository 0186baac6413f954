"""Reports of a check: as text, to GitHub (annotations, a summary), and as JUnit XML."""

import math
import os
import shlex
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import pandas as pd

from experiments.gate.baseline import accept, baseline_folder, baseline_paths, check, is_main
from experiments.gate.compare import Change, Finding
from experiments.gate.suite import Suite, command_of, draw_run, read_suite, suite_path
from experiments.report.export import escape_markdown, to_markdown
from experiments.runs.columns import COLUMNS
from experiments.runs.console import progress, show, warn
from experiments.runs.paths import is_trusting, results, short
from experiments.sweeps.commands import config_dir_option
from sim.errors import InputError, printable, require
from sim.files import write_text

LABELS = {"ate_rmse_m": "position", "ate_aligned_rmse_m": "aligned", "heading_rmse_rad": "heading"}
_MEANING = {
    Change.IDENTICAL: "same errors to rounding",
    Change.EQUAL: "no difference shown",
    Change.CHANGED: "other errors, neither worse nor better on the whole",
}


def run_check(
    suite: str,
    reason: str | None,
    only: Sequence[str] = (),
    *,
    release: bool = False,
    junit: Path | None = None,
    summary: Path | None = None,
    candidate: Path | None = None,
    config_dir: Path | None = None,
) -> bool:
    """Do what `estima check` does; return whether it found a worsening."""
    if reason is not None:
        with progress("checking the estimators", 1.0) as on_progress:
            accepted = accept(
                suite,
                reason,
                only,
                release=release,
                on_progress=on_progress,
                candidate=candidate,
                config_dir=config_dir,
            )
        show(as_text(accepted.findings, hint=""))
        for path in accepted.written:
            show(f"accepted: {short(path)}")
        for path in accepted.copied:
            show(f"copied, unchanged: {short(path)}")
        left = [f for f in accepted.findings if f.alarms and f.baseline == "release"]
        if left and not release:
            again = command_again(suite, left, candidate, config_dir)
            show(
                "worse than the release baseline, and checks will say so until you pin it again: "
                f'{again} --accept "REASON" --release'
            )
        return False
    require(not release, "--release goes with --accept REASON")
    on_github = os.environ.get("GITHUB_ACTIONS") == "true"
    page = os.environ.get("GITHUB_STEP_SUMMARY") if on_github else None
    for report in (junit, summary, page):
        if report:
            _check_writable(Path(report))
    detectable = smallest_found() if is_main(suite) else {}
    paths = baseline_paths(suite)
    if paths["accepted"].exists() and not paths["release"].exists():
        warn(
            f"estima: {paths['release']}: no release baseline, so small steps can add "
            "up unseen; pin one with --accept REASON --release"
        )
    with progress("checking the estimators", 1.0) as on_progress:
        findings = check(suite, only, on_progress, candidate, config_dir)
    again = command_again(suite, [f for f in findings if f.alarms], candidate, config_dir)
    hint = f'if it is intended: {again} --accept "REASON"'
    show(as_text(findings, detectable, hint=hint))
    show(_where_to_look(read_suite(suite_path(suite), config_dir), findings))
    if junit is not None:
        write_text(junit, as_junit(findings))
    if summary is not None:
        write_text(summary, as_markdown(findings, detectable))
    if on_github:
        show(as_annotations(findings))
    if page:
        with Path(page).open("a", encoding="utf-8") as file:
            file.write(as_markdown(findings, detectable))
    return any(finding.alarms for finding in findings)


def _check_writable(path: Path) -> None:
    """Refuse before the run, and not after it, a place where no report can be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") if path.exists() else tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InputError(
            f"{path}: cannot write a report there ({error.strerror}); choose another place"
        ) from error


def smallest_found() -> dict[str, float]:
    """Smallest worsening of each estimator, as a share, that 95 % of checks of the suite find."""
    power = baseline_folder() / "power.csv"  # what experiments.gate.power measured
    if not power.exists():
        return {}
    try:
        table = pd.read_csv(power, comment="#")
        smallest: pd.Series[float] = table.groupby("estimator")["smallest"].max().astype(float)
        return {str(name): share for name, share in smallest.items()}
    except (OSError, ValueError, TypeError, KeyError) as error:
        why = str(error).splitlines()[0]
        raise InputError(
            f"{power}: damaged ({why}); restore it, e.g. git checkout -- {power}"
        ) from error


def command_again(
    suite: str, findings: Sequence[Finding], candidate: Path | None, config_dir: Path | None
) -> str:
    """The same command for the estimators of some findings."""
    names = dict.fromkeys(finding.estimator for finding in findings)
    return shlex.join(
        [
            *["estima", *["--trust"] * is_trusting(), "check"],
            *([] if is_main(suite) else ["--suite", suite]),
            *(["--candidate", str(candidate)] if candidate else []),
            *config_dir_option(config_dir),
            *(word for name in names for word in ("--only", name)),
        ]
    )


def _where_to_look(whole: Suite, findings: Sequence[Finding]) -> str:
    """Worst recordings of each worsened estimator, and the command that draws the worst of them."""
    lines = []
    for finding in {f.estimator: f for f in reversed(findings) if f.alarms and f.worst}.values():
        unit = COLUMNS[finding.error].unit
        lines += [
            f"{finding.estimator}, seed {seed}: {LABELS[finding.error]} error "
            f"{then:.3g} {unit} before, {now:.3g} {unit} now"
            for seed, then, now in finding.worst
            if math.isfinite(then)
        ]
        seed = finding.worst[0][0]
        (entry,) = whole.select([finding.estimator]).estimators
        if entry.elsewhere:
            lines.append(f"look at its trajectory of {entry.recordings}_{seed}")
            continue
        picture = results() / "runs" / "check" / f"{finding.estimator}_{seed}.png"
        if draw_run(whole, finding.estimator, seed, picture):
            lines.append(f"the worst of them: {short(picture)}")
        lines.append(f"run it alone: {command_of(whole, finding.estimator, seed)}")
    return "\n".join(lines)


def sentence(finding: Finding) -> str:
    """One finding in one line of printable characters."""
    who = f"{finding.estimator}, {LABELS[finding.error]} error"
    if finding.verdict is Change.FAILED:
        return printable(f"{finding.estimator}: {finding.message}")
    if finding.verdict in _MEANING:
        return printable(f"{who}: {_MEANING[finding.verdict]}")
    ends = sorted((finding.low, finding.high), key=lambda ratio: abs(ratio - 1.0))
    by, least, most = (abs(100.0 * (ratio - 1.0)) for ratio in (finding.ratio, *ends))
    p = finding.p_general[(Change.WORSE, Change.BETTER).index(finding.verdict)]
    return printable(
        f"{who} {finding.verdict} by {by:.1f} % (90 % interval: {least:.1f} to {most:.1f} %; "
        f"{finding.n_recordings} recordings, p {p:.1g}) than the "
        f"{finding.baseline} baseline"
    )


def as_text(
    findings: Sequence[Finding], detectable: Mapping[str, float] | None = None, hint: str = ""
) -> str:
    """Tables for a terminal, a line for each finding that counts, and a last line.

    Parameters
    ----------
    detectable
        What `smallest_found` gives, if the suite is the one it was measured on.
    hint
        What to do if a worsening is intended.
    """
    lines = [f"{table.to_string(index=False)}\n" for table in _tables(findings, detectable)]
    lines += [sentence(finding) for finding in _noteworthy(findings)]
    if detectable:
        lines.append("finds: the smallest worsening that 95 % of checks find (docs/regression.md)")
    return "\n".join([*lines, last_line(findings, hint)])


def as_markdown(findings: Sequence[Finding], detectable: Mapping[str, float] | None = None) -> str:
    """Give the same as Markdown, for a pull request's summary."""
    lines = ["## estima check", "", last_line(findings), ""]
    lines += [*(f"- {escape_markdown(sentence(f))}" for f in _noteworthy(findings)), ""]
    for table in _tables(findings, detectable):
        bold = table["verdict"].str.replace("^(worse|failed)", r"**\1**", regex=True)
        lines.append(to_markdown(table.assign(verdict=bold)))
    return "\n".join(lines)


def _tables(
    findings: Sequence[Finding], detectable: Mapping[str, float] | None
) -> Iterator[pd.DataFrame]:
    """Table of each baseline: the ratios of each estimator's errors, and its gravest verdict."""
    for baseline in dict.fromkeys(f.baseline for f in findings):
        rows = []
        for estimator in dict.fromkeys(f.estimator for f in findings):
            group = [f for f in findings if (f.baseline, f.estimator) == (baseline, estimator)]
            row = {f"now / {baseline}": estimator}
            row |= {LABELS[f.error]: _number(f.ratio, ".3f") for f in group}
            if detectable:
                row["finds"] = _number(100.0 * detectable.get(estimator, math.nan), ".1f", " %")
            row["verdict"] = min((f.verdict for f in group), key=list(Change).index).value
            n, n_suite = min((f.n_recordings, f.n_suite) for f in group)
            if n < n_suite:
                row["verdict"] += f" ({n} of {n_suite} recordings)"
            rows.append(row)
        yield pd.DataFrame(rows)


def _number(value: float, form: str, unit: str = "") -> str:
    return "-" if math.isnan(value) else f"{value:{form}}{unit}"


def as_annotations(findings: Sequence[Finding]) -> str:
    """Give GitHub's workflow commands: an error for each alarm, a notice for each improvement."""
    return "\n".join(
        f"::{'error' if finding.alarms else 'notice'} title=estima check::"
        + sentence(finding).replace("%", "%25")
        for finding in _noteworthy(findings)
    )


def as_junit(findings: Sequence[Finding]) -> str:
    """Give JUnit XML: a case for each error of each estimator, a suite for each baseline."""
    root = ET.Element("testsuites", name="estima check")
    for baseline in dict.fromkeys(f.baseline for f in findings):
        group = [f for f in findings if f.baseline == baseline]
        suite = ET.SubElement(
            root,
            "testsuite",
            name=f"estima check, {baseline}",
            tests=str(len(group)),
            failures=str(sum(f.alarms for f in group)),
            errors="0",
        )
        for finding in group:
            case = ET.SubElement(
                suite, "testcase", classname=f"{baseline}.{finding.estimator}", name=finding.error
            )
            words = sentence(finding)
            if finding.alarms:
                failure = ET.SubElement(case, "failure", message=words, type=finding.verdict)
                failure.text = f"p real {finding.p_real[0]:.2g}, p {finding.p_general[0]:.2g}"
            else:
                ET.SubElement(case, "system-out").text = words
    ET.indent(root)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def last_line(findings: Sequence[Finding], hint: str = "") -> str:
    """Say how the check ended, with a hint if something is worse."""
    alarmed = ", ".join(dict.fromkeys(f.estimator for f in findings if f.alarms))
    better = ", ".join(dict.fromkeys(f.estimator for f in findings if f.verdict is Change.BETTER))
    parts = (
        f"worse: {alarmed}" if alarmed else "nothing is worse",
        f"better: {better}" if better else "",
        hint if alarmed else "",
    )
    return "; ".join(filter(None, parts))


def _noteworthy(findings: Sequence[Finding]) -> list[Finding]:
    """Findings worth a line: alarms and improvements; one failure counts once for all baselines."""
    chosen: dict[tuple[object, ...], Finding] = {}
    for f in findings:
        if f.verdict in (Change.WORSE, Change.BETTER, Change.FAILED):
            chosen.setdefault((f.estimator, f.message or (f.error, f.baseline)), f)
    return list(chosen.values())
