"""How runs are averaged, what the table of a sweep marks, and the files that it becomes."""

import re
import shutil
import subprocess

import numpy as np
import pandas as pd
import pytest
from scipy import stats
from typer.testing import CliRunner

from experiments.cli.main import app
from experiments.evaluation.statistics import holm, mean_interval, paired_p
from experiments.report.plot import sweep_figure
from experiments.report.table import WIDTHS_PT, notes, statuses, write_table
from experiments.runs.columns import COLUMNS, Average
from experiments.sweeps.averages import averages, unit_of
from experiments.sweeps.summary import summary
from sim.errors import InputError


def runs(n=12, repeats=2, ratio=2.0):
    """Estimators `a` and `b` over n recordings; b has `ratio` times the error of a."""
    rng = np.random.default_rng(0)
    of_recording = np.exp(rng.normal(size=n))
    rows = [
        {
            "choice.estimator": name,
            "choice.world": "w_1",
            "seed": recording,
            "repeat": repeat,
            "run_key": f"{name}{recording}",
            "code_version": "v",
            "recording_checksum": f"r{recording:02d}",
            "status": "ok",
            "ate_rmse_m": error * factor * np.exp(0.1 * rng.normal()),
            "nees_mean": 3.0 + rng.normal(),
        }
        for recording, error in enumerate(of_recording)
        for name, factor in (("a", 1.0), ("b", ratio))
        for repeat in range(repeats)
    ]
    return pd.DataFrame(rows)


def test_errors_pool_repeats_by_squares_and_recordings_geometrically():
    table = runs().query("`choice.estimator` == 'a'")
    (found,) = averages(table, ["choice.world"], "recording_checksum", "ate_rmse_m").itertuples()
    each = table["ate_rmse_m"].to_numpy().reshape(12, 2)
    logs = np.log(np.sqrt((each**2).mean(axis=1)))
    expected = np.exp(list(vars(mean_interval(logs)).values()))
    np.testing.assert_allclose(found[1:], expected)
    (nees,) = averages(table, ["choice.world"], "recording_checksum", "nees_mean").itertuples()
    each = table["nees_mean"].to_numpy().reshape(12, 2).mean(axis=1)
    np.testing.assert_allclose(nees[1:], list(vars(mean_interval(each)).values()))


def test_errors_over_the_bound_are_pooled_and_a_cheat_is_called():
    table = runs(ratio=0.01).assign(heading_rmse_rad=0.1)
    with pytest.raises(InputError, match="no row has a bound"):
        summary(table, efficiency=True)
    of_a = table.query("`choice.estimator` == 'a'")
    least = table["seed"].map(of_a.groupby("seed")["ate_rmse_m"].max())
    table = table.assign(bound_rmse_m=least / 1.5, bound_heading_rad=np.nan)
    found = summary(table, efficiency=True).set_index("choice.estimator")
    own = table.loc[of_a.index, ["ate_rmse_m", "bound_rmse_m"]] ** 2
    assert found.loc["a", "position_over_bound"] == pytest.approx(
        np.sqrt(own["ate_rmse_m"].sum() / own["bound_rmse_m"].sum())
    )
    assert found["below_bound"].to_dict() == {"a": "", "b": "position"}
    assert "should not see" in notes(found.reset_index(), None)
    lines = sweep_figure(table, "seed", "ate_rmse_m", "choice.estimator").axes[0].get_lines()
    assert [line.get_ydata()[0] for line in lines if line.get_linestyle() == ":"] == pytest.approx(
        2 * [least.iloc[0] / 1.5]
    )


def test_settings_are_no_repeats():
    """Errors of 1 and 100 of two estimators over each recording are 10, not 71."""
    table = runs().assign(ate_rmse_m=np.tile([1.0, 1.0, 100.0, 100.0], 12))
    unit, by = "recording_checksum", ["choice.world"]
    (found,) = averages(table, by, unit, "ate_rmse_m", ["choice.estimator"])["value"]
    assert found == pytest.approx(10.0)
    page = sweep_figure(table, "choice.world", "ate_rmse_m", pool=True)
    assert page.axes[0].get_lines()[0].get_ydata() == pytest.approx([10.0])
    assert "over recordings and estimator" in page.get_suptitle().replace("\n", " ")
    table["estimator.n"] = table["ate_rmse_m"]
    against = summary(table.assign(**{"choice.estimator": "a"}), against="a")
    assert against["ate_rmse_over_a"].tolist() == pytest.approx([0.1, 10.0])


def test_one_recording_gives_intervals_over_its_repeats_and_one_run_none():
    one = runs(n=1, repeats=5)
    assert unit_of(one, ["choice.estimator"]) == "repeat"
    assert unit_of(runs(), ["choice.estimator"]) == "recording_checksum"
    found = averages(one, ["choice.estimator"], "repeat", "ate_rmse_m")
    assert (found["low"] < found["value"]).all()
    alone = averages(one[:1], ["choice.estimator"], "recording_checksum", "ate_rmse_m")
    assert alone[["low", "high"]].isna().all(axis=None)
    zero = averages(one.assign(ate_rmse_m=0.0), ["choice.estimator"], "repeat", "ate_rmse_m")
    assert (zero["value"] == 0.0).all()


