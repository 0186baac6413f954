"""The study of alarms: what is planted, its table and its figure."""

import numpy as np
import pandas as pd

from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.studies.self_knowledge import figures, study
from experiments.studies.self_knowledge.planted import lift_wheels
from tests.fixtures.fakes import circle


def test_lifted_wheels_stand_for_a_part_of_the_drive():
    recording = circle(seed=1, n_frames=240, kr=0.0, kl=0.0)
    lifted = lift_wheels(recording)
    whole, rest = (np.abs(np.diff(r.wheels.position_m[:, 0])) for r in (recording, lifted))
    gone = rest < 0.5 * whole
    assert 0.05 < gone[whole > 0.0].mean() < 0.15
    np.testing.assert_allclose(rest[~gone], whole[~gone], atol=2.0 * whole.max())


def test_a_misread_start_is_a_loss_that_odometry_misses(monkeypatch):
    driven = circle(seed=1, n_frames=240, kr=5e-5, kl=5e-5)
    monkeypatch.setattr(Experiment, "recording", lambda self: driven)
    one = Experiment.compose(["study=self_knowledge", "estimator=odometry"])
    table = pd.DataFrame(study.said([one])["said"])
    losses = table[table["kind"] == "peaks"]
    assert "start" in set(losses["planted"])
    assert "nothing" not in set(losses["planted"])
    curve = figures.curves(table)
    assert curve["missed"].iloc[-1] == 1.0  # without alarms
    alert = table.assign(method="alert", signal=table["kind"] == "peaks")
    at_start, lifted = figures.draw_alarms(pd.concat([table, alert])).axes
    named = [line.get_label() for line in at_start.get_lines()]
    assert "alert" in named
    assert "odometry" in named  # grey, with all that miss most
    assert lifted.get_title() == "wheels lifted"
    of_start = (losses["planted"] == "start").sum()
    assert set(figures.curves(table, "start")["losses"]) == {of_start}


def test_each_method_has_the_drive_and_the_start_that_are_said(monkeypatch):
    driven, given = circle(seed=1, n_frames=240, kr=5e-5, kl=5e-5), []

    def runs(recording, estimator, prior, rng, keep):
        given.append((recording, prior.mean))
        return run_over(recording, estimator, prior, rng, keep)

    monkeypatch.setattr(Experiment, "recording", lambda self: driven)
    monkeypatch.setattr(study, "run_over", runs)
    one = Experiment.compose(["study=self_knowledge", "estimator=odometry"])
    made = study.said([one])
    (plain, at), (misread, beside), (lifted, same) = given
    assert plain is misread is driven
    np.testing.assert_allclose(beside - at, study.OFF)
    np.testing.assert_array_equal(same, at)
    assert (
        np.ptp(lifted.wheels.position_m, axis=0).max()
        < np.ptp(driven.wheels.position_m, axis=0).max()
    )
    (known,) = made["consistency"]
    assert known["planted"] == "nothing"


def test_runs_that_fail_are_counted_apart(monkeypatch):
    def fails(*_):
        raise RuntimeError("Indeterminate linear system")

    driven = circle(seed=1, n_frames=24)
    monkeypatch.setattr(Experiment, "recording", lambda self: driven)
    monkeypatch.setattr(study, "run_over", fails)
    one = Experiment.compose(["study=self_knowledge", "estimator=odometry"])
    made = study.said([one])
    assert [row["kind"] for row in made["said"]] == ["failed"] * 3
    assert not made["consistency"]
    quiet = {"method": "odometry", "kind": "quiet", "signal": 0.1}
    curve = figures.curves(pd.DataFrame([*made["said"], quiet]))
    assert set(curve["failed"]) == {3}


def test_the_share_inside_is_the_mean_over_drives():
    scores = dict.fromkeys(study._SCORES, 1.0)
    shares = {1000: 0.9, 1001: 1.0}
    rows = [
        {"method": "mcl", "answer": "online", "seed": seed, **scores, "inside_95_share": share}
        for seed, share in shares.items()
    ]
    (row,) = study.covered(pd.DataFrame(rows)).to_dict("records")
    assert (row["drives"], row["inside_95_share"]) == (2, 0.95)
    page = figures.draw_coverage(pd.DataFrame([row]))
    assert [label.get_text() for label in page.axes[0].get_yticklabels()] == ["mcl"]
