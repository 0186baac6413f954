"""Errors over the commits: what is marked, what the file refuses, and the page in a browser."""

import re

import numpy as np
import pandas as pd
import pytest

from experiments.bench.against import git
from experiments.evaluation.statistics import Interval
from experiments.gate import history, history_page
from experiments.gate.history import NEW, STEP, append, history_path, read_history, trace
from experiments.gate.history_page import address_of, as_text, changes, run_history
from sim.errors import InputError
from tests.experiments.gate.conftest import table
from tests.fixtures import browser

EVIL = "</script><img src=x onerror=alert(1)>"
N = 12
N_RECORDINGS = 30


def commit_of(number):
    return f"{number:04x}" * 10


def rows_at(number, name="e", repeats=1):
    """Errors of a method that gets 20 % worse at commit 4 and better again at commit 8."""
    rng = np.random.default_rng(0)
    scatter, own = rng.lognormal(size=(N_RECORDINGS, 1)), rng.uniform(0.5, 1.5, (N_RECORDINGS, 1))
    rise = 1.2 if 4 <= number < 8 else 1.0
    noise = np.random.default_rng([1, number]).normal(0.0, 0.02, (N_RECORDINGS, repeats))
    return table(name, scatter * rise**own * np.exp(noise * (repeats > 1)))


def history_of(n=N):
    """Rows of commits, of a deterministic method and of one that draws; steps of the former."""
    every = []
    for number in range(n):
        rows = pd.concat([rows_at(number), rows_at(0, "still").assign(estimator="still"),
                          rows_at(number, "drawn", 2)])  # fmt: skip
        rows = rows.assign(commit=commit_of(number), committed_s=1e9 + 1e5 * number, depth=1.0)
        slow = 1.3 if number >= 6 else 1.0
        is_timed = rows["estimator"] == "e"
        every.append(
            rows.assign(
                subject=f"change {number} {EVIL}",
                against=np.where(is_timed, "a" * 40, ""),
                step_ratio=np.where(is_timed, slow, np.nan),
                step_low=np.where(is_timed, slow / 1.03, np.nan),
                step_high=np.where(is_timed, slow * 1.03, np.nan),
            )
        )
    return pd.concat(every, ignore_index=True)


@pytest.fixture(scope="module")
def rows():
    return history_of()


def marks(points, estimator, metric="ate_rmse_m"):
    line = points[(points["estimator"] == estimator) & (points["metric"] == metric)]
    return {int(n): mark for n, mark in zip(line["number"], line["mark"], strict=True) if mark}


@pytest.mark.slow
def test_changes_are_marked_where_they_were_planted(rows):
    points = trace(rows)
    for name in ("e", "drawn"):
        assert marks(points, name) == {0: NEW, 4: "worse", 8: "better"}
    assert marks(points, "still") == {0: NEW}
    assert marks(points, "e", STEP) == {0: NEW, 6: "worse"}
    at = points[(points["estimator"] == "e") & (points["metric"] == "ate_rmse_m")]
    first = at[at["number"] == 0].iloc[0]
    assert first["value"] == pytest.approx(np.exp(np.log(rows_at(0)["ate_rmse_m"]).mean()))
    worse = at[at["number"] == 4].iloc[0]
    assert worse["change"] == pytest.approx(worse["value"] / first["value"])
    assert worse["low"] < worse["value"] < worse["high"]
    text = as_text(rows)
    assert re.search(r"0004000400 2001-09-13 e, position error, m: worse, 1\.\d+ times: ", text)


def test_small_steps_add_up():
    """Each is too small to be seen beside the commit before it."""
    every = []
    for number in range(10):
        noise = np.random.default_rng(number).normal(0.0, 0.1, (N_RECORDINGS, 4))
        rows = table("e", np.exp(noise + 0.02 * number))
        every.append(
            rows.assign(commit=commit_of(number), committed_s=number, depth=1.0, subject="")
        )
    cells = {"against": "", "step_ratio": np.nan, "step_low": np.nan, "step_high": np.nan}
    points = trace(pd.concat(every).assign(**cells))
    assert "worse" in marks(points, "e").values()
    assert marks(points, "e").get(1) is None


def test_other_recordings_begin_another_line(rows):
    other = rows["commit"] >= commit_of(5)
    new = rows.assign(checksum=np.where(other, "x", rows["checksum"]),
                      fingerprint=np.where(other, 9.0, rows["fingerprint"]))  # fmt: skip
    assert marks(trace(new), "e") == {0: NEW, 4: "worse", 5: NEW, 8: "better"}
    failing = rows.assign(status=rows["status"].mask(rows["commit"] == commit_of(2), "crash: x"))
    assert marks(trace(failing), "e") == {0: NEW, 2: "failed", 4: "worse", 8: "better"}


