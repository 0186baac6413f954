"""Progress as a bar on a terminal, and as lines elsewhere."""

import io
import re

import pytest

from experiments.runs import console
from sim.errors import InputError


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass only when the test says so."""
    now = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    return now


def test_lines_elsewhere_say_amount_rate_failures_and_time_left(clock, capsys):
    with console.progress("", 400, "runs", summary=True) as on_progress:
        for clock[0], done in ((1.0, 20), (4.0, 80), (5.0, 100), (15.0, 300)):
            on_progress(done, failed=done // 100)
    assert capsys.readouterr().err.splitlines() == [
        "80 of 400 runs, 20 a second",
        "300 of 400 runs, 20 a second, 5 s left, 3 failed",
    ]
    with console.progress("simulating, s") as on_progress:
        clock[0] += 3.0
        on_progress(12.3456)
    assert capsys.readouterr().err == "simulating, s: 12.3 after 3 s\n"


def test_the_rate_counts_from_a_restart_on(clock, capsys):
    with console.progress("", 10, "runs") as on_progress:
        for clock[0], done in ((40.0, 1), (55.0, 2), (66.0, 4)):
            on_progress(done, restart=done == 2)
    assert capsys.readouterr().err.splitlines() == [
        "1 of 10 runs, 0.025 a second, 6 min left",
        "2 of 10 runs",
        "4 of 10 runs, 0.18 a second, 33 s left",
    ]


def test_a_time_left_is_given_once_there_is_a_rate_to_judge_it_by(clock, capsys):
    with console.progress("checking", 1.0) as on_progress:
        for clock[0], done in ((7.0, 0.2), (17.0, 0.04), (28.0, 0.5)):
            on_progress(done)
    assert capsys.readouterr().err.splitlines() == [
        "checking: 20 % after 7 s",
        "checking: 4 % after 17 s",
        "checking: 50 % after 28 s, 28 s left",
    ]


def test_what_is_counted_is_not_said_twice(clock, capsys):
    with console.progress("", 60, "runs") as on_progress:
        for clock[0] in range(3, 90):
            on_progress(2 if clock[0] < 80 else 3, restart=clock[0] < 80)
    assert capsys.readouterr().err.splitlines() == [
        "2 of 60 runs",
        "3 of 60 runs, 1 a second",
    ]


def test_no_more_is_done_than_there_is(clock, capsys):
    with console.progress("simulated seconds", 60.0) as on_progress:
        clock[0] += 3.0
        on_progress(62.0)
    assert capsys.readouterr().err == "simulated seconds: 62 of 62 after 3 s\n"


def test_what_ends_soon_leaves_at_most_a_summary(clock, capsys):
    for summary in (False, True):
        with console.progress("drawing", 1.0, summary=summary) as on_progress:
            clock[0] += 1.0
            on_progress(1.0)
        assert capsys.readouterr().err == "drawing: 100 % after 1 s\n" * summary


def test_a_terminal_gets_a_bar_and_then_the_summary(clock, monkeypatch):
    monkeypatch.setattr("sys.stderr", Terminal())
    with console.progress("", 4, "runs", summary=True) as on_progress:
        clock[0] += 200.0
        on_progress(1)
    text = re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", console.sys.stderr.getvalue())
    assert "━" in text
    assert text.endswith("1 of 4 runs, 0.005 a second, 10 min left\n")


def test_an_interrupt_is_said_whatever_it_caused(capsys, monkeypatch):
    monkeypatch.setattr(console.signal, "signal", lambda *_: None)
    error = InputError("half composed")
    error.__context__ = KeyboardInterrupt("interrupted; 3 of 9 runs are kept")
    with pytest.raises(SystemExit) as ended:
        console.exit_with(error)
    assert ended.value.code == 130
    assert "3 of 9 runs are kept" in capsys.readouterr().err


def test_an_output_that_was_closed_is_named(monkeypatch):
    closed = io.StringIO()
    closed.close()
    monkeypatch.setattr(console.sys, "stdout", closed)
    with pytest.raises(InputError, match="the standard output is closed, by code of"):
        console.show("a result")
    monkeypatch.setattr(console.sys, "stderr", closed)
    console.warn("nobody reads it")
