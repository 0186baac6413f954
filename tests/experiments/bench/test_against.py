"""Old and new code in turn: ratios with intervals, checkouts of revisions, and the verdict."""

import itertools
import json
import math
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from experiments.bench import against
from experiments.bench.against import alternate, checkout, git, run_in, serving
from experiments.bench.measure import Measurement, as_json, as_table
from experiments.evaluation.statistics import Interval
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
    load = itertools.cycle(np.exp(np.linspace(0.0, 1.0, 100)))

    def start(folder):
        planted = slowdown if folder == NEW else 1.0

        def ask(_):
            shared = next(load)
            slow, same = shared * np.exp(own * rng.standard_normal(2))
            same *= 1.5 if rng.random() < 0.1 else 1.0  # interrupted
            return {"slow": slow * planted, "same": same, "none": 0.0}

        return nullcontext(ask)

    return start


def test_a_planted_slow_step_is_red_and_equal_ones_are_not():
    red = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        ratios = alternate(stubbed(1.3, rng), ["suite"], NEW, OLD)
        assert set(ratios) == {"slow", "same"}
        assert 0.97 < ratios["same"].value < 1.03
        red.append(speed.slower(ratios))
        assert not speed.slower(alternate(stubbed(1.05, rng), ["suite"], NEW, OLD))
        assert alternate(stubbed(1.1, rng), ["suite"], NEW, OLD)["slow"].low > 1.0
    assert red == [["slow"]] * 20
    text = speed.as_text(ratios, "v1", ["mine"])
    assert "slower by more than 10 %: slow" in text
    assert "not at both: mine" in text


def counted(own):
    """How often an item of this noise is asked for at the new code, and in which order."""
    order, rng = [], np.random.default_rng(0)

    def start(folder):
        def ask(_):
            order.append(folder)
            return {"a": math.exp(own * rng.standard_normal())}

        return nullcontext(ask)

    alternate(start, ["suite"], NEW, OLD)
    return order.count(NEW), order


def test_the_order_turns_and_noise_takes_more_turns():
    calm, order = counted(0.0)
    assert order[:6] == [OLD, NEW, NEW, OLD, OLD, NEW]
    assert calm == against.ROUNDS * against._TURNS.start
    assert calm < counted(0.05)[0] < counted(0.2)[0]
    assert counted(1.0)[0] == against.ROUNDS * (against._TURNS.stop - 1)


def test_processes_take_turns_wherever_they_look_at_the_clock(repository):
    script = """
def answer(item):
    begun, n = time.process_time(), 0
    while (past := time.perf_counter() - begun) < 0.05:
        n += 1
    return past
"""
    with serving(script, [], repository) as one, serving(script, [], repository) as other:
        for _ in range(2):
            given = [ask("x") for _ in range(10) for ask in (one, other)]
            assert given == [None] * 20  # 17 slices of 3 ms, and both are under way
            while (last := one("x")) is None:
                pass
            assert 0.05 <= last < 0.1  # what waiting takes does not count
            while other("x") is None:
                pass
    with serving(script, [], repository, 0.0) as alone:
        assert alone("x") >= 0.05


def test_who_holds_a_lock_keeps_the_turn(repository, tmp_path):
    script = f"""
import fcntl
def answer(item):
    begun = time.process_time()
    with open({str(tmp_path / "lock")!r}, "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        while time.perf_counter() - begun < 0.05:
            pass
    while time.perf_counter() - begun < 0.1:
        pass
    return "done"
"""
    with serving(script, [], repository) as one, serving(script, [], repository) as other:
        for _ in range(2):  # before the lock, and with it: neither waits for the other's
            assert [one("x"), other("x")] == [None, None]
        for ask in (one, other):
            while (last := ask("x")) is None:
                pass
            assert last == "done"


def test_a_long_suite_takes_one_turn_a_round(monkeypatch):
    monkeypatch.setattr(against, "_ROUND_S", 0.0)
    assert counted(1.0)[0] == against.ROUNDS


def test_what_a_revision_lacks_has_no_ratio():
    def start(folder):
        return nullcontext(lambda item: {item: 1.0} if (folder, item) != (OLD, "new") else {})

    ratios = alternate(start, ["new", "both"], NEW, OLD)
    assert ratios == {"both": Interval.exact(1.0)}


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
    with pytest.raises(InputError, match="ValueError: no such option"):
        run_in(repository, "raise ValueError('no such option\\nit knows\\nthese')")


@pytest.mark.parametrize("name", ["nowhere", "-x", "", "HEAD~999999"])
def test_a_revision_that_is_not_there_is_named(repository, name):
    with pytest.raises(InputError, match=f"^{name}: no such revision; `git log` lists"):
        checkout(name, repository)


def test_a_process_answers_in_turn_until_it_fails(repository):
    script = "import stated\nprint('loading')\nanswer = lambda item: [stated.number, int(item)]"
    with serving(script, [], repository) as ask:
        assert [ask("3"), ask("4")] == [[2, 3], [2, 4]]
        with pytest.raises(InputError, match="invalid literal"):
            ask("x")
    gone = pytest.raises(InputError, match="No module named 'gone'")
    with serving("import gone", [], repository) as ask, gone:
        ask("3")


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
    monkeypatch.setattr(against, "serving", lambda *_: nullcontext(lambda _: figures))
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
    commands = speed.commands(speed.read_suite(path))
    assert "seed=7" in commands["odometry"]
    monkeypatch.setattr(speed, "checkout", lambda _: against.Checkout(OLD, "c"))
    monkeypatch.setattr(
        speed,
        "serving",
        lambda _, given, folder: nullcontext(
            lambda item: {item: 1.0 + (folder != OLD)} if json.loads(given[0]) == commands else {}
        ),
    )
    assert speed.run_speed(str(path), "v1")
    monkeypatch.setattr(speed, "serving", lambda *_: nullcontext(lambda _: {}))
    with pytest.raises(InputError, match="none of odometry"):
        speed.run_speed(str(path), "v1")
