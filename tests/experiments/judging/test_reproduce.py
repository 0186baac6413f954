"""Reproducing: results are replaced as a whole, and what is replaced is said."""

import json
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from experiments import reproduce as module
from experiments.evaluation.statistics import Interval
from experiments.judging.claim import Claim, Subject, Verdict
from experiments.judging.claims_file import read_claims, read_verdicts
from experiments.judging.folders import findings
from experiments.runs.row import write_frame
from experiments.viewing.style import figure
from sim.errors import InputError

PAPER = "gil2008"


def study(*, names=("runs", "noise"), fails=False):
    """The parts of a paper's folder in small: a table and a figure a name, and one claim."""

    def run(profile, out, on_progress):
        for name in names:
            out.write_tables(**{name: pd.DataFrame({"profile": [str(profile)]})})
            out.write_arrays(name, path=np.zeros((2, 3)))
        on_progress(1.0)

    def draw(made):
        if fails:
            raise KeyboardInterrupt
        for name in names:
            assert made.arrays(name)["path"].shape == (2, 3)
        return {f"{PAPER}_{name}": figure(1.0, 1.0) for name in names}

    def judge(made):
        assert len(made.table("runs")) == 1
        found = Interval(0.5, 0.4, 0.6)
        return [Claim(Subject("GI1", "share"), "a share", found, "above 0", Verdict.REPRODUCED)]

    return {
        "study": SimpleNamespace(run=run, __name__=f"experiments.papers.{PAPER}.study"),
        "figures": SimpleNamespace(draw=draw, __name__=f"experiments.papers.{PAPER}.figures"),
        "claims": SimpleNamespace(judge=judge, __name__=f"experiments.papers.{PAPER}.claims"),
    }


@pytest.fixture
def results(tmp_path, monkeypatch):
    """A folder with the judged results of a study."""
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path))
    take(monkeypatch, study())
    module.reproduce(only=PAPER)
    write_frame(pd.DataFrame({"best": [1]}), tmp_path / "tables" / f"{PAPER}_tuning.csv")
    return tmp_path


def take(monkeypatch, parts):
    monkeypatch.setattr(module, "_part", lambda paper, name: parts[name])
    said = "The share is {{ rows[0].found.value }}. Half of it."
    about = findings(PAPER) | {"sentences": {"GI1": said}}
    monkeypatch.setattr(module, "findings", lambda paper: about)


def state(results):
    """Every file's name, the profile in the tables, the verdict and its profile, the origin."""
    kinds = ("tables", "arrays", "figures")
    files = {path.name for kind in kinds for path in (results / kind).iterdir()}
    profile = pd.read_csv(results / "tables" / f"{PAPER}_runs.csv")["profile"][0]
    claim = read_claims(results / "claims.csv").iloc[0]
    verdict = f"{claim['verdict']}, {claim['profile']}"
    made = json.loads((results / "provenance.json").read_text())[PAPER]["profile"]
    return files, profile, verdict, made


ENDINGS = (".csv", ".npz", ".png")
FULL = {f"{PAPER}_{n}{e}" for n in ("runs", "noise") for e in ENDINGS} | {f"{PAPER}_tuning.csv"}


def test_a_run_replaces_everything(results, monkeypatch):
    assert state(results) == (FULL, "full", "reproduced, full", "full")
    take(monkeypatch, study(names=("runs",)))
    module.reproduce(only=PAPER)
    kept = {f"{PAPER}_{name}" for name in ("runs.csv", "runs.npz", "runs.png", "tuning.csv")}
    assert state(results) == (kept, "full", "reproduced, full", "full")
    assert {path.name for path in (results / "cache").iterdir()} <= {"sources.json"}


def test_each_claim_gets_one_row_and_one_line(results, capsys):
    found = read_verdicts(results / "verdicts.csv")
    (row,) = found.dropna(axis="columns").to_dict("records")  # no region: its cells are empty
    assert row == {
        "id": "GI1",
        "paper": PAPER,
        "says": "The error of odometry grows without bound, that of the filter stays within an "
        "interval, in position and in heading.",
        "verdict": "reproduced",
        "sentence": "The share is 0.5. Half of it.",
    }
    capsys.readouterr()
    module.reproduce(only=PAPER)
    claim, blank, paper, page = capsys.readouterr().out.splitlines()
    assert claim == "GI1  reproduced      The share is 0.5."
    assert blank == ""
    assert paper.startswith("gil2008: 1 reproduced (")
    assert "report.html" in page


def test_an_interrupted_run_leaves_the_results_as_they_were(results, monkeypatch):
    def files():
        paths = [path for path in results.rglob("*.*") if path.is_file()]
        return {path: path.read_bytes() for path in paths if path.parent.name != "cache"}

    before = files()
    take(monkeypatch, study(names=("runs", "other"), fails=True))
    with pytest.raises(KeyboardInterrupt):
        module.reproduce(only=PAPER)
    assert before == files()


