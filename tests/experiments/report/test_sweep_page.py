"""The page of a sweep: what it holds, and how it does in a real browser."""

import html
import json
import os
import platform
import re

import numpy as np
import pandas as pd
import pytest

from experiments.cli import sweep
from experiments.report import of_sweep, sweep_page
from experiments.report.sweep_page import extremes, picture_path, write_sweep_page
from experiments.sweeps.averages import averages
from experiments.sweeps.collect import with_answers
from experiments.sweeps.commands import noted_config_dir
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
    assert "<img src=x" not in text
    held = re.search(r'id="data">(.*?)</script>', text)[1]
    assert EVIL in json.loads(held)["settings"][0]["words"]
    assert "The sweep of 60 is unfinished; to go on: <code>estima run -m world=" in text
    for words in ("2 ran, with a remark: gated at ... s", "1 failed: bad", "estima run -m world="):
        assert words in text


def test_a_sweep_without_a_sound_run_says_why_and_proposes_what_works(
    tmp_path, monkeypatch, capsys
):
    table = rows()
    monkeypatch.setattr(sweep, "collect", lambda *_args, **_options: table)
    sweep.show_sweep(tmp_path / "mine", len(table))
    assert "estima table mine --against m00 -o" in capsys.readouterr().out
    first = table["choice.estimator"] == "m00"
    bad = table.assign(status=table["status"].mask(first, "failed"))
    monkeypatch.setattr(sweep, "collect", lambda *_args, **_options: bad)
    sweep.show_sweep(tmp_path / "mine", len(bad))
    assert "--against m00" not in capsys.readouterr().out
    alone = table[table["choice.estimator"] == "m00"]
    monkeypatch.setattr(sweep, "collect", lambda *_args, **_options: alone)
    sweep.show_sweep(tmp_path / "mine", len(alone))
    assert "estima table mine -o" in capsys.readouterr().out
    table[["status", "status_detail"]] = "failed", "odd"
    table.loc[3:, "status_detail"] = [f"late at {i}.5 s" for i in range(len(table) - 3)]
    monkeypatch.setattr(sweep, "collect", lambda *_args, **_options: table)
    sweep.show_sweep(tmp_path / "mine", len(table))
    said = capsys.readouterr().out
    assert f"{len(table)} runs failed, most often ({len(table) - 3}) so: late at ... s" in said
    assert "estima table mine --rows" in said
    assert "plot" not in said
    panels = of_sweep.Panels(None, "y", [], None, None, "screen", pool=False)
    with pytest.raises(InputError, match=f"all {len(table)} runs failed; `estima table mine`"):
        of_sweep.plot_of(table, "mine", panels, tmp_path)


def test_the_intervals_of_a_decided_sweep_are_drawn_as_they_narrow(tmp_path, chromium):
    looks = [(12, 0.8, 3.2, "open"), (20, 1.2, 2.4, "lost")]
    rows_ = [
        {"seeds": n, "over_recordings": EVIL, "arm": "b", "against": "a", "value": 1.7,
         "low": low, "high": high, "found": found}
        for n, low, high, found in looks
    ]  # fmt: skip
    record = {"metric": "answer_ate_rmse_m", "margin": 0.1, "looks": [12, 20, 40], "made": 40,
              "total": 80, "comparisons": rows_}  # fmt: skip
    (tmp_path / "decided.json").write_text(json.dumps(record))
    write_sweep_page(rows(), "mine", tmp_path, tmp_path / "page.html")
    assert "b loses to a (1.7 [1.2, 2.4])" in (tmp_path / "page.html").read_text()
    chromium.open((tmp_path / "page.html").as_uri())
    assert chromium.js("drawnNarrowing.then(() => byId('narrowing').innerText)").count("b over a")
    lengths = chromium.js(
        "[...document.querySelectorAll('#narrowing .role-mark line[stroke=\"#0072B2\"]')]"
        ".map((l) => Math.abs(l.getAttribute('y2')))"
    )
    assert len(lengths) == 2
    assert lengths[0] / lengths[1] == pytest.approx(np.log(3.2 / 0.8) / np.log(2.4 / 1.2), rel=0.02)