@pytest.mark.parametrize(
    ("broken", "why"),
    [
        (lambda rows: rows.drop(columns="subject"), "no column subject"),
        (lambda rows: rows.assign(ate_rmse_m="much"), "ate_rmse_m holds no numbers"),
        (lambda rows: rows.assign(commit=7), "commit holds no texts"),
        (lambda rows: pd.concat([rows, rows]), "two rows of one run"),
    ],
)
def test_damaged_histories_are_refused(rows, tmp_path, broken, why):
    broken(rows).to_parquet(tmp_path / "h.parquet")
    with pytest.raises(InputError, match=f"damaged .{why}"):
        read_history(tmp_path / "h.parquet")
    with pytest.raises(InputError, match="no history yet"):
        read_history(tmp_path / "none.parquet")


@pytest.fixture
def clone(tmp_path, small, monkeypatch):
    """A repository of three commits that holds a suite; its runs are made up."""
    for number in range(3):
        (tmp_path / "number").write_text(f"{number}")
        if number == 0:
            git("init", "-q", folder=tmp_path)
            git("add", "number", folder=tmp_path)
        who = ("-c", "user.name=Ada", "-c", "user.email=a@b")
        git(*who, "commit", "-qam", f"change {number}", folder=tmp_path)
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path / "results"))

    def rows_in(folder, *_, **__):
        number = int((folder / "number").read_text())
        if number == 1:
            raise InputError("no module named x")
        return rows_at(4 * number, "odometry")

    monkeypatch.setattr(history, "rows_in", rows_in)
    monkeypatch.setattr(history, "step_ratios", lambda *_: {"odometry": Interval(1.25, 1.2, 1.3)})
    return tmp_path


def test_commits_are_appended_once_in_their_order(clone, small, capsys):
    path = history_path(str(small))
    assert path == clone / "small.baselines" / "history.parquet"
    append(str(small), ["HEAD"], path, speed="HEAD~2")
    run_history(str(small), ["HEAD~2", "HEAD~1", "HEAD"])
    said = capsys.readouterr()
    assert "left out, no module named x" in said.err
    assert "is there" in said.out
    kept = read_history(path)
    assert list(kept["subject"].unique()) == ["change 0", "change 2"]
    assert set(kept["step_ratio"].dropna()) == {1.25}
    (clone / "number").write_text("0")  # what is not committed does not count
    path.unlink()
    append(str(small), ["HEAD"], path)
    assert read_history(path)["ate_rmse_m"].tolist() == rows_at(8)["ate_rmse_m"].tolist()
    with pytest.raises(InputError, match="runs at none of them"):
        append(str(small), ["HEAD~1"], path)


def test_the_commits_address_is_that_of_the_origin(clone):
    assert address_of(clone) == ""
    git("remote", "add", "origin", "x", folder=clone)
    for origin, address in (
        ("https://user:token@example.org/a/b.git", "https://example.org/a/b/commit/"),
        ("git@example.org:a/b.git", "https://example.org/a/b/commit/"),
        ("../elsewhere", ""),
        ("javascript:alert(1)", ""),
    ):
        git("remote", "set-url", "origin", origin, folder=clone)
        assert address_of(clone) == address


@pytest.fixture(scope="module")
def page(rows, tmp_path_factory):
    path = tmp_path_factory.mktemp("history") / "page.html"
    history_page.write_history_page(rows, "mine", path, "https://example.org/a/b/commit/")
    return path


def test_the_page_is_one_file_in_which_nothing_is_code(page, rows):
    text = page.read_text()
    assert len(text) < 2_000_000
    assert "<img src=x" not in text
    assert "12 commits, 2001-09-09 to " in text
    n_changes = len(changes(trace(rows)))
    assert f"{n_changes} changes, " in text
    assert text.count('<a href="https://example.org/a/b/commit/00') == n_changes


@pytest.mark.slow
@pytest.mark.parametrize(("width", "columns"), [(1400, 3), (390, 1)])
def test_the_page_in_a_browser(page, width, columns):
    if browser.find() is None:
        pytest.skip("no Chromium on this machine")
    with browser.page() as tab:
        tab.shape(width, 900, dark=width < 600)
        tab.open(page.as_uri())
        tab.js("drawn")
        assert tab.becomes("document.documentElement.scrollWidth <= innerWidth")
        panels = "[...document.querySelectorAll('#chart .cell > g')].map("
        panels += "(c) => Math.round(c.getBoundingClientRect().left))"
        assert len(set(tab.js(panels))) == columns
        found = "(() => { const found = []; const walk = (item) => {"
        found += "if (item.mark?.marktype === 'symbol' && item.datum?.tip)"
        found += "found.push([item.datum.estimator, item.datum.number, item.datum.mark]);"
        found += "(item.items ?? []).forEach(walk); }; walk(chart.scenegraph().root);"
        found += "return found; })()"
        drawn = tab.js(found)
        assert len(drawn) == 3 * N
        assert ["e", 4, "worse"] in drawn
        tab.js("byId('metric').value = 'step'; byId('metric').dispatchEvent(new Event('change'))")
        tab.js("drawn")
        assert ["e", 6, "worse"] in tab.js(found)
        tab.js("pick(pointsOf('step')[4])")
        assert tab.js("document.querySelector('#picked a').href").endswith(commit_of(4))
        assert EVIL in tab.js("byId('picked').textContent")
        assert tab.complaints() == []