def test_what_cannot_be_replaced_or_added_to_is_named(results):
    path = results / "figures" / f"{PAPER}_runs.png"
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match=r"gil2008_runs\.png: cannot be replaced"):
        module.reproduce(only=PAPER)
    (results / "verdicts.csv").write_text("id,paper")
    with pytest.raises(InputError, match=r"verdicts\.csv: the last row is cut off"):
        module.reproduce(only=PAPER)
    (results / "claims.csv").write_text("id,paper")
    with pytest.raises(InputError, match=r"claims\.csv: the last row is cut off"):
        module.reproduce(only=PAPER)


def test_a_part_replaces_its_own_tables_alone(results, monkeypatch):
    def one(profile, on_progress):
        return {"noise": pd.DataFrame({"profile": ["again"]})}

    parts = study()
    parts["study"].PARTS = {"noise": one}
    take(monkeypatch, parts)
    before = json.loads((results / "built.json").read_text())["items"]
    runs = (results / "tables" / f"{PAPER}_runs.csv").read_bytes()
    module.reproduce(only=PAPER, part="noise")
    assert pd.read_csv(results / "tables" / f"{PAPER}_noise.csv")["profile"].tolist() == ["again"]
    assert (results / "tables" / f"{PAPER}_runs.csv").read_bytes() == runs
    after = json.loads((results / "built.json").read_text())["items"]
    assert after[f"tables/{PAPER}_runs.csv"] == before[f"tables/{PAPER}_runs.csv"]
    assert state(results) == (FULL, "full", "reproduced, full", "full")
    with pytest.raises(
        InputError, match="gil2008 has no part 'runs' to be made alone; it has noise"
    ):
        module.reproduce(only=PAPER, part="runs")


def test_figures_are_drawn_again_from_disk(results, monkeypatch, capsys):
    path = results / "figures" / f"{PAPER}_runs.png"
    path.unlink()
    module.redraw(only=PAPER)
    assert path.exists()
    (results / "arrays" / f"{PAPER}_runs.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"gil2008_runs\.npz: damaged .*--paper gil2008 --full"):
        module.redraw(only=PAPER)
    (results / "arrays" / f"{PAPER}_runs.npz").unlink()
    with pytest.raises(InputError, match=r"gil2008_runs\.npz: missing"):
        module.redraw(only=PAPER)
    take(monkeypatch, study(names=()))
    module.redraw()
    assert "maximo2024: left out, no tables" in capsys.readouterr().err
    for only, line in (("maximo2024", "of maximo2024"), (None, "of any paper")):
        monkeypatch.setenv("ESTIMA_RESULTS", str(results / "bare"))
        with pytest.raises(InputError, match=rf"tables: no tables {line}; run `estima reproduce"):
            module.redraw(only=only)


REMEDY = r"; run `estima reproduce --paper gil2008 --full`$"


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("arrays/gil2008_runs.npz", b"", r"gil2008_runs\.npz: damaged \(.+\)"),
        ("arrays/gil2008_runs.npz", {"other": [1]}, r"gil2008_runs\.npz: .*\('path' missing\)"),
        ("tables/gil2008_runs.csv", b"", r"gil2008_runs\.csv: cannot read this table \(.+\)"),
        ("tables/gil2008_runs.csv", b"profile\n", r"gil2008_runs\.csv: damaged \(no rows\)"),
        ("tables/gil2008_runs.csv", b"other\n1\n", r"of gil2008 are .*\('profile' missing\)"),
        ("tables/gil2008_runs.csv", b"profile\n1\n", r"of gil2008 are damaged or of another .*"),
    ],
)
def test_files_without_their_content_end_in_one_line(results, monkeypatch, name, content, line):
    def draw(made):
        return {made.table("runs")["profile"].str.upper()[0]: made.arrays("runs")["path"]}

    take(monkeypatch, {**study(), "figures": SimpleNamespace(draw=draw, __name__="figures")})
    if isinstance(content, dict):
        np.savez(results / name, **content)
    else:
        (results / name).write_bytes(content)
    with pytest.raises(InputError, match=line + REMEDY) as caught:
        module.redraw(only=PAPER)
    assert "\n" not in str(caught.value)


def test_a_programming_error_in_a_fresh_study_keeps_its_trace(results, monkeypatch):
    def run(profile, out, on_progress):
        raise KeyError("a slip of ours")

    take(monkeypatch, {**study(), "study": SimpleNamespace(run=run, __name__="study")})
    with pytest.raises(KeyError, match="a slip of ours"):
        module.reproduce(only=PAPER)