def test_a_page_follows_a_sweep_until_it_has_ended(tmp_path, monkeypatch, capsys):
    (tmp_path / "unfinished-1a.txt").write_text("60 estima run -m seed=0,1\n")
    (tmp_path / "plan-1a.json").write_text(json.dumps({"planner": [platform.node(), os.getpid()]}))
    monkeypatch.setattr(of_sweep, "FOLLOW_S", 0.01)
    seen, page = [], tmp_path / "page.html"

    def read():
        seen.append(page.read_text() if page.exists() else "")
        if len(seen) == 1:
            raise InputError("no row yet")
        if len(seen) == 4:
            (tmp_path / "unfinished-1a.txt").unlink()
        return rows().iloc[: 20 + 5 * min(len(seen), 3)]

    assert of_sweep.follow(read, str(tmp_path), page, None).endswith("page.html")
    assert len(seen) == 5
    assert 'http-equiv="refresh"' in seen[2]
    assert "The sweep of 60 goes on; this page loads again every 0.01 s." in seen[2]
    assert 'http-equiv="refresh"' not in page.read_text()
    assert [line.split(": ")[1] for line in capsys.readouterr().err.splitlines()] == [
        "no row yet",
        "30 rows",
        "35 rows",
    ]


def test_a_page_ends_with_a_sweep_that_was_stopped(tmp_path, monkeypatch, capsys):
    (tmp_path / "unfinished-1a.txt").write_text("60 estima run -m seed=0,1\n")
    monkeypatch.setattr(of_sweep, "FOLLOW_S", 0.01)
    of_sweep.follow(rows, str(tmp_path), tmp_path / "page.html", None)
    said = capsys.readouterr().err
    assert said.endswith("the sweep was stopped; go on with\nestima run -m seed=0,1\n")


def test_a_page_too_large_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(sweep_page, "MOST_RUNS", 10)
    with pytest.raises(InputError, match=r"54 runs; a page holds 10.*condition"):
        write_sweep_page(rows(), "mine", tmp_path, tmp_path / "page.html")
    assert not (tmp_path / "page.html").exists()


@pytest.fixture(scope="module")
def chromium():
    if browser.find() is None:
        pytest.skip("no Chromium on this machine")
    with browser.page() as tab:
        yield tab


@pytest.fixture
def tab(chromium, path):
    chromium.events.clear()
    chromium.shape(1400, 900)
    chromium.open(path.as_uri())
    chromium.js("drawn")
    return chromium


def choose(tab, name, value):
    """Choose in a list, by the text of the option."""
    tab.js(
        f"(() => {{ const s = byId('{name}');"
        f"s.value = [...s.options].find((o) => o.text === {json.dumps(value)}).value;"
        "s.dispatchEvent(new Event('change', { bubbles: true })); return drawn; })()"
    )


SAID = "byId('said').textContent"
Y = "position RMSE, m"


def drawn(tab, *names):
    """These values of every mean of the chart, sorted, from its `datum` or its `item`."""
    found = tab.js(
        "(() => { const found = []; const walk = (item) => {"
        "if (item.mark?.marktype === 'symbol' && 'spread' in item.datum)"
        f"{{ const datum = item.datum; found.push([{', '.join(names)}]); }}"
        "(item.items ?? []).forEach(walk); }; walk(chart.scenegraph().root); return found; })()"
    )
    return sorted(found, key=lambda values: values[0])


def texts(tab, part):
    """The texts of a part of the chart, such as `axis-label`."""
    return tab.js(
        f"[...document.querySelectorAll('#chart .role-{part} text')].map(t => t.textContent)"
    )


def sound():
    table = with_answers(rows(), ["answer_ate_rmse_m"])
    return table[table["status"] != "failed"]


