"""Rows of sweeps as tables, means and plots; the schema they share."""

import itertools

import numpy as np
import pandas as pd
import pytest
from matplotlib.cbook import is_math_text
from matplotlib.text import Text
from typer.testing import CliRunner

from experiments.cli.main import app
from experiments.report.export import as_text
from experiments.report.plot import by_factors, sweep_figure
from experiments.runs.columns import (
    COLUMNS,
    DEPENDENCIES,
    ORIGIN,
    REPEAT,
    STATUS,
    is_setting,
    title,
)
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.sweeps.collect import (
    collect,
    distinguishing_settings,
    result_columns,
    suggest_axes,
    swept_settings,
    where,
)
from experiments.sweeps.summary import summary
from sim.errors import InputError


def rows(n=6):
    """Rows as a sweep leaves them."""
    rng = np.random.default_rng(0)
    return pd.DataFrame(
        {
            "choice.estimator": ["a", "b"] * n,
            "robot.kr": np.repeat([1e-5, 1e-3], n),
            "seed": np.tile(np.repeat(np.arange(n // 2), 2), 2),
            "repeat": 0,
            "run_key": [f"{i:02d}" for i in range(2 * n)],
            "code_version": "v",
            "recording_checksum": [f"r{i // 2}" for i in range(2 * n)],
            "status": "ok",
            "ate_rmse_m": np.tile([1.0, 2.0], n) * np.repeat(np.exp(rng.normal(size=n)), 2),
            "step_time_us": rng.random(2 * n),
        }
    )


def test_tables_know_settings_from_findings_and_compare_on_the_same_recordings():
    table = rows()
    assert swept_settings(table) == ["choice.estimator", "robot.kr", "seed"]
    assert result_columns(table) == ["ate_rmse_m", "step_time_us"]
    found = summary(table, against="a").set_index(["choice.estimator", "robot.kr"])
    np.testing.assert_allclose(found.loc["a", "ate_rmse_over_a"], 1.0)
    np.testing.assert_allclose(found.loc["b", "ate_rmse_over_a"], 2.0)
    assert (found["runs"] == 3).all()
    with pytest.raises(InputError, match="no rows of estimator c; there are a, b"):
        summary(table, against="c")
    table.loc[table["choice.estimator"] == "a", "status"] = "failed"
    with pytest.raises(InputError, match="all runs of a failed; there are b"):
        summary(table, against="a")


def test_settings_that_follow_from_others_are_not_named():
    table = rows()
    table.insert(2, "robot.kl", 2.0 * table["robot.kr"])
    table.insert(3, "estimator._target_", "module." + table["choice.estimator"])
    assert distinguishing_settings(table) == ["choice.estimator", "robot.kr", "seed"]
    assert list(summary(table).columns[:3]) == ["choice.estimator", "robot.kr", "runs"]
    assert set(summary(table)["answer"]) == {"online"}
    table["robot.kl"] = np.tile([1.0, 2.0, 2.0], 4)  # now a setting of its own
    assert distinguishing_settings(table) == ["choice.estimator", "robot.kr", "robot.kl", "seed"]


def test_rows_of_other_code_are_left_out(tmp_path, capsys):
    from experiments.runs.version import code_version

    table = rows()
    table.to_parquet(tmp_path / "x.parquet")
    with pytest.raises(InputError, match="other versions"):
        collect(str(tmp_path))
    assert len(collect(str(tmp_path), all_versions=True)) == len(table)
    table.loc[:4, "code_version"] = code_version()
    table.to_parquet(tmp_path / "x.parquet")
    assert len(collect(str(tmp_path))) == 5
    assert "left out 7 rows of other versions of the code" in capsys.readouterr().err


@pytest.mark.parametrize("columns", [[], list(rows())])
def test_a_file_of_no_rows_is_named(tmp_path, columns):
    rows().to_parquet(tmp_path / "a.parquet")
    rows().reindex(columns=columns).iloc[:0].to_parquet(tmp_path / "b.parquet")
    for path in (tmp_path, tmp_path / "b.parquet"):
        with pytest.raises(InputError, match=r"b.parquet: a table of no rows; delete it"):
            collect(str(path), all_versions=True)


def test_settings_of_some_estimators_only_are_settings(tmp_path):
    table = rows()
    for name, setting in (("a", None), ("b", "estimator.metric"), ("c", "estimator.n_particles")):
        part = table[table["choice.estimator"] == "a"].assign(**{"choice.estimator": name})
        part["run_key"] += name
        if setting is not None:
            part.insert(1, setting, ["p", "q"] * 3)
            part[f"found_by_{name}"] = 1.0
        part.to_parquet(tmp_path / f"{name}.parquet")
    together = collect(str(tmp_path), all_versions=True)
    assert {"estimator.metric", "estimator.n_particles"} <= set(swept_settings(together))
    assert {"found_by_b", "found_by_c"} <= set(result_columns(together))
    assert (summary(together).groupby("choice.estimator").size() == [2, 4, 4]).all()


def test_a_method_stands_where_its_best_answer_is():
    table = rows().assign(cpu_time_us=2.0, step_time_us=1.0)
    batch = table["choice.estimator"] == "b"
    table["revised_ate_rmse_m"] = np.where(batch, 0.25 * table["ate_rmse_m"], np.nan)
    found = summary(table, against="a").set_index("choice.estimator")
    assert found["answer"].to_dict() == {"a": "online", "b": "revised"}
    paths = table[["ate_rmse_m", "revised_ate_rmse_m"]]
    logs = np.log(paths).groupby([table["choice.estimator"], table["robot.kr"]]).mean()
    of_a, of_b = (found["answer_ate_rmse_m"][name].to_numpy() for name in "ab")
    np.testing.assert_allclose(of_a, np.exp(logs["ate_rmse_m"]["a"]))
    np.testing.assert_allclose(of_b, np.exp(logs["revised_ate_rmse_m"]["b"]))
    np.testing.assert_allclose(found["cpu_time_us"], 2.0)
    page = sweep_figure(table, "choice.estimator", "answer_ate_rmse_m", pool=True)
    words = [label.get_text() for label in page.axes[0].get_xticklabels()]
    assert words == ["a", "b (revised)"]
    drawn = page.axes[0].get_lines()[0].get_ydata()
    online = sweep_figure(table, "choice.estimator", "ate_rmse_m", pool=True)
    assert drawn[0] == online.axes[0].get_lines()[0].get_ydata()[0]
    assert drawn[1] != drawn[0]
    with pytest.raises(InputError, match="answer_nees_mean"):
        sweep_figure(table, "choice.estimator", "answer_nees_mean")


def test_rows_are_chosen_by_conditions():
    table = rows()
    assert len(where(table, ["robot.kr=0.00001"])) == 6
    assert set(where(table, ["choice.estimator=a", "seed=2"])["seed"]) == {2}
    for condition in ("seed", "robot.krr=1", "seed=9"):
        with pytest.raises(InputError, match=condition):
            where(table, [condition])


def test_failures_and_remarks_are_counted_apart():
    table = rows()
    table["status"] = ["ok", "failed", "remark", *["ok"] * 9]
    found = summary(table).set_index(["choice.estimator", "robot.kr"])
    assert found["failed"].to_dict() == {
        ("a", 1e-5): 0,
        ("a", 1e-3): 0,
        ("b", 1e-5): 1,
        ("b", 1e-3): 0,
    }
    assert int(found["with_remarks"].sum()) == 1


def test_plots_name_a_missing_column_and_average_recordings():
    page = sweep_figure(rows(), "robot.kr", "ate_rmse_m", "choice.estimator")
    lines = page.axes[0].get_lines()
    assert page.axes[0].get_xscale() == "log"
    table = rows()
    one = table[table["choice.estimator"] == "a"]
    expected = np.exp(np.log(one["ate_rmse_m"]).groupby(one["robot.kr"]).mean())
    np.testing.assert_allclose(lines[0].get_ydata(), expected)
    assert page.get_suptitle().startswith("Geometric mean over recordings")
    assert "estimator" not in page.get_suptitle()
    with pytest.raises(
        InputError, match=r"different values of choice\.estimator \(a, b\).*pool them"
    ):
        sweep_figure(rows(), "robot.kr", "ate_rmse_m")
    pooled = sweep_figure(rows(), "robot.kr", "ate_rmse_m", pool=True)
    assert "estimator" in pooled.get_suptitle()
    table = table.assign(ate_rmse_m=np.tile(np.repeat([1e-4, 1.0, 10.0], 2), 2))
    page = sweep_figure(table, "robot.kr", "ate_rmse_m", pool=True)
    geometric = np.exp(np.log(table["ate_rmse_m"]).groupby(table["robot.kr"]).mean())
    np.testing.assert_allclose(page.axes[0].get_lines()[0].get_ydata(), geometric)
    with pytest.raises(InputError, match=r"no run has all of robot\.kr, ate_rmse_m"):
        sweep_figure(table.assign(**{"robot.kr": None}), "robot.kr", "ate_rmse_m")
    with pytest.raises(
        InputError, match=r"no column robot\.krr; did you mean robot\.kr\? there are .*ate_rmse_m"
    ):
        sweep_figure(rows(), "robot.krr", "ate_rmse_m")
    with pytest.raises(InputError, match=r"no column nosuch; there are .*robot\.kr"):
        sweep_figure(rows(), "nosuch", "ate_rmse_m")
    with pytest.raises(InputError, match="no numbers"):
        sweep_figure(rows(), "robot.kr", "status")


def test_a_mean_of_two_is_drawn_with_both_and_without_an_interval():
    two = rows(4).query("`choice.estimator` == 'a'")
    page = sweep_figure(two, "robot.kr", "ate_rmse_m")
    mean, *_, dots = page.axes[0].get_lines()
    assert not [bar for bar in page.axes[0].collections if np.isfinite(bar.get_segments()).any()]
    np.testing.assert_allclose(np.sort(dots.get_ydata()), np.sort(two["ate_rmse_m"]))
    assert len(mean.get_ydata()) == 2
    note = page.get_suptitle().replace("\n", " ")
    assert note.endswith("each the RMS of its repeats; small dots: both of two")
    three = sweep_figure(rows(), "robot.kr", "ate_rmse_m", "choice.estimator")
    assert "[95 % interval]" in three.get_suptitle()
    assert "dots" not in three.get_suptitle()


def test_runs_without_a_finite_value_are_left_out_and_counted(recwarn):
    table = rows().query("`choice.estimator` == 'a'").assign(mixed=[0.1, 0.2, np.inf, np.nan, 1, 2])
    page = sweep_figure(table, "mixed", "ate_rmse_m", pool=True)
    assert len(page.axes[0].get_lines()[0].get_xdata()) == 4
    assert "2 of 6 runs left out: no finite mixed" in page.get_suptitle().replace("\n", " ")
    assert not recwarn


def test_there_is_no_half_a_seed():
    table = rows().query("`choice.estimator` == 'a'").assign(**{"robot.kr": 1e-5})
    page = sweep_figure(table, "seed", "ate_rmse_m")
    page.draw_without_rendering()
    low, high = page.axes[0].get_xlim()
    assert [t for t in page.axes[0].get_xticks() if low <= t <= high] == [0.0, 1.0, 2.0]


def test_what_a_plot_is_drawn_by_is_chosen_where_it_is_not_given():
    assert suggest_axes(rows()) == ["robot.kr", "choice.estimator"]
    assert suggest_axes(rows(), ["robot.kr"]) == ["choice.estimator"]
    assert suggest_axes(rows(), ["robot.kr", "choice.estimator"]) == ["seed"]
    assert suggest_axes(rows()[:1]) == ["repeat"]
    some = rows().assign(**{"choice.world": ["v", "w"] * 6})  # follows from the estimator
    some["estimator.n"] = some["robot.kr"].where(some["choice.estimator"] == "b")
    assert suggest_axes(many(13))[0] == "choice.estimator"  # more than there are colours
    assert suggest_axes(some.drop(columns="robot.kr")) == ["choice.estimator", "estimator.n"]
    twice = sweep_figure(rows(), "choice.estimator", "ate_rmse_m", "choice.estimator", pool=True)
    assert len(twice.axes[0].containers) == 2
    with pytest.raises(InputError, match="against itself"):
        sweep_figure(rows(), "ate_rmse_m", "ate_rmse_m")


def test_the_same_remedy_shows_rows_of_other_code_in_all_three(tmp_path):
    rows().to_parquet(tmp_path / "x.parquet")
    for arguments in (["table"], ["plot", "-o", "p.png"], ["report", "-o", "p.html"]):
        command, *out = [str(tmp_path / a) if a.startswith("p.") else a for a in arguments]
        refused = CliRunner().invoke(app, [command, str(tmp_path), *out])
        assert "all versions" in str(refused.exception)
        done = CliRunner().invoke(app, [command, str(tmp_path), *out, "--all-versions"])
        assert done.exit_code == 0
        if command == "plot":
            assert "drawn with --x robot.kr --by choice.estimator\n" in done.stderr


def test_versions_of_the_code_are_told_apart():
    both = pd.concat([rows(), rows().assign(code_version="w")], ignore_index=True)
    assert distinguishing_settings(both)[-1] == "code_version"
    assert len(summary(both)) == 2 * len(summary(rows()))
    with pytest.raises(InputError, match=r"code_version \(v, w\).*each code_version"):
        sweep_figure(both, "robot.kr", "ate_rmse_m", "choice.estimator")


def many(n_series=12):
    """Rows of many series over numbers that grow by factors, in two worlds."""
    return pd.DataFrame(
        {
            "choice.estimator": f"m{series:02d}",
            "choice.world": world,
            "estimator.n_particles": n,
            "seed": seed,
            "repeat": 0,
            "recording_checksum": f"{world}{seed}",
            "status": "ok",
            "ate_rmse_m": 0.1 * (series + 1) * n * (1.0 + 0.1 * seed),
        }
        for series in range(n_series)
        for world in ("w", "v")
        for n in (1, 2, 4)
        for seed in range(3)
    )


def test_plots_have_panels_and_twelve_series_that_differ():
    x, y, by = "estimator.n_particles", "ate_rmse_m", "choice.estimator"
    with pytest.raises(InputError, match=r"choice\.world \(v, w\).*each choice\.world"):
        sweep_figure(many(), x, y, by)
    page = sweep_figure(many(), x, y, by, col="choice.world", size="page")
    assert [ax.get_title() for ax in page.axes] == ["v", "w"]
    assert page.get_figwidth() == 7.16
    assert page.axes[0].get_xscale() == page.axes[0].get_yscale() == "log"
    styles = {(h.lines[0].get_color(), h.lines[0].get_marker()) for h in page.axes[0].containers}
    assert len(styles) == len({color for color, _ in styles}) == 12
    page.draw_without_rendering()
    legend, width = page.legends[0].get_window_extent(), page.bbox.width
    assert 0.0 <= legend.x0 < legend.x1 <= width
    with pytest.raises(InputError, match="13 lines; at most 12"):
        sweep_figure(many(13), x, y, by, col="choice.world")
    both = sweep_figure(many(3), x, y, [by, "choice.world"])
    assert "m00, v" in [text.get_text() for text in both.axes[0].texts]


def test_what_panels_say_the_legend_does_not_repeat():
    x, y, world = "estimator.n_particles", "ate_rmse_m", "choice.world"
    few = many(3)
    page = sweep_figure(few, x, y, [world, "choice.estimator"], col=world)
    assert [text.get_text() for text in page.legends[0].get_texts()] == ["m00", "m01", "m02"]
    page = sweep_figure(few, x, y, [world], col=world, row="choice.estimator")
    assert not page.legends


def test_seeds_are_not_joined_by_lines():
    def styles(x):
        page = sweep_figure(many(3), x, "ate_rmse_m", "choice.estimator", pool=True)
        return {bars.lines[0].get_linestyle() for bars in page.axes[0].containers}

    assert styles("estimator.n_particles") == {"-"}
    assert styles("seed") == {"None"}


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("team.size", "team size"),
        ("team.communication.range_m", "communication range, m"),
        ("sensors.stereo.max_distance_m", "stereo max distance, m"),
        ("sensors.laser.mount.yaw_rad", "laser mount yaw, rad"),
        ("sensors.laser.n_beams", "number of laser beams"),
        ("sensors.laser.sigma_range_m", "laser range sigma, m"),
        ("estimator.sigma_range_m", "believed range sigma, m"),
        ("estimator.n_particles", "number of particles"),
        ("estimator.kr", "believed kr, m"),
        ("robot.max_acceleration_mps2", "robot max acceleration, m/s²"),
        ("world_seed", "world seed"),
    ],
)
def test_settings_are_called_as_one_would(name, words):
    assert title(name) == words


def test_lines_are_named_at_their_ends_where_that_fits():
    few = many(3).query("`choice.world` == 'w'")
    page = sweep_figure(few, "estimator.n_particles", "ate_rmse_m", "choice.estimator")
    assert [text.get_text() for text in page.axes[0].texts] == ["m00", "m01", "m02"]
    assert not page.legends
    few["ate_rmse_m"] = 1.0  # all ends in one place: the names are moved apart
    page = sweep_figure(few, "estimator.n_particles", "ate_rmse_m", "choice.estimator")
    page.draw_without_rendering()
    boxes = [Text.get_window_extent(text) for text in page.axes[0].texts]
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))
    few["choice.estimator"] += "_of_a_rather_long_name"
    page = sweep_figure(few, "estimator.n_particles", "ate_rmse_m", "choice.estimator")
    assert len(page.legends) == 1


