"""What is stale, why, and that only it is made again; on the real parts of a small study."""

import shutil

import pytest

from experiments import reproduce as module
from experiments.judging import built
from experiments.judging.built import State, list_built, note_built
from experiments.judging.folders import STUDIES, part
from experiments.judging.results import Profile
from experiments.runs.dependencies import digests
from experiments.runs.experiment import Experiment
from experiments.runs.paths import SOURCE
from sim.errors import InputError

STUDY = "fastslam_consistency"
SMALL = ("estimator.n_particles=5", "route.distance_m=2", "simulation.physics=kinematic")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Results of two studies of few runs: one by FastSLAM, one of the kinematic robot alone."""
    folder = tmp_path_factory.mktemp("built")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ESTIMA_RESULTS", str(folder / "results"))
        study = part(STUDY, "study")
        given = [f"study={STUDY}", "estimator=fastslam", *SMALL]
        patch.setattr(study, "plan", lambda _: [Experiment.compose(given)])
        patch.setattr(study, "DISTANCES_M", (10.0, 20.0))
        figures = part(STUDY, "figures")
        patch.setattr(figures, "draw", lambda made: draw_plainly(made))
        module.reproduce_paper(STUDY, Profile.QUICK)
    return folder


def draw_plainly(made):
    from experiments.viewing.style import figure

    made.table("nees")
    return {f"{STUDY}_nees": figure(1.0, 1.0)}


@pytest.fixture
def copied(made, monkeypatch):
    """The results, and a copy of the code in which files can be changed."""
    monkeypatch.setenv("ESTIMA_RESULTS", str(made / "results"))
    code = made / "code"
    shutil.rmtree(code, ignore_errors=True)
    for name in ("sim", "estimators", "experiments", "conf"):
        shutil.copytree(SOURCE / name, code / name, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(digests, "SOURCE", code)
    return code


def states(results):
    return {each.name: (each.state, list(each.why)) for each in list_built(results)}


TABLE, FIGURE = f"tables/{STUDY}_nees.csv", f"figures/{STUDY}_nees.png"


def test_stale_is_exactly_what_could_change(copied):
    results = copied.parent / "results"
    assert states(results) == {TABLE: (State.FRESH, []), FIGURE: (State.FRESH, [])}
    cases = {
        "estimators/landmarks/fastslam.py": [TABLE],
        "estimators/on_a_map/mcl.py": [],
        f"experiments/studies/{STUDY}/figures.py": [FIGURE],
        "experiments/papers/gil2008/figures.py": [],
        f"experiments/studies/{STUDY}/study.py": [TABLE],
        "sim/simulate.py": [TABLE],
        "sim/robot/slip.py": [TABLE, FIGURE],  # the figures' code imports what imports it
        f"conf/study/{STUDY}.yaml": [TABLE],
    }
    for name, stale in cases.items():
        path = copied / name
        text = path.read_text()
        path.write_text(f"# a comment\n{text}")
        assert all(state is State.FRESH for state, _ in states(results).values()), name
        path.write_text(f"{text}\n{'added: 1' if path.suffix == '.yaml' else 'added = 1'}\n")
        found = states(results)
        assert [n for n in found if found[n][0] is State.STALE] == stale, name
        assert all(found[n][1] == [name] for n in stale)
        path.write_text(text)


def test_an_edited_table_makes_its_figure_stale(copied):
    results = copied.parent / "results"
    path = results / TABLE
    text = path.read_text()
    path.write_text(text.replace("1", "2", 1))
    assert states(results)[FIGURE] == (State.STALE, [f"results/{TABLE}"])
    path.write_text(text)


def test_only_what_is_stale_is_made_again(copied, monkeypatch, capsys):
    runs = []
    monkeypatch.setattr(module, "reproduce_paper", lambda *given: runs.append(given))
    monkeypatch.setattr(part(STUDY, "figures"), "draw", draw_plainly)
    module.renew()
    assert not runs
    (copied / f"experiments/studies/{STUDY}/figures.py").write_text("changed = True\n")
    module.renew()
    assert not runs, "a figure is drawn, and no row is made"
    assert "1 result stale" in capsys.readouterr().out
    (copied / f"experiments/studies/{STUDY}/study.py").write_text("changed = True\n")
    module.renew()
    assert runs == [(STUDY, Profile.FULL)]


def test_what_says_nothing_is_unrecorded(copied):
    results = copied.parent / "results"
    other = results / "tables" / "gil2008_bound.csv"
    other.write_text("a\n1\n")
    assert states(results)["tables/gil2008_bound.csv"][0] is State.UNRECORDED
    note_built(results, "gil2008", {"tables/gil2008_bound.csv": ({"sim/se2.py": "0"}, 1.0)})
    (one,) = [each for each in list_built(results) if each.study == "gil2008"]
    assert str(one).startswith("stale      tables/gil2008_bound.csv")
    assert str(one).endswith("1 s  sim/se2.py")
    note_built(results, "gil2008", {}, only_these=True)
    other.unlink()
    assert set(states(results)) == {TABLE, FIGURE}


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"items": {"a": {}}, "sets": {}}', "[" * 9999])
def test_a_damaged_record_is_named(tmp_path, text):
    (tmp_path / "built.json").write_text(text)
    with pytest.raises(InputError, match=r"built\.json: cannot read it"):
        list_built(tmp_path)


def test_files_belong_to_studies():
    assert built.study_of("real_logs_ate") == "real_logs"
    assert built.study_of("leaderboard_means") == "leaderboard"
    assert {built.study_of(f"{study}_runs") for study in STUDIES} == set(STUDIES)
