"""Reproducing: results are replaced as a whole, and what is replaced is told."""

import json
from types import SimpleNamespace

import pandas as pd
import pytest

from experiments.papers import reproduce as module
from experiments.report.claims import Claim, read
from experiments.runs.row import write_frame
from experiments.viewing.style import figure
from sim.errors import InputError

PAPER = "gil2008"


def study(*, names=("runs", "noise"), fails=False):
    """A study in small: a table and a figure a name, and one claim."""

    def run(profile, out, on_progress):
        tables = {name: pd.DataFrame({"profile": [profile]}) for name in names}
        for name, table in tables.items():
            write_frame(table, out / f"{PAPER}_{name}.csv")
        on_progress(1.0)
        return tables

    def figures(tables):
        if fails:
            raise KeyboardInterrupt
        return {f"{PAPER}_{name}": figure(1.0, 1.0) for name in tables}

    def claims(tables, quick):
        claim = Claim("GI1", PAPER, "a share", 0.5, 0.4, 0.6, "above 0", "reproduced")
        return [claim.completed(study=PAPER, command="c", quick=quick)]

    return SimpleNamespace(run=run, figures=figures, claims=claims)


@pytest.fixture
def results(tmp_path, monkeypatch):
    """A folder with the judged results of a study."""
    monkeypatch.setattr(module, "RESULTS", tmp_path)
    take(monkeypatch, study())
    module.reproduce(full=True, only=PAPER)
    write_frame(pd.DataFrame({"best": [1]}), tmp_path / "tables" / f"{PAPER}_tuning.csv")
    return tmp_path


def take(monkeypatch, one):
    monkeypatch.setattr(module, "_study", lambda paper: one)


def state(results):
    """Every table's and figure's name, the profile in the tables, the verdict, and the origin."""
    files = {path.name for kind in ("tables", "figures") for path in (results / kind).iterdir()}
    profile = pd.read_csv(results / "tables" / f"{PAPER}_runs.csv")["profile"][0]
    verdict = read(results / "claims.csv")["verdict"][0]
    made = json.loads((results / "provenance.json").read_text())[PAPER]["profile"]
    return files, profile, verdict, made


FULL = {f"{PAPER}_{n}" for n in ("runs.csv", "noise.csv", "runs.png", "noise.png", "tuning.csv")}


def test_a_quick_run_replaces_everything_and_says_so(results, monkeypatch, capsys):
    assert state(results) == (FULL, "full", "reproduced", "full")
    capsys.readouterr()
    take(monkeypatch, study(names=("runs",)))
    module.reproduce(only=PAPER)
    kept = {f"{PAPER}_{name}" for name in ("runs.csv", "runs.png", "tuning.csv")}
    assert state(results) == (kept, "quick", "reproduced (quick)", "quick")
    assert not list((results / "cache").iterdir())
    told = "replaces the judged results of gil2008; `git checkout results` brings them back"
    assert told in capsys.readouterr().err
    module.reproduce(only=PAPER)
    assert "judged" not in capsys.readouterr().err


def test_an_interrupted_run_leaves_the_results_as_they_were(results, monkeypatch):
    before = {path: path.read_bytes() for path in results.rglob("*.*") if path.is_file()}
    take(monkeypatch, study(names=("runs", "other"), fails=True))
    with pytest.raises(KeyboardInterrupt):
        module.reproduce(only=PAPER)
    assert before == {path: path.read_bytes() for path in results.rglob("*.*") if path.is_file()}


def test_what_cannot_be_replaced_or_added_to_is_named(results):
    path = results / "figures" / f"{PAPER}_runs.png"
    path.unlink()
    path.mkdir()
    with pytest.raises(InputError, match=r"gil2008_runs\.png: cannot be replaced"):
        module.reproduce(only=PAPER)
    (results / "claims.csv").write_text("id,paper")
    with pytest.raises(InputError, match=r"claims\.csv: the last row is cut off"):
        module.reproduce(only=PAPER)