def test_long_words_stand_on_the_y_axis_the_best_at_the_top():
    table = many(9).query("`choice.world` == 'w'")
    table["choice.estimator"] += "_with_a_name"
    page = sweep_figure(table, "choice.estimator", "ate_rmse_m", pool=True)
    page.draw_without_rendering()
    (ax,) = page.axes
    means = np.log(table["ate_rmse_m"]).groupby(table["choice.estimator"]).mean()
    names = [text.get_text() for text in ax.get_yticklabels()]
    assert names == means.sort_values(ascending=False).index.tolist()
    assert (ax.get_xlabel(), ax.get_ylabel()) == (title("ate_rmse_m"), "")
    short = sweep_figure(many(3), "choice.estimator", "ate_rmse_m", pool=True).axes[0]
    assert short.get_ylabel() == title("ate_rmse_m")


@pytest.mark.parametrize(
    ("values", "factors"),
    [
        ([1e-5, 1e-4], True),
        ([1, 2, 4, 8], True),
        ([10, 20, 50, 100], True),
        ([1, 2], False),
        ([1, 2, 3, 4, 5], False),
        (list(range(1, 100)), False),
        ([0.0, 1.0, 100.0], False),
    ],
)
def test_values_that_growby_factors_have_a_logarithmic_axis(values, factors):
    assert by_factors(values) is factors