def test_the_chart_draws_the_means_of_tables_and_plots(tab):
    means = np.array(drawn(tab, "datum.value", "datum.low", "datum.high"), float)
    assert tab.complaints() == []
    by = ["choice.estimator", "choice.world", "estimator.n_particles"]
    expected = averages(sound(), by, "recording_checksum", "answer_ate_rmse_m")
    np.testing.assert_allclose(means, expected.sort_values("value").to_numpy(), rtol=1e-4)
    assert tab.js("chart.scale('x').type") == "log"
    assert "[95 % interval of 3 or more]" in tab.js(SAID)


def test_a_mean_of_repeats_is_that_of_squares_and_one_over_a_zero_is_zero(tmp_path, tab):
    """The averages of the page follow `sweeps.averages` where its rule has cases."""
    table = sound().query("`choice.estimator` == 'm02'")
    again = table.assign(repeat=1, ate_rmse_m=2.0 * table["ate_rmse_m"], nees_mean=1.0)
    table = pd.concat([table.assign(nees_mean=4.0), again], ignore_index=True)
    table.loc[0, "ate_rmse_m"] = table.loc[len(again), "ate_rmse_m"] = 0.0
    write_sweep_page(table, "mine", tmp_path, tmp_path / "page.html")
    tab.open((tmp_path / "page.html").as_uri())
    tab.js("drawn")
    for unit, data in (("recording_checksum", table), ("repeat", table.query("seed == 1"))):
        if unit == "repeat":
            tab.js("document.querySelectorAll('#filters label').forEach((label) => {"
                   "if (label.closest('details').textContent.includes('seed')"
                   "&& label.textContent.trim() !== '1') label.click(); })")  # fmt: skip
        for text, name in (
            (Y, "answer_ate_rmse_m"),
            ("mean NEES (3 when consistent)", "nees_mean"),
        ):
            choose(tab, "y", text)
            groups = ["choice.world", "estimator.n_particles"]
            expected = averages(with_answers(data, [name]), groups, unit, name).to_numpy()
            found = np.array(drawn(tab, "datum.value", "datum.low", "datum.high"), float)
            order = np.lexsort(expected.T[::-1])
            np.testing.assert_allclose(found[:, 0], expected[order, 0], rtol=1e-4)
            bounded = np.isfinite(expected[order]).all(axis=1) & (found[:, 0] > 0.0)
            np.testing.assert_allclose(found[bounded], expected[order][bounded], rtol=1e-4)
            assert ("over repeats" in tab.js(SAID)) == (unit == "repeat")


def test_what_is_chosen_is_drawn_and_what_is_pooled_is_said(tab):
    choose(tab, "panels", "none")
    assert "also averages over world" in tab.js(SAID)
    choose(tab, "panels", "world")
    assert {panel for (panel,) in drawn(tab, "datum.panel")} == {"world: v", "world: w"}
    n = f"{SAID}.split(' ')[0]"
    assert tab.js(SAID).startswith("53 runs. Not drawn: 1 failed. ")
    tab.js("document.querySelector('#filters input').click()")
    assert int(tab.js(n)) < 53
    tab.js("document.querySelector('#filters input').click()")
    assert tab.js(n) == "53"
    tab.js("[0, 1, 2].forEach((row) => { data.metrics[byId('y').value].values[row] = null; })")
    choose(tab, "panels", "none")
    said = "51 runs. Not drawn: 1 failed, 2 without a finite value. "
    assert tab.js(SAID).startswith(said)


def test_without_a_run_there_are_no_axes(tab):
    boxes = "[...document.querySelector('#filters details').querySelectorAll('input')]"
    tab.js(f"{boxes}.forEach((box) => box.click())")
    assert tab.js(SAID) == "Nothing is chosen."
    assert tab.js("byId('chart').hidden")
    tab.js(f"{boxes}[0].click()")
    assert "Geometric mean" in tab.js(SAID)
    assert not tab.js("byId('chart').hidden")


