"""Every report of a check says the same, safely, and where it is asked for."""

import dataclasses
import math
import xml.etree.ElementTree as ET
from contextlib import contextmanager

import numpy as np
import pandas as pd
import pytest

from experiments.gate import compare as regress
from experiments.gate import report as regress_report
from experiments.gate.suite import (
    ERRORS,
    read_suite,
    run_suite,
)
from sim.errors import InputError
from tests.experiments.gate.conftest import no_run, of_recordings, table

QUICK = [
    "world=room",
    "world.n_landmarks=0",
    "route.distance_m=2",
    "simulation.physics=kinematic",
    "simulation.rays=exact",
]


def findings():
    rng = np.random.default_rng(4)
    then = of_recordings(rng)
    now = pd.concat(
        [
            table("worse <&>", then * 1.2 * np.exp(0.05 * rng.standard_normal(then.shape))),
            table("better", then * 0.8 * np.exp(0.05 * rng.standard_normal(then.shape))),
            table("same", then),
        ]
    )
    baseline = pd.concat([table(name, then) for name in ("worse <&>", "better", "same")])
    found = regress.compare({"accepted": baseline}, now)
    return [dataclasses.replace(each, worst=()) for each in found]  # of no suite


def test_reports_agree(monkeypatch, tmp_path, capsys):
    found = findings()
    finds = regress_report.smallest_found()
    assert all(share > 0.0 for share in finds.values())
    text, page = (
        report(found, finds) for report in (regress_report.as_text, regress_report.as_markdown)
    )
    assert "finds" in text
    assert "finds" in page
    for report in (text, page):
        assert "worse: worse <&>" in report
        assert "better: better" in report
        assert "1.000" in report
    notes = regress_report.as_annotations(found).splitlines()
    assert len(notes) == 6
    assert sum(note.startswith("::error title=estima check::worse") for note in notes) == 3
    assert all("%25" in note and "% " not in note for note in notes)
    root = ET.fromstring(regress_report.as_junit(found))
    suite = root.find("testsuite")
    assert (suite.get("tests"), suite.get("failures")) == ("9", "3")
    assert {case.get("classname") for case in suite if case.find("failure") is not None} == {
        "accepted.worse <&>"
    }
    step = tmp_path / "step.md"
    monkeypatch.setattr(regress_report, "check", lambda *_: found)
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(step))
    junit, summary = tmp_path / "j.xml", tmp_path / "s.md"
    assert regress_report.run_check("check", None, junit=junit, summary=summary)
    assert "::error" in capsys.readouterr().out
    assert step.read_text() == summary.read_text() == page
    assert ET.parse(junit).getroot().tag == "testsuites"
    with pytest.raises(InputError, match="--release goes with"):
        regress_report.run_check("check", None, release=True)


def test_the_power_of_the_main_suite_is_not_stated_of_others(small, monkeypatch, capsys):
    monkeypatch.setattr(regress_report, "check", lambda *_: findings())
    regress_report.run_check("check", None)
    assert "finds" in capsys.readouterr().out
    regress_report.run_check(str(small), None)
    assert "finds" not in capsys.readouterr().out
    assert "finds" not in regress_report.as_markdown(findings())


def test_the_interval_is_that_of_the_test():
    """Beside every verdict stands an interval without zero, and by how much it improved."""
    rng = np.random.default_rng(8)
    then, p_of = of_recordings(rng, 30), {}
    noise = 0.1 * rng.standard_normal((30, 1))
    for shift in np.linspace(-0.06, 0.06, 61):
        now = then * np.exp(noise - noise.mean() + shift)
        for found in regress.compare({"accepted": table("e", then)}, table("e", now))[:1]:
            p_of[shift] = min(found.p_general)
            apart = found.low > 1.0 or found.high < 1.0
            assert apart == (min(found.p_general) <= 0.05)
            assert apart or found.verdict == "changed"
            if found.verdict in ("worse", "better"):
                words = regress_report.sentence(found)
                size = 100.0 * abs(math.expm1(shift))
                assert f"{found.verdict} by {size:.1f} % (90 % interval: " in words
                assert "-" not in words
    assert any(0.025 < p <= 0.05 for p in p_of.values())  # where a 95 % interval holds zero


def test_messages_are_made_printable(small):
    @contextmanager
    def broken(estimator, rng):
        raise ValueError("a\x00b\x1b[31m\ud800\ufffe\r<c> \u00e9")
        yield estimator

    now = run_suite(read_suite(small), {"odometry": 1}, planted={"odometry": broken}, n_jobs=1)
    raw = now.assign(status="ValueError: a\x00b\x1b[31m\x85\ufffe\r<c> \u00e9")
    then = now.assign(status="ok", **dict.fromkeys(ERRORS, 1.0))
    found = regress.compare({"accepted": then}, raw)
    assert regress.compare({"accepted": then}, now)[0].message == found[0].message.translate(
        {0: "?", 0x1B: "?", 0x85: "?", 0xFFFE: "?", 13: " "}
    )
    failures = ET.fromstring(regress_report.as_junit(found)).findall(".//failure")
    assert len(failures) == 3
    assert failures[0].get("message").endswith("ValueError: a?b?[31m???<c> \u00e9")
    for report in (regress_report.as_text, regress_report.as_annotations):
        assert "a?b?[31m???<c>" in report(found)
        assert all(c.isprintable() or c == "\n" for c in report(found))


@pytest.mark.parametrize("where", ["junit", "summary", "step"])
def test_reports_that_cannot_be_written_are_refused_before_the_run(where, tmp_path, monkeypatch):
    monkeypatch.setattr(regress_report, "check", no_run)
    (tmp_path / "file").touch()
    for path in (tmp_path / "file" / "report", tmp_path):
        options = {where: path}
        if options.pop("step", None):
            monkeypatch.setenv("GITHUB_ACTIONS", "true")
            monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(path))
        with pytest.raises(InputError, match="cannot write a report there"):
            regress_report.run_check("check", None, **options)


def test_a_folder_is_made_for_the_job_summary(tmp_path, monkeypatch):
    page = tmp_path / "new" / "step.md"
    monkeypatch.setattr(regress_report, "check", lambda *_: findings())
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(page))
    assert regress_report.run_check("check", None)
    assert page.read_text().startswith("## estima check")