def test_every_column_of_a_row_is_in_the_schema():
    overrides = ["world=rooms", "robot=robocom", "sensors=stereo_pixel", "estimator=smoother"]
    overrides += ["simulation.physics=kinematic", "route.distance_m=12"]
    experiment = Experiment.compose(overrides)
    (row,) = evaluate(experiment, experiment.simulate_team)
    others = {name for name in row if not is_setting(name)} - {
        REPEAT,
        *STATUS,
        *ORIGIN,
        DEPENDENCIES,
    }
    assert others <= set(COLUMNS)
    assert {"ate_rmse_m", "rpe_10m_rmse_m", "revised_nees_mean", "step_time_us"} <= others
    assert set(experiment.config) - {"keep", "picture"} <= {
        name.partition(".")[0] for name in row if is_setting(name)
    }


def test_columns_say_their_unit():
    for name, column in COLUMNS.items():
        unit = name.rpartition("_")[2] if column.unit else ""
        assert column.unit.replace("µ", "u").replace("²", "2") == unit
        assert title(name).endswith(column.unit)
    assert title("ate_rmse_m", short=True) == "RMSE, m"
    page = sweep_figure(rows(), "robot.kr", "ate_rmse_m", pool=True)
    assert page.axes[0].get_ylabel() == "position RMSE, m"
    assert page.axes[0].get_xlabel() == "true kr, m"