def test_settings_that_are_not_drawn_are_no_repeats(tab):
    """As in plots: runs of three estimators over one recording are averaged geometrically."""
    choose(tab, "colour", "none")
    choose(tab, "panels", "none")
    assert "also averages over estimator; world: choose" in tab.js(SAID)
    by, others = ["estimator.n_particles"], ["choice.world", "choice.estimator"]
    expected = averages(sound(), by, "recording_checksum", "answer_ate_rmse_m", others)
    found = [value for (value,) in drawn(tab, "datum.value")]
    np.testing.assert_allclose(found, sorted(expected["value"]), rtol=1e-4)


def test_an_estimator_that_always_failed_has_no_tick(tab):
    estimators = "data.settings.find((s) => s.title === 'estimator')"
    tab.js(f"{estimators}.codes.forEach((c, row) => {{ if ({estimators}.words[c] === 'm00')"
           "data.failed[row] = 1; })")  # fmt: skip
    choose(tab, "x", "estimator")
    labels = texts(tab, "axis-label")
    assert "m02" in labels
    assert "m00" not in labels


def test_a_page_of_one_run(tmp_path, tab):
    one = rows().query("status == 'ok'")[:1].assign(ate_rmse_m=0.006152)
    one["robot.kr"] = 1e-5
    write_sweep_page(one, "one", tmp_path, tmp_path / "one.html")
    tab.open((tmp_path / "one.html").as_uri())
    tab.js("drawn")
    assert drawn(tab, "datum.value") == [[pytest.approx(0.006152)]]
    assert tab.js(SAID).startswith("1 run. ")
    assert tab.js("document.title") == "one: 1 run"
    assert max(map(len, texts(tab, "axis-label"))) < 8


def test_a_setting_is_written_in_one_way(tmp_path, tab):
    table = rows().replace({"estimator.n_particles": {1: 1e-5, 2: 1e-4, 4: 1e-3}})
    write_sweep_page(table, "mine", tmp_path, tmp_path / "page.html")
    tab.open((tmp_path / "page.html").as_uri())
    tab.js("drawn")
    written = ["1e-5", "1e-4", "1e-3"]
    assert set(written) <= {*texts(tab, "axis-label")}
    choose(tab, "colour", "number of particles")
    assert texts(tab, "legend-label") == written
    assert ">1e-4</td>" in (tmp_path / "page.html").read_text()


def test_commands_name_the_folder_of_own_options(tmp_path):
    (tmp_path / "command.txt").write_text("estima run -m --config-dir 'my own' estimator=a\n")
    write_sweep_page(rows(), "mine", tmp_path, tmp_path / "page.html")
    text = html.unescape((tmp_path / "page.html").read_text())
    assert re.search(r"estima view mine/\w+ --config-dir 'my own' -o run\.html", text)
    (tmp_path / "command.txt").write_text("estima run -m estimator=a\n")
    assert noted_config_dir(tmp_path) is None


def test_names_are_no_markup_for_the_chart(tab):
    assert EVIL in texts(tab, "legend-label")
    choose(tab, "x", "estimator")
    assert any(EVIL.startswith(text.rstrip("…")) for text in texts(tab, "axis-label"))
    choose(tab, "panels", "estimator")
    panels = tab.js("[...document.querySelectorAll('#chart text')].map(t => t.textContent)")
    assert f"estimator: {EVIL}" in panels
    assert tab.complaints() == []


def test_colours_stand_beside_each_other_over_the_name_of_their_word(tab):
    choose(tab, "x", "world")
    choose(tab, "colour", "estimator")
    choose(tab, "panels", "none")
    places = drawn(tab, "datum.x", "item.x")
    first = [x for word, x in places if word == "v"]
    assert len(set(first)) == 3
    np.testing.assert_allclose(np.mean(first), tab.js("chart.scale('x')('v')"), atol=1e-9)
    assert [text for text in texts(tab, "axis-label") if text.isalpha()] == ["v", "w"]
    choose(tab, "panels", "estimator")
    low, high = tab.js("chart.scale('y').domain()")
    values = np.array(tab.js("data.metrics[byId('y').value].values.filter((v) => v)"))
    assert low <= values.min() < values.max() <= high
    assert high - low < 2.0 * np.ptp(values)


