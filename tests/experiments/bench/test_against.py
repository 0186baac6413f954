"""Old and new code in turn: ratios with intervals, checkouts of revisions, and the verdict."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.bench import against
from experiments.bench.against import alternate, checkout, git, run_in
from experiments.bench.measure import Measurement, as_json, as_table
from experiments.gate import speed
from sim.errors import InputError

NEW, OLD = Path("new"), Path("old")


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """Two commits of a module that states its number."""
    monkeypatch.setenv("ESTIMA_RESULTS", str(tmp_path / "results"))
    folder = tmp_path / "clone"
    folder.mkdir()
    git("init", "-q", folder=folder)
    for number in (1, 2):
        (folder / "stated.py").write_text(f"number = {number}\n")
        git("add", ".", folder=folder)
        who = ("-c", "user.name=a", "-c", "user.email=a@b")
        git(*who, "commit", "-qm", f"number {number}", folder=folder)
    return folder


def stubbed(slowdown, rng, own=0.02):
    """Times of two figures on a machine that slows down meanwhile, beside other work."""
    load = iter(np.linspace(1.0, 2.0, 100))

    def measure(folder):
        shared = next(load)
        noise = np.exp(own * rng.standard_normal(2))
        planted = slowdown if folder == NEW else 1.0
        return {"slow": shared * noise[0] * planted, "same": shared * noise[1], "none": 0.0}

    return measure


def test_a_planted_slow_step_is_red_and_equal_ones_are_not():
    red = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        ratios = alternate(stubbed(1.3, rng), NEW, OLD)
        assert set(ratios) == {"slow", "same"}
        assert 0.97 < ratios["same"].value < 1.03
        red.append(speed.slower(ratios))
        assert not speed.slower(alternate(stubbed(1.05, rng), NEW, OLD))
    assert red == [["slow"]] * 20
    text = speed.as_text(ratios, "v1", ["mine"])
    assert "slower by more than 10 %: slow" in text
    assert "not at both: mine" in text


def test_the_order_turns_with_each_pair():
    order = []
    alternate(lambda folder: order.append(folder) or {"a": 1.0}, NEW, OLD, pairs=3)
    assert order == [OLD, NEW, NEW, OLD, OLD, NEW]


def test_a_revision_is_checked_out_once(repository, capsys):
    old = checkout("HEAD~1", repository)
    assert (old.folder / "stated.py").read_text() == "number = 1\n"
    assert checkout(old.commit, repository) == old
    script = "import stated, json; print(json.dumps(stated.number))"
    assert [run_in(folder, script) for folder in (old.folder, repository)] == [1, 2]
    (repository / "requirements.lock").write_text("numpy==1\n")
    checkout("HEAD~1", repository)
    assert "requirements.lock differs at HEAD~1" in capsys.readouterr().err
    for revision in ("no-such", "--help"):
        with pytest.raises(InputError):
            checkout(revision, repository)
    with pytest.raises(InputError, match="No module named 'gone'"):
        run_in(repository, "import gone")


def test_compiled_code_is_shared_if_all_of_it_is_equal(repository):
    for name in ("a", "b"):
        (repository / "sim" / "__pycache__").mkdir(parents=True, exist_ok=True)
        (repository / "sim" / f"{name}.py").write_text(name)
        (repository / "sim" / "__pycache__" / f"{name}.f-1.py311.nbi").write_text(name)
    git("add", "sim/*.py", folder=repository)
    who = ("-c", "user.name=a", "-c", "user.email=a@b")
    git(*who, "commit", "-qm", "compiled", folder=repository)
    (repository / "sim" / "b.py").write_text("c")
    git(*who, "commit", "-qam", "another", folder=repository)
    here, before = (checkout(name, repository).folder / "sim" for name in ("HEAD", "HEAD~1"))
    assert (here / "__pycache__" / "a.f-1.py311.nbi").read_text() == "a"
    assert (here / "a.py").stat().st_mtime == (repository / "sim" / "a.py").stat().st_mtime
    assert not (before / "__pycache__").exists()  # of b, which a may hold


def test_ratios_stand_beside_the_figures(monkeypatch):
    figures = [{"name": "a.step_ms", "value": 2.0, "unit": "ms"}]
    monkeypatch.setattr(against, "checkout", lambda _: against.Checkout(OLD, "c"))
    monkeypatch.setattr(against, "run_in", lambda *_: {"results": figures})
    (result,) = against.run_against("icp", "v1")
    assert (result.ratio, result.ratio_low, result.ratio_high) == (1.0, 1.0, 1.0)
    assert "1.000 (1.000 to 1.000)" in as_table([result])
    assert "ratio" not in as_table([Measurement("a", 1.0, "s")])
    written = json.loads(as_json([result]))
    assert written["results"][0]["ratio_high"] == 1.0
    assert all(value > 0.0 for value in written["machine_unit_ms"].values())


def test_a_suite_gives_a_command_of_each_estimator(monkeypatch, tmp_path):
    path = tmp_path / "s.yaml"
    group = "{count: 2, overrides: [world=empty, route=linear_4, simulation.physics=kinematic]}"
    path.write_text(
        f"first_seed: 7\nrecordings: {{a: {group}}}\n"
        "estimators: {odometry: {recordings: a, repeats: [1, 1]}}\n"
    )
    seen = []
    monkeypatch.setattr(speed, "checkout", lambda _: against.Checkout(OLD, "c"))
    monkeypatch.setattr(
        speed, "run_in", lambda *given: seen.append(given) or {"odometry": 1.0 + (given[0] != OLD)}
    )
    assert speed.run_speed(str(path), "v1")
    assert "seed=7" in json.loads(seen[0][2])["odometry"]
    monkeypatch.setattr(speed, "run_in", lambda *_: {})
    with pytest.raises(InputError, match="none of odometry"):
        speed.run_speed(str(path), "v1")