def test_every_metric_says_how_it_is_averaged():
    assert {c.unit for c in COLUMNS.values() if c.average is Average.ERROR} == {"m", "rad"}
    assert all(c.average is Average.PLAIN for c in COLUMNS.values() if not c.unit)


def test_the_best_is_that_of_the_same_recordings_and_has_no_failures():
    table = runs()
    other = runs().assign(**{"choice.world": "w_2"})
    other["recording_checksum"] = "s" + other["recording_checksum"]
    other["ate_rmse_m"] *= 0.01
    both = pd.concat([table, other], ignore_index=True)
    best = summary(both).set_index(["choice.estimator", "choice.world"])["answer_ate_rmse_m_best"]
    assert best["a"].all()
    assert not best["b"].any()
    table.loc[0, "status"] = "failed"
    best = summary(table).set_index("choice.estimator")["answer_ate_rmse_m_best"]
    assert best.to_dict() == {"a": False, "b": True}  # a leaves out what was hard


@pytest.mark.parametrize(("code", "incomplete"), [("gap", 2), ("estimator", 0)])
def test_what_gives_no_pose_for_some_of_the_drive_is_never_the_best(tmp_path, code, incomplete):
    table = runs(repeats=1).assign(status_code="", status_detail="")
    table.loc[[0, 2], ["status", "status_code", "status_detail"]] = (
        "remark",
        code,
        "no pose for 9 s",
    )
    found = summary(table)
    best = found.set_index("choice.estimator")["answer_ate_rmse_m_best"]
    assert best.to_dict() == {"a": not incomplete, "b": bool(incomplete)}
    assert found["incomplete"].tolist() == [incomplete, 0]
    assert found["with_remarks"].tolist() == [2, 0]
    for name in ("t.tex", "t.md", "t.html", "t.csv"):
        write_table(found, notes(found, None), tmp_path / name, "mine")
        text = (tmp_path / name).read_text()
        if name != "t.csv":
            assert ("incomplete" in text) is bool(incomplete)
            assert ("runs without a pose for some of the drive" in text) is bool(incomplete)


def wide():
    """The summary of a sweep of long names and many results."""
    table = runs().replace({"b": "a_very_long_name_of_many_words_and_letters"})
    rng = np.random.default_rng(0)
    for name in ("ate_aligned_rmse_m", "heading_rmse_rad", "step_time_us", "cpu_time_us"):
        table[name] = rng.lognormal(size=len(table))
    table.insert(
        2, "sensors.stereo.max_distance_m", np.where(table["choice.estimator"] == "a", 5, 9)
    )
    return summary(table, against="a")


def test_a_table_too_wide_for_the_text_becomes_several_of_the_same_rows(tmp_path):
    write_table(wide(), "note", tmp_path / "t.tex", "mine")
    text = (tmp_path / "t.tex").read_text()
    assert check_latex(text) == [3, 3, 3]  # the name has two lines
    assert text.count("RMSE, m") == text.count(r"step, $\mu$s") == 1
    assert len(re.findall(r"(?m)^a & ", text)) == 3
    write_table(wide(), "note", tmp_path / "page.tex", "mine", "page")
    assert check_latex((tmp_path / "page.tex").read_text()) == [3, 3]


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdfLaTeX")
@pytest.mark.parametrize("size", list(WIDTHS_PT))
def test_tables_go_straight_into_an_article_and_fit(tmp_path, size):
    write_table(wide(), r"note <>_&%$#~^\{}|", tmp_path / "t.tex", "mine", size)
    (tmp_path / "paper.tex").write_text(
        rf"\documentclass{{article}}\usepackage{{booktabs}}\textwidth={WIDTHS_PT[size]}pt"
        r"\begin{document}\begin{table}\input{t}\end{table}\end{document}"
    )
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert "Overfull" not in done.stdout


@pytest.mark.parametrize(("ratio", "differs"), [(2.0, True), (1.0, False)])
def test_differences_are_marked_by_paired_tests(ratio, differs):
    table = runs(ratio=ratio)
    compared = summary(table, against="a")
    found = compared.set_index("choice.estimator")
    assert found["answer_ate_rmse_m_differs"].to_dict() == {"a": False, "b": differs}
    assert not found["answer_nees_mean_differs"].any()
    assert found["ate_rmse_over_a_low"]["b"] < ratio < found["ate_rmse_over_a_high"]["b"]
    assert ("*: differs from a" in notes(compared, "a")) is differs


def test_p_of_pairs_is_scipys_and_equal_arms_never_differ():
    rng = np.random.default_rng(1)
    first, second = rng.normal(size=(2, 9))
    assert paired_p(first - second) == pytest.approx(stats.ttest_rel(first, second).pvalue)
    assert paired_p(np.zeros(5)) == 1.0
    assert paired_p(np.ones(5)) == 0.0
    assert np.isnan(paired_p([1.0]))
    assert holm([0.01, 0.04, 0.03], 0.05) == [True, False, False]