def test_seeds_are_not_joined(tab):
    paths = "[...document.querySelectorAll('#chart .mark-line path')]"
    lines = f"{paths}.map(p => Number(p.getAttribute('stroke-opacity') ?? 1))"
    assert set(tab.js(lines)) == {1}
    choose(tab, "x", "seed")
    assert set(tab.js(lines)) == {0}


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


def test_a_click_on_a_run_gives_its_command_or_its_picture(tab):
    picked = "byId('picked')"
    dots = "[...document.querySelectorAll('#chart .mark-symbol path')]"
    dot = f"{dots}.find(p => p.__data__.datum.row === 5)"
    at = tab.js(f"({dot}.scrollIntoView(), {dot}.getBoundingClientRect().toJSON())")
    for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
        tab.call("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1,
                 x=at["x"] + at["width"] / 2, y=at["y"] + at["height"] / 2)  # fmt: skip
    key = rows()["run_key"][5]
    assert f"/{key[:10]} -o run.html" in tab.js(f"{picked}.textContent")
    before = tab.js(f"{picked}.textContent")
    tab.js("pick({ row: 1, runs: 3 })")  # a mean of several runs
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


def test_a_mean_and_its_interval_may_stand_below_each_other(path):
    """Else seven columns are wider than a screen of 1400 px."""
    text = path.read_text()
    cells = re.findall(r'<td class="number">[^<]+ <span class="whole">\[[^<]+\]</span></td>', text)
    assert cells
    assert ".rows td.number { white-space: nowrap" not in text


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
    at = tab.js(f"[...{head}].findIndex(b => b.textContent.startsWith('RMSE'))")
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
    assert tab.becomes("document.querySelector('#chart svg').getBoundingClientRect().width <= 390")
    assert tab.becomes("document.documentElement.scrollWidth <= 390")
    ink = tab.js("getComputedStyle(document.body).color")
    label = "document.querySelector('#chart .role-axis-label text')"
    assert tab.becomes(f"getComputedStyle({label}).fill == '{ink}'")
    assert tab.complaints() == []


@pytest.fixture
def many_settings(tmp_path, chromium):
    """A page of a sweep over three settings and a seed."""
    table = rows()
    n = len(table)
    table["robot.kr"] = np.resize([1e-5, 1e-4], n)
    table["sensors.laser.n_beams"] = np.resize([61, 61, 121], n)
    write_sweep_page(table, "mine", tmp_path, tmp_path / "page.html")
    chromium.events.clear()
    chromium.shape(1400, 900)
    chromium.open((tmp_path / "page.html").as_uri())
    chromium.js("drawn.then(() => drawnParallel)")
    return chromium


def test_all_settings_are_drawn_at_once(many_settings):
    assert not many_settings.js("byId('together').hidden")
    assert many_settings.js("document.querySelector('#parallel canvas') !== null")
    assert "A line for each run, from" in many_settings.js("byId('lines').textContent")
    assert many_settings.complaints() == []


def test_a_phone_has_no_room_for_all_settings(many_settings):
    many_settings.shape(390, 844)
    many_settings.js("draw()")
    assert many_settings.js("byId('together').hidden")


def test_runs_that_are_picked_stand_side_by_side(many_settings):
    many_settings.js("[3, 5, 5, 7].forEach((row) => pick({ row }))")
    found = many_settings.js(
        "[...document.querySelectorAll('.compared tr')]"
        ".map((r) => [...r.cells].map((c) => c.textContent))"
    )
    assert [len(line) for line in found] == [4] * len(found)
    names = [line[0] for line in found]
    assert names[:2] == ["run", "ended"]
    assert Y in names
    many_settings.js("document.querySelector('#picked > button').click()")
    assert many_settings.js("byId('picked').textContent") == ""
    many_settings.js("[1, 2, 3, 4, 5].forEach((row) => pick({ row }))")
    assert many_settings.js("document.querySelector('.compared tr').cells.length") == 5
    assert many_settings.complaints() == []