def test_runs_of_equal_settings_and_different_keys_are_refused(tmp_path):
    """As of a world file that was edited between two sweeps of one name."""

    def kept(*tables):
        pd.concat(tables).to_parquet(tmp_path / "x.parquet")
        return len(collect(str(tmp_path), all_versions=True))

    once = rows().assign(**{"simulation.physics": "kinematic", "world.path": "w.yaml"})
    again = once.assign(run_key="k" + once["run_key"])
    assert kept(once, once) == len(once)  # the same runs
    assert kept(once, again.assign(seed=once["seed"] + 10)) == 2 * len(once)
    assert kept(once, once.assign(repeat=1)) == 2 * len(once)
    assert kept(once, again.assign(code_version="w")) == 2 * len(once)
    unseen = {"seed": np.nan}  # an absent setting is equal to itself only
    assert kept(once, again[:1].assign(**unseen)) == len(once) + 1
    for refused in (again, again[3:4], again[3:4].assign(ate_rmse_m=9.0)):
        with pytest.raises(InputError, match=rf"{len(refused)} rows .* name=.*delete {tmp_path}"):
            kept(once, refused)
    with pytest.raises(InputError, match="1 rows"):
        kept(once, *(again[:1].assign(**unseen, run_key=key) for key in "ab"))

    # over a recording from a file, some settings have no column: equal results are let pass
    logged = {"simulation.physics": None, "recording": "a.npz"}
    assert kept(once.assign(**logged), again.assign(**logged, step_time_us=1.0)) == 2 * len(once)
    for changed in ({"ate_rmse_m": 9.0}, {"recording_checksum": "other"}):
        with pytest.raises(InputError, match=f"{len(once)} rows"):
            kept(once.assign(**logged), again.assign(**logged, **changed))