def test_metrics_are_chosen_and_unknown_ones_refused():
    found = summary(runs(), metrics=["nees_mean"])
    assert [c for c in found if c in COLUMNS] == ["nees_mean"]
    with pytest.raises(
        InputError, match=r"no column nees; did you mean answer_nees_mean\? there are"
    ):
        summary(runs(), metrics=["nees"])
    with pytest.raises(InputError, match=r"no column xyzzy; there are answer_ate_rmse_m, "):
        summary(runs(), metrics=["xyzzy"])


def check_latex(text):
    """Braces, environments, mathematics and cells are whole; nothing is left unescaped.

    Gives the lines of each tabular, below its headings, that begin with a word.
    """
    text = re.sub(r"(?m)^%.*\n", "", text)
    bare = re.sub(r"\\[\\{}%&#_$]", "", text)
    assert bare.count("{") == bare.count("}")
    assert bare.count("$") % 2 == 0
    outside = re.sub(r"\$[^$]*\$", "", bare)
    assert not re.search(r"[_^#%~<>|\"`]|--", outside)
    begun, ended = (re.findall(rf"\\{word}{{(\w+)}}", text) for word in ("begin", "end"))
    assert begun == ended == ["tabular"] * len(begun)
    counts = []
    for columns, inside in re.findall(
        r"(?s)\\begin{tabular}{([lr]+)}\s*\\toprule(.*?)\\bottomrule", text
    ):
        head, body = inside.replace(r"\addlinespace", "").split(r"\midrule")
        rows = [row for part in (head, body) for row in part.split(r"\\") if row.strip()]
        assert {len(re.findall(r"(?<!\\)&", row)) + 1 for row in rows} == {len(columns)}
        counts.append(sum(not row.lstrip("\n").startswith(" &") for row in body.split(r"\\")[:-1]))
    return counts


def test_tables_are_written_for_papers_and_pages(tmp_path):
    table = runs().replace({"b": "<b>&%_#^w"})
    table["ate_rmse_m"] *= 1e-4
    found = summary(table, against="a")
    note = notes(found, "a")
    for name in ("t.tex", "t.md", "t.html", "t.csv"):
        write_table(found, note, tmp_path / name, "sweep <i>")
    texts = {path.suffix: path.read_text() for path in tmp_path.iterdir()}
    assert check_latex(texts[".tex"]) == [2]
    assert r"\textbf{" in texts[".tex"]
    assert r"\times 10^{-5}" in texts[".tex"]
    assert "RMSE, m" in texts[".tex"]
    assert r"\textless{}b\textgreater{}\&\%\_\#\textasciicircum{}w" in texts[".tex"]
    assert len(re.findall(r"\*\*[\d.e-]+\*\* \[", texts[".md"])) == 1
    assert r"\<b>\&%\_#^w" in texts[".md"]
    assert (
        len(
            re.findall(r"<td class=.number.><b>[\d.e-]+</b> <span class=.whole.>\[", texts[".html"])
        )
        == 1
    )
    assert "&lt;b&gt;&amp;%_#^w" in texts[".html"]
    assert "sweep &lt;i&gt;" in texts[".html"]
    assert "script-src &" not in texts[".html"]
    again = pd.read_csv(tmp_path / "t.csv")
    assert again["answer_ate_rmse_m_low"].tolist() == pytest.approx(
        found["answer_ate_rmse_m_low"].tolist()
    )


def test_a_table_that_latex_would_refuse_is_found():
    good = r"\begin{tabular}{lr}\toprule a & b\\ \midrule 1 & 2\\ \bottomrule\end{tabular}"
    assert check_latex(good) == [1]
    bads = [("1 & 2", "1 & 2 & 3"), ("a &", "a_b &"), ("a &", "a<b &"), ("tabular}", "tabular}}")]
    for bad in [good.replace(*bad) for bad in bads]:
        with pytest.raises(AssertionError):
            check_latex(bad)


def test_statuses_are_words_with_counts():
    table = runs(n=3, repeats=1).assign(status_detail="")
    table.loc[:2, "status"] = "remark"
    table.loc[:2, "status_detail"] = ["gated at 1.5 s", "gated at 20 s", "lost"]
    assert statuses(table) == [
        ("ran to the end", 3),
        ("ran, with a remark: gated at ... s", 2),
        ("ran, with a remark: lost", 1),
    ]


def test_the_command_refuses_other_endings_before_it_reads(tmp_path):
    sized = (["--size", "page"], ["--size", "huge", "-o", "x.tex"])
    for arguments in (["-o", "x.xlsx"], ["--rows"], ["--rows", "-o", "x.tex"], *sized):
        done = CliRunner().invoke(app, ["table", str(tmp_path / "none"), *arguments])
        assert isinstance(done.exception, InputError)
        assert re.search(
            r"a table is \.tex|name the file|no sweep|the size|size page|with --rows",
            str(done.exception),
        )
