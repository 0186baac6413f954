"""The page of a sweep: what it holds, and how it does in a real browser."""

import html
import json
import re

import numpy as np
import pytest

from experiments.cli import main as cli
from experiments.report import sweep_page
from experiments.report.sweep_page import extremes, picture_path, write_sweep_page
from experiments.sweeps.again import noted_config_dir
from experiments.sweeps.averages import averages
from experiments.sweeps.collect import with_answers
from sim.errors import InputError
from tests.experiments.sweeps.test_collect import many
from tests.fixtures import browser

EVIL = "</script><img src=x onerror=alert(1)><b>&lt;</b>"


def rows():
    """A sweep of three series, one of a hostile name; one run failed, one has a remark."""
    table = many(3).replace({"m01": EVIL})
    table["run_key"] = [f"{i:04x}{0:012x}" for i in range(len(table))]
    table["code_version"] = "v"
    table["status_detail"] = ""
    table.loc[3, ["status", "status_detail"]] = "remark", "gated at 12.5 s"
    table.loc[4, ["status", "status_detail"]] = "remark", "gated at 99.9 s"
    table.loc[0, ["status", "status_detail"]] = "failed", f"bad {EVIL}"
    table["simulation.physics"] = "kinematic"
    return table


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep")
    (folder / "command.txt").write_text(f"estima run -m world={EVIL}\n")
    (folder / "unfinished-1a.txt").write_text(f"60 estima run -m world={EVIL}\n")
    write_sweep_page(rows(), f"mine {EVIL}", folder, folder / "page.html")
    return folder / "page.html"


def test_the_page_is_one_small_file_in_which_nothing_from_files_is_code(path):
    text = path.read_text()
    assert len(text) < 2_000_000
    assert "<img" not in text
    held = re.search(r'id="data">(.*?)</script>', text)[1]
    assert EVIL in json.loads(held)["settings"][0]["values"]
    assert "The sweep of 60 is unfinished; to go on: <code>estima run -m world=" in text
    for words in ("2 ran, with a remark: gated at ... s", "1 failed: bad", "estima run -m world="):
        assert words in text


def test_a_sweep_without_a_sound_run_says_why_and_proposes_what_works(
    tmp_path, monkeypatch, capsys
):
    table = rows()
    monkeypatch.setattr("experiments.sweeps.collect.collect", lambda *_args, **_options: table)
    cli._show_sweep(tmp_path / "mine", len(table))
    assert "estima table mine --against m00 -o" in capsys.readouterr().out
    first = table["choice.estimator"] == "m00"
    bad = table.assign(status=table["status"].mask(first, "failed"))
    monkeypatch.setattr("experiments.sweeps.collect.collect", lambda *_args, **_options: bad)
    cli._show_sweep(tmp_path / "mine", len(bad))
    assert "--against m00" not in capsys.readouterr().out
    alone = table[table["choice.estimator"] == "m00"]
    monkeypatch.setattr("experiments.sweeps.collect.collect", lambda *_args, **_options: alone)
    cli._show_sweep(tmp_path / "mine", len(alone))
    assert "estima table mine -o" in capsys.readouterr().out
    table[["status", "status_detail"]] = "failed", "odd"
    table.loc[3:, "status_detail"] = [f"late at {i}.5 s" for i in range(len(table) - 3)]
    monkeypatch.setattr("experiments.sweeps.collect.collect", lambda *_args, **_options: table)
    cli._show_sweep(tmp_path / "mine", len(table))
    said = capsys.readouterr().out
    assert f"{len(table)} runs failed, most often ({len(table) - 3}) so: late at ... s" in said
    assert "estima table mine --rows" in said
    assert "plot" not in said
    with pytest.raises(InputError, match=f"all {len(table)} runs failed; `estima table mine`"):
        cli.plot("mine")