def test_a_message_names_the_nearest_columns_and_counts_the_rest(monkeypatch):
    monkeypatch.setattr("experiments.sweeps.collect._NAMED", 2)
    with pytest.raises(InputError, match=r"nosuch; there are [\w.]+, [\w.]+ and \d+ more$"):
        sweep_figure(rows(), "nosuch", "ate_rmse_m")
    with pytest.raises(InputError, match=r"condition nosuch=1: .*, [\w.]+ and \d+ more$"):
        where(rows(), ["nosuch=1"])
    with pytest.raises(InputError, match=r"run_key holds no numbers; there are ate_rmse_m, step_t"):
        sweep_figure(rows(), "robot.kr", "run_key")


def test_long_names_leave_the_axes_their_height_and_fit_a_column():
    table = many(5).assign(
        **{"choice.estimator": lambda t: t["choice.estimator"] + "_of_a_rather_long_name"}
    )
    by = ["choice.estimator", "choice.world"]
    page = sweep_figure(table, "estimator.n_particles", "ate_rmse_m", by, size="column")
    page.draw_without_rendering()
    (ax,), (legend,) = page.axes, page.legends
    assert ax.bbox.height / page.dpi > 1.4
    assert 0.0 <= legend.get_window_extent().x0 < legend.get_window_extent().x1 <= page.bbox.width
    short = sweep_figure(
        many(5), "estimator.n_particles", "ate_rmse_m", by[:1], col=by[1], size="column"
    )
    assert short.legends[0]._ncols > 1


def test_a_panel_is_of_one_setting_and_names_are_no_mathematics():
    with pytest.raises(InputError, match=r"rows and columns of panels are both choice\.world"):
        sweep_figure(
            many(2), "seed", "ate_rmse_m", row="choice.world", col="choice.world", pool=True
        )
    odd = many(2).replace({"m00": "it's $x$"})
    x, by = "estimator.n_particles", "choice.estimator"
    page = sweep_figure(odd, x, "ate_rmse_m", by, row="choice.world")
    (legend,) = page.legends
    assert [is_math_text(text.get_text()) for text in legend.get_texts()] == [False, False]


def test_a_setting_is_written_in_one_way():
    page = sweep_figure(
        rows().replace({"robot.kr": {1e-3: 1e-4}}), "robot.kr", "ate_rmse_m", "choice.estimator"
    )
    assert [tick.get_text() for tick in page.axes[0].get_xticklabels()] == ["1e-5", "1e-4"]
    cells = as_text(pd.DataFrame({"robot.kr": [1e-5, 1e-4], "x": [1e-5, 1e-4]}))
    assert cells.to_numpy().T.tolist() == [["1e-5", "1e-4"], ["1e-05", "0.0001"]]