def test_a_page_too_large_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_page, "MOST_RUNS", 10)
    with pytest.raises(InputError, match=r"54 runs; a page holds 10.*--where"):
        write_sweep_page(rows(), "mine", tmp_path, tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


@pytest.fixture(scope="module")
def tab(path):
    if browser.find() is None:
        pytest.skip("no Chromium on this machine")
    with browser.page() as tab:
        tab.shape(1400, 900)
        tab.open(path.as_uri())
        yield tab


def choose(tab, name, value):
    tab.js(
        f"(() => {{ const s = document.getElementById('{name}'); s.value = '{value}';"
        "s.dispatchEvent(new Event('change')); })()"
    )


def test_the_chart_draws_the_means_of_tables_and_plots(tab):
    assert tab.complaints() == []
    table = with_answers(rows(), ["answer_ate_rmse_m"])
    table = table[table["status"] != "failed"]
    by = ["choice.estimator", "choice.world", "estimator.n_particles"]
    expected = averages(table, by, "recording_checksum", "answer_ate_rmse_m")
    drawn = tab.js(
        "document.getElementById('chart').data.filter(t => t.error_y)"
        ".flatMap(t => Array.from(t.y, (y, i) => [y, ...t.customdata[i]]))"
    )
    found = np.array(sorted(drawn))[:, :3].astype(float)
    order = expected.sort_values("value").to_numpy()
    np.testing.assert_allclose(found, order, rtol=1e-3)
    assert tab.js("document.getElementById('chart').layout.xaxis.type") == "log"
    assert "with 95 % intervals" in tab.js("document.getElementById('said').textContent")


def test_what_is_chosen_is_drawn_and_what_is_pooled_is_said(tab):
    choose(tab, "panels", "")
    assert "also averages over world" in tab.js("document.getElementById('said').textContent")
    choose(tab, "panels", "choice.world")
    assert tab.js("Object.keys(document.getElementById('chart').layout).includes('xaxis2')")
    said = "document.getElementById('said').textContent"
    n = f"{said}.split(' ')[0]"
    assert tab.js(said).startswith("53 runs. Not drawn: 1 failed. ")
    tab.js("document.querySelector('#filters input').click()")
    assert int(tab.js(n)) < 53
    tab.js("document.querySelector('#filters input').click()")
    assert tab.js(n) == "53"
    tab.js("[0, 1, 2].forEach((row) => { columns.get(byId('y').value).values[row] = null; })")
    choose(tab, "panels", "")
    assert tab.js(said).startswith("51 runs. Not drawn: 1 failed, 2 have no finite value. ")
    tab.open(tab.js("location.href"))


def test_without_a_run_there_are_no_axes(tab):
    said = "document.getElementById('said').textContent"
    boxes = "[...document.querySelector('#filters details').querySelectorAll('input')]"
    tab.js(f"{boxes}.forEach((box) => box.click())")
    assert tab.js(said) == "Nothing is chosen."
    assert tab.js("document.getElementById('chart').hidden")
    tab.js(f"{boxes}[0].click()")
    assert "Geometric means" in tab.js(said)
    assert not tab.js("document.getElementById('chart').hidden")
    tab.open(tab.js("location.href"))


def test_settings_that_are_not_drawn_are_no_repeats(tab):
    """As in plots: runs of three estimators over one recording are averaged geometrically."""
    choose(tab, "colour", "")
    choose(tab, "panels", "")
    said = tab.js("document.getElementById('said').textContent")
    assert "also averages over estimator; world, geometrically" in said
    table = with_answers(rows(), ["answer_ate_rmse_m"])
    table = table[table["status"] != "failed"]
    by, others = ["estimator.n_particles"], ["choice.world", "choice.estimator"]
    expected = averages(table, by, "recording_checksum", "answer_ate_rmse_m", others)
    drawn = tab.js("Array.from(document.getElementById('chart').data.find(t => t.error_y).y)")
    np.testing.assert_allclose(drawn, expected["value"], rtol=1e-4)
    tab.open(tab.js("location.href"))


def test_an_estimator_that_always_failed_has_no_tick(tab):
    column = "columns.get('choice.estimator').values"
    tab.js(f"{column}.forEach((v, row) => {{ if (v === 'm00') data.failed[row] = 1; }})")
    choose(tab, "x", "choice.estimator")
    ticks = tab.js("document.getElementById('chart').layout.xaxis.ticktext")
    assert len(ticks) == 2
    assert "m00" not in ticks
    tab.open(tab.js("location.href"))


def test_a_page_of_one_run(tmp_path, tab):
    home = tab.js("location.href")
    one = rows().query("status == 'ok'")[:1].assign(ate_rmse_m=0.006152)
    one["robot.kr"] = 1e-5
    write_sweep_page(one, "one", tmp_path, tmp_path / "one.html")
    tab.open((tmp_path / "one.html").as_uri())
    assert tab.js("document.getElementById('said').textContent").startswith("1 run. ")
    assert tab.js("document.title") == "one: 1 run"
    ticks = tab.js("[...document.querySelectorAll('#chart .ytick text')].map(t => t.textContent)")
    assert max(map(len, ticks)) < 8
    assert tab.js("document.getElementById('chart').data.every(t => t.y[0] === 0.006152)")
    tab.open(home)


def test_a_setting_is_written_in_one_way(tmp_path, tab):
    home = tab.js("location.href")
    table = rows().replace({"estimator.n_particles": {1: 1e-5, 2: 1e-4, 4: 1e-3}})
    write_sweep_page(table, "mine", tmp_path, tmp_path / "page.html")
    tab.open((tmp_path / "page.html").as_uri())
    written = ["1e-5", "1e-4", "1e-3"]
    assert tab.js("document.getElementById('chart').layout.xaxis.ticktext") == written
    choose(tab, "colour", "estimator.n_particles")
    legend = "[...document.querySelectorAll('#chart .legendtext')].map(t => t.textContent)"
    assert tab.js(legend) == written
    assert ">1e-4</td>" in (tmp_path / "page.html").read_text()
    tab.open(home)


def test_commands_name_the_folder_of_own_options(tmp_path):
    (tmp_path / "command.txt").write_text("estima run -m --config-dir 'my own' estimator=a\n")
    write_sweep_page(rows(), "mine", tmp_path, tmp_path / "page.html")
    text = html.unescape((tmp_path / "page.html").read_text())
    assert re.search(r"estima view mine/\w+ --config-dir 'my own' -o run\.html", text)
    (tmp_path / "command.txt").write_text("estima run -m estimator=a\n")
    assert noted_config_dir(tmp_path) is None


def test_names_are_no_markup_for_the_chart(tab):
    legend = "[...document.querySelectorAll('#chart .legendtext')].map(t => t.textContent)"
    assert EVIL in tab.js(legend)
    choose(tab, "x", "choice.estimator")
    ticks = "[...document.querySelectorAll('#chart .xtick text')].map(t => t.textContent)"
    assert EVIL in tab.js(ticks)
    choose(tab, "panels", "choice.estimator")
    assert f"estimator: {EVIL}" in tab.js(
        "[...document.querySelectorAll('#chart .annotation')].map(t => t.textContent)"
    )
    tab.open(tab.js("location.href"))


def test_colours_stand_beside_each_other_over_the_name_of_their_word(tab):
    choose(tab, "x", "choice.world")
    choose(tab, "colour", "choice.estimator")
    choose(tab, "panels", "")
    chart = "document.getElementById('chart')"
    first = tab.js(f"{chart}.data.filter(t => t.error_y).map(t => t.x[0])")
    assert len(set(first)) == 3
    np.testing.assert_allclose(np.mean(first), 0.0, atol=1e-12)
    assert tab.js(f"{chart}.layout.xaxis.tickvals") == [0, 1]
    assert tab.js(f"{chart}.layout.xaxis.ticktext") == ["v", "w"]
    choose(tab, "panels", "choice.estimator")
    low, high = tab.js(f"{chart}._fullLayout.yaxis.range")
    drawn = np.array(tab.js(f"{chart}.data.flatMap(t => t.y)"))
    if tab.js(f"{chart}.layout.yaxis.type") == "log":
        drawn = np.log10(drawn)
    assert low < drawn.min() < drawn.max() < high
    assert high - low < 2.0 * np.ptp(drawn)  # not Plotly's range of no data
    tab.open(tab.js("location.href"))


def test_seeds_are_not_joined(tab):
    modes = "document.getElementById('chart').data.filter(t => t.error_y).map(t => t.mode)"
    assert set(tab.js(modes)) == {"lines+markers"}
    choose(tab, "x", "seed")
    assert set(tab.js(modes)) == {"markers"}
    tab.open(tab.js("location.href"))


def test_of_each_estimator_the_best_and_the_worst_run_are_shown_and_more_of_one(tab):
    shown = "[...document.querySelectorAll('#extremes tbody tr:not([hidden])')]"
    kinds = f"{shown}.map(r => [r.cells[0].textContent, r.cells[1].textContent])"
    assert tab.js(kinds) == [
        *([EVIL, kind] for kind in ("best", "worst")),
        *(["m00", kind] for kind in ("best", "worst", "failed")),
        *(["m02", kind] for kind in ("best", "worst")),
    ]
    choose(tab, "of", "m02")
    assert tab.js(kinds) == [["m02", kind] for kind in ["best"] * 3 + ["worst"] * 3]
    errors = tab.js(f"{shown}.map(r => parseFloat(r.cells[2].textContent))")
    assert errors[:3] == sorted(errors[:3])
    assert errors[3:] == sorted(errors[3:], reverse=True)
    assert errors[2] <= errors[5]
    choose(tab, "of", "")


def test_a_click_on_a_run_gives_its_command_or_its_picture(tab, path):
    click = "document.getElementById('chart').emit('plotly_click', {points: [{customdata: %s}]})"
    picked = "document.getElementById('picked')"
    tab.js(click % 5)
    key = rows()["run_key"][5]
    assert f"/{key[:10]} -o run.html" in tab.js(f"{picked}.textContent")
    before = tab.js(f"{picked}.textContent")
    tab.js(click % "[1, 2, 3, null]")  # a mean of several runs
    assert tab.js(f"{picked}.textContent") == before
    tab.js("document.querySelector('#picked .copy').click()")
    assert tab.becomes("document.querySelector('#picked .copy').textContent != 'copy'")
    assert tab.complaints() == []


def test_pictures_that_are_there_are_linked(tmp_path):
    table = rows()
    page = tmp_path / "my page.html"
    runs = extremes(table)
    best = runs[runs["first"] & (runs["kind"] == "best")].iloc[0]
    picture_path(best, page).parent.mkdir(parents=True)
    picture_path(best, page).write_text("x")
    write_sweep_page(table, "mine", tmp_path, page)
    links = re.findall(r'<a href="([^"#]+)">watch', page.read_text())
    assert links == [f"my%20page/pictures/{best['run_key'][:10]}.html"]


def test_a_wide_table_scrolls_in_its_own_box(tab):
    tab.js("document.querySelector('.sortable').style.width = '3000px'")
    box = "document.querySelector('.scroll')"
    assert tab.js(f"{box}.scrollWidth > {box}.clientWidth")
    assert tab.js("document.documentElement.scrollWidth <= innerWidth")
    tab.js(f"{box}.scrollTo(400, 0)")
    first = "document.querySelector('.sortable td').getBoundingClientRect().left"
    assert tab.js(f"{first} == {box}.getBoundingClientRect().left")  # names stay in sight
    tab.js("document.querySelector('.sortable').style.width = ''")


def test_tables_are_sorted_by_keyboard(tab):
    head = "document.querySelectorAll('table.sortable th button')"
    assert tab.js(f"{head}.length") > 4
    at = tab.js(f"[...{head}].findIndex(b => b.textContent.startsWith('ATE'))")
    tab.js(f"{head}[{at}].focus()")
    rows_of = "[...document.querySelectorAll('.sortable tbody tr')]"
    cells = f"{rows_of}.map(r => parseFloat(r.cells[{at}].textContent))"
    tab.press("Enter", text="\r")
    assert tab.becomes(f"{head}[{at}].parentElement.ariaSort == 'ascending'")
    assert tab.js(cells) == sorted(tab.js(cells))
    tab.press("Enter", text="\r")
    assert tab.becomes(f"{head}[{at}].parentElement.ariaSort == 'descending'")
    assert tab.js(cells) == sorted(tab.js(cells), reverse=True)


@pytest.mark.parametrize("dark", [False, True])
def test_phones_and_dark_mode(tab, dark):
    tab.shape(390, 800, dark=dark)
    assert tab.becomes("document.getElementById('chart').getBoundingClientRect().width <= 390")
    assert tab.becomes("document.documentElement.scrollWidth <= 390")
    ink = tab.js("getComputedStyle(document.body).color")
    assert tab.becomes(
        f"getComputedStyle(document.querySelector('#chart .xtick text')).fill == '{ink}'"
    )
    assert tab.complaints() == []
