"""The report as a file and in a real browser."""

import json
import re
import shutil
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from experiments.evaluation.statistics import Interval
from experiments.judging.claim import Claim, Subject, Verdict, beside
from experiments.judging.claims_file import (
    note_provenance,
    read_claims,
    read_verdicts,
    write_claims,
    write_verdicts,
)
from experiments.judging.folders import findings
from experiments.judging.results import Profile
from experiments.judging.sentences import Conclusion
from experiments.report import contents, leaderboard
from experiments.report.page import code
from experiments.runs.paths import SOURCE
from experiments.runs.row import write_frame
from experiments.viewing.style import save_figure, subplots
from sim.errors import InputError
from tests.fixtures import browser

VOID = {"meta", "link", "img", "br"}


def claim(key, verdict, statistic="a < b & c", value=0.5, reason=""):
    found = Interval(value, 0.4, 0.6)
    return Claim(Subject(key, ""), statistic, found, "at least 0.45", Verdict(verdict), reason)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """What studies leave: judged claims, a figure with a caption and one without, two tables."""
    folder = tmp_path_factory.mktemp("results")
    quick = [
        claim("PB4", "reproduced"),
        claim("PB4", "not_reproduced", "the unfavourable", 0.25, "<b>at large k</b>"),
        beside(claim("PB4", "undecided", "of our own")),
    ]
    full = [
        claim("PB1", "reproduced"),
        claim("ZZ9", "undecided", "of a claim that nobody described", reason="<b>at large</b>"),
    ]
    path, command = folder / "claims.csv", "estima reproduce"
    write_claims(full, path, paper="puzzlebot2024", profile=Profile.FULL, command=command)
    one = read_claims(path)
    write_claims(quick, path, paper="puzzlebot2024", profile=Profile.QUICK, command=command)
    write_frame(pd.concat([one, read_claims(path)]), path)
    write_verdicts(
        [Conclusion("PB4", Verdict.NOT_REPRODUCED, "The ellipse holds <b>61 %</b> at 1e-3 m.")],
        folder / "verdicts.csv",
        paper="puzzlebot2024",
        says={"PB4": "The real robot stays in it."},
        profile=Profile.FULL,
    )
    (folder / "figures").mkdir()
    for name in ("puzzlebot2024_coverage", "puzzlebot2024_surprise", "mcl_office_found"):
        page = Figure(figsize=(6.0, 3.0))
        page.subplots().plot([0, 1])
        page.savefig(folder / "figures" / f"{name}.png", dpi=100)
    small = pd.DataFrame({"case": ["a<b", "c"], "k_m": [1e-5, np.nan]})
    write_frame(small, folder / "tables" / "puzzlebot2024_small.csv")
    large = pd.DataFrame({"seed": np.arange(1000, 1100), "error_m": np.linspace(0, 1, 100)})
    write_frame(large, folder / "tables" / "puzzlebot2024_large.csv")
    write_frame(small, folder / "tables" / "mcl_office_starts.csv")
    write_frame(small, folder / "tables" / "nobody_knows.csv")
    note_provenance(folder, "puzzlebot2024", "quick", 12.3)
    made = json.loads((folder / "provenance.json").read_text())
    made["puzzlebot2024"] |= {"profile": "<i>quick", "cpu": "<i>fast"}
    (folder / "provenance.json").write_text(json.dumps(made))
    return folder


@pytest.fixture(scope="module")
def text(results):
    return contents.write_report(results).read_text()


class Outline(HTMLParser):
    """Elements in order, with their attributes and text; fails where tags do not nest."""

    def __init__(self, text):
        super().__init__()
        self.elements, self._open = [], []
        self.feed(text)
        assert not self._open

    def handle_starttag(self, tag, attributes):
        element = {"tag": tag, "text": "", **dict(attributes)}
        self.elements.append(element)
        if tag not in VOID:
            self._open.append(element)

    def handle_endtag(self, tag):
        assert self._open.pop()["tag"] == tag

    def handle_data(self, data):
        for element in self._open:
            element["text"] += data

    def all(self, *tags):
        return [element for element in self.elements if element["tag"] in tags]


def test_structure_that_readers_and_their_aids_rely_on(text):
    page = Outline(text)
    levels = [int(e["tag"][1]) for e in page.all("h1", "h2", "h3", "h4")]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))
    ids = [e["id"] for e in page.elements if "id" in e]
    assert len(ids) == len(set(ids))
    for link in page.all("a"):
        elsewhere = link["href"].startswith(("tables/", "https://doi.org/"))
        assert elsewhere or link["href"][1:] in ids
    assert len(page.all("table")) == len(page.all("caption"))
    assert all(cell["scope"] for cell in page.all("th"))
    assert page.all("html")[0]["lang"] == "en"
    assert [m for m in page.all("meta") if m.get("name") == "viewport"]
    for image in page.all("img"):
        assert len(image["alt"]) > 10
        assert image["src"].startswith("data:image/webp;base64,")
        assert (image["width"], image["height"]) == ("600", "300")
    assert "://" not in re.sub(r"base64,[^\"]*|<a href=\"https://doi.org/", "", text)  # no fetching
    assert "prefers-color-scheme: dark" in text


def test_each_claim_is_one_row_with_its_statistics_below(text):
    page = Outline(text)
    rows = {e["id"]: e["text"] for e in page.all("tbody") if "id" in e}
    assert "0.500 [0.400, 0.600]" in rows["claim-PB1"]
    head, folded = rows["claim-PB4"].split("PB4: statistics (3)")
    assert "The ellipse holds <b>61 %</b> at 1e-3 m." in head
    verdict, figures = head.strip().split("Figures: ")
    assert verdict.endswith("not reproduced (quick)")
    figures, asked = figures.split("It holds if all these do.")
    assert figures.strip() == "Coverage of the 95 % ellipse"
    assert ("the unfavourable" in asked, "of our own" in asked) == (True, False)
    assert folded.index("the unfavourable") < folded.index("of our own")  # headlines first
    assert "0.250 [0.400, 0.600]" in folded
    assert "follows from its headline statistics" in page.all("caption")[0]["text"]
    assert "3 claims, by 5 statistics" in page.all("header")[0]["text"]
    *_, tile = (e["text"] for e in page.all("li") if "Covariance of dead" in e["text"])
    assert tile.endswith("1 reproduced, 1 undecided; our own additions: 1 not reproduced")
    assert "of 95 % unless the statistic says otherwise" in page.all("header")[0]["text"]
    assert "not judged yet" in rows["claim-GI8"]
    assert "nobody described" in rows["claim-ZZ9"]
    assert "<b>at large" not in text
    order = ["claim-PB1", "claim-ZZ9", "claim-DC1"]  # each in its paper's section
    places = [text.index(f'id="{name}"') for name in ("puzzlebot2024", *order)]
    assert places == sorted(places)
    assert text.index('id="leaderboard"') < places[0]


@pytest.mark.slow
def test_the_page_of_all_results_is_small_and_loads_nothing(tmp_path):
    for kind in ("tables", "figures"):
        (tmp_path / kind).symlink_to(SOURCE / "results" / kind)
    for name in ("claims.csv", "verdicts.csv", "provenance.json"):
        (tmp_path / name).symlink_to(SOURCE / "results" / name)
    page = contents.write_report(tmp_path).read_text()
    assert len(page.encode()) < 5_000_000
    assert not re.search(r'(src|href)="https?://[^"]*\.(js|css|png|webp)"', page)


def test_sentences_do_not_run_into_what_follows(text):
    assert not re.findall(r"[a-z0-9)]\.<(?:i|a)[ >].{20}", text)


def test_a_figure_without_a_caption_still_shows(text):
    page = Outline(text)
    figures = {e["id"]: e["text"] for e in page.all("figure")}
    assert figures["puzzlebot2024_surprise"].strip() == "surprise"
    assert "Here:\nPB4 not reproduced (quick)." in figures["puzzlebot2024_coverage"]
    assert "Not made yet: puzzlebot2024_ideal_and_real" in page.all("main")[0]["text"]


def test_a_picture_of_a_table_is_shown_as_the_table(results, tmp_path):
    copied = shutil.copytree(results, tmp_path / "results")
    picture = copied / "figures" / "puzzlebot2024_surprise.png"
    about = contents.findings("puzzlebot2024")["figures"]
    name = next(name for name, figure in about.items() if figure.get("table"))
    shutil.copy(picture, picture.with_name(f"{name}.png"))
    for there in (False, True):
        if there:
            small = copied / "tables" / "puzzlebot2024_small.csv"
            shutil.copy(small, small.with_name(f"{about[name]['table']}.csv"))
        text = contents.write_report(copied).read_text()
        figure = text[text.index(f'<figure id="{name}"') :].partition("</figure>")[0]
        assert ("<table" in figure) == there
        assert ("<img" in figure) != there


def test_spreads_and_bounds_share_the_cell_of_their_value():
    columns = ("x_mean_m", "x_sd_m", "k_m", "k_low_m", "k_high_m", "y_mean_m")
    frame = pd.DataFrame([[1.0, 0.25, 1e-5, 0.5e-5, 2e-5, 3.0]], columns=columns)
    found = contents.with_spread(frame).to_dict("list")
    expected = {"x_m": ["1.00 ± 0.25"], "k_m": ["1e-05 [5e-06, 2e-05]"], "y_mean_m": [3.0]}
    assert found == expected


def test_small_tables_whole_and_large_ones_begun(text):
    bodies = {e.get("aria-label"): e["text"] for e in Outline(text).all("div")}
    assert "a<b1e-05c" in bodies["puzzlebot2024_small"]
    assert "100 rows, 2 columns; the first 5" in bodies["puzzlebot2024_large"]
    assert "seeds 1000 to 1099" in bodies["puzzlebot2024_large"]
    assert "1005" not in bodies["puzzlebot2024_large"]


def test_origin_and_command_are_shown(text):
    sections = {e.get("aria-labelledby"): e["text"] for e in Outline(text).all("section")}
    assert "<i>quick profile, 12 s" in sections["puzzlebot2024"]
    assert "<i>fast" in sections["machine"]
    assert "estima reproduce --paper gil2008 --full" in sections["gil2008"]
    assert "world: office" in sections["decristoforis2020"]  # its study's configuration
    assert np.__version__ in sections["machine"]


def test_constants_are_printed_as_they_are_written(results, tmp_path, monkeypatch):
    (tmp_path / "puzzlebot2024").mkdir()
    source = "JUDGED_SEED = 1000  # seeds below 100 are for tuning"
    (tmp_path / "puzzlebot2024" / "settings.py").write_text(source)
    monkeypatch.setattr(contents, "code_folder", lambda name: tmp_path / name)
    copied = shutil.copytree(results, tmp_path / "results")
    page = Outline(contents.write_report(copied).read_text())
    sections = {e.get("aria-labelledby"): e["text"] for e in page.all("section")}
    assert f"puzzlebot2024/settings.py{source}" in sections["puzzlebot2024"]


def test_what_belongs_to_no_paper_comes_last_with_its_command(text):
    page = Outline(text)
    own = {e.get("aria-labelledby"): e["text"] for e in page.all("section")}["mcl_office"]
    assert "estima reproduce --paper mcl_office" in own
    assert "mcl_office_starts (2 rows, 2 columns)" in own
    assert "Of no study here: nobody_knows.csv." in page.all("main")[0]["text"]
    assert text.index('<h2 id="gil2008"') < text.index('<h2 id="mcl_office"')
    assert text.index('id="maximo2024"') < text.index('id="mcl_office_found"')


def test_claims_that_a_cut_table_lacks_are_named(results, capsys):
    header = Outline(contents.write_report(results).read_text()).all("header")[0]["text"]
    assert "No verdict on PB2, PB3." in header  # of papers without any nothing is expected
    (line,) = capsys.readouterr().err.splitlines()
    assert "claims.csv: no verdict on PB2, PB3" in line


@pytest.mark.parametrize(
    ("made", "wrong"),
    [
        ([], "must hold an object by paper"),
        ({"gil2008": 3}, "gil2008 does not say its profile, seconds, code_version"),
        ({"gil2008": {"profile": "full", "seconds": 1}}, "gil2008 does not say its code_version"),
    ],
)
def test_an_origin_that_is_none_is_named(tmp_path, made, wrong):
    (tmp_path / "provenance.json").write_text(json.dumps(made))
    with pytest.raises(InputError, match=f"provenance.json: .*{wrong}") as refused:
        contents.write_report(tmp_path)
    assert "\n" not in str(refused.value)


def test_an_empty_folder_gives_a_page_that_says_so(tmp_path):
    text = contents.write_report(tmp_path).read_text()
    assert "not judged yet" in text
    assert not Outline(text).all("img")


def test_a_damaged_figure_is_named(tmp_path, results):
    path = tmp_path / "figures" / "gil2008_8.png"
    path.parent.mkdir()
    whole = (results / "figures" / "mcl_office_found.png").read_bytes()
    for data, why in (
        (b"nothing", "not a PNG"),
        (whole[:2000], "the picture is cut off"),
        (whole.replace(whole[2000:2050], b"\xff" * 50), r"cannot read \((?!None)"),
    ):
        path.write_bytes(data)
        with pytest.raises(InputError, match=rf"gil2008_8\.png: {why}"):
            contents.write_report(tmp_path)
    path.unlink()
    path.mkdir()
    said = r"gil2008_8\.png: not a file; name a file in it, or remove it"
    with pytest.raises(InputError, match=said):
        contents.write_report(tmp_path)


@pytest.mark.parametrize("paper", [*contents.PAPERS, *contents.OWN, "real_logs"])
def test_findings_are_complete(paper):
    about = contents.findings(paper)
    kept = {"title", "source", "doi", "about", "claims", "own", "sentences", "figures"}
    assert set(about) - {"criteria", "anchor"} == kept
    assert bool(about["source"]) == (paper in contents.PAPERS)
    assert set(about["own"]) <= set(about["claims"])
    for name, figure in about["figures"].items():
        assert name.startswith(f"{paper}_")
        assert set(figure) - {"table"} == {"title", "alt", "paper", "claims"}
        assert set(figure["claims"]) <= set(about["claims"])
        assert len(figure["alt"]) > 40


@pytest.fixture(scope="module")
def tab(results, text):
    if browser.find() is None:
        pytest.skip("no Chromium on this machine")
    with browser.page() as tab:
        tab.shape(1280, 900)
        tab.open((results / "report.html").as_uri())
        yield tab


def test_a_browser_loads_it_whole_and_without_complaint(tab):
    assert tab.complaints() == []
    images = tab.js("[...document.images].map(i => [i.complete, i.naturalWidth, i.alt])")
    assert len(images) == 3
    assert all(complete and width == 600 and alt for complete, width, alt in images)


def test_the_keyboard_skips_to_the_claims_and_opens_details(tab):
    tab.press("Tab")
    assert tab.js("document.activeElement.textContent") == "Skip to the results"
    assert tab.js("document.activeElement.getBoundingClientRect().left") >= 0  # it is shown
    tab.press("Enter", text="\r")
    assert tab.becomes("location.hash == '#leaderboard'")
    tab.press("Tab")
    assert tab.js("document.activeElement.textContent") == "How leaderboard was made"
    assert tab.js("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    tab.press("Enter", text="\r")
    assert tab.becomes("document.activeElement.parentElement.open")


def test_a_link_opens_the_fold_that_hides_its_figure(tab):
    surprise = "document.getElementById('puzzlebot2024_surprise')"
    assert not tab.js(f"{surprise}.closest('details').open")
    tab.js("location.hash = '#puzzlebot2024_surprise'")
    assert tab.becomes(f"{surprise}.closest('details').open")


def test_figures_open_enlarged_by_key_and_close_again(tab):
    tab.js("document.querySelector('figure .enlarge').focus()")
    tab.press("Enter", text="\r")
    assert tab.becomes("document.querySelector('dialog').open")
    assert tab.js("document.querySelector('dialog img').getBoundingClientRect().width") >= 600
    tab.js("document.querySelector('dialog').click()")
    assert tab.becomes("!document.querySelector('dialog').open")


@pytest.mark.skipif(browser.find() is None, reason="no Chromium on this machine")
def test_panels_stand_below_each_other_on_a_phone(tmp_path):
    page, axes = subplots(9.0, 3.0, 1, 2)
    for ax in axes:
        ax.plot([0, 1])
        ax.set(xlabel="x, m", ylabel="y, m")
    (tmp_path / "figures").mkdir()
    save_figure(page, tmp_path / "figures" / "leaderboard_errors.png")
    places = "e => e.getBoundingClientRect().toJSON()"
    with browser.page() as tab:
        tab.open(contents.write_report(tmp_path).as_uri())
        for width in (1400, 390):
            tab.shape(width, 800)
            shown = tab.js(
                f"[...document.querySelectorAll('main figure .panels > span')].map({places})"
            )
            assert len(shown) == 2
            assert all((box["width"] > 0) == (width == 390) for box in shown)
        first, second = shown
        assert first["bottom"] <= second["top"]
        assert first["right"] <= 390
        assert tab.js("document.documentElement.scrollWidth") == 390
        best = tab.js(f"[document.querySelector('header figure img')].map({places})[0]")
        assert best["bottom"] <= 844  # on the first screen
        assert tab.complaints() == []


def test_tables_can_be_sorted(tab):
    table = "document.querySelector('table.sortable')"
    tab.js(f"{table}.closest('details').open = true")
    tab.js(f"{table}.querySelector('th:last-child button').click()")
    assert tab.js(f"{table}.querySelector('th:last-child').ariaSort") == "ascending"


def test_the_first_screen_has_the_leaderboard_by_world(tmp_path):
    path = tmp_path / "leaderboard_means.csv"
    assert leaderboard.by_world(path) == {}
    rows = {"choice.world": ["v", "v", "v", "w", "w"], "choice.estimator": [*"abcab"]}
    write_frame(pd.DataFrame({**rows, "answer_ate_rmse_m": [0.2, 0.1234, 0.01, 0.3, 0.4]}), path)
    assert leaderboard.by_world(path) == {
        "worlds": ["v", "w"],
        "rows": [  # c did not run in all worlds
            ("b", [("0.12", True), ("0.40", False)], ""),
            ("a", [("0.20", False), ("0.30", True)], ""),
        ],
        "n_methods": 2,
        "bounded": False,
    }
    over = {
        "position_over_bound": [2.0, 1.1, None, 8.0, 1.0],
        "below_bound": ["", "", "", "", "heading"],
    }
    frame = pd.DataFrame({**rows, "answer_ate_rmse_m": [0.2, 0.1234, 0.01, 0.3, 0.4], **over})
    write_frame(frame, path)
    found = leaderboard.by_world(path)
    assert found["bounded"]
    assert [over for *_, over in found["rows"]] == ["below the bound", "4.0"]
    write_frame(pd.DataFrame(rows), path)
    assert leaderboard.by_world(path) == {}


def test_the_report_names_the_source_of_each_paper(text):
    shown = " ".join(element["text"] for element in Outline(text).elements)
    assert all(findings(paper)["source"] in shown for paper in contents.PAPERS)
    assert 'href="https://doi.org/10.33414/rtyc.37.134-145.2020"' in text


def test_what_a_paper_does_not_claim_is_not_counted_as_its_claim(tmp_path):
    rows = [{"role": "headline", "verdict": v, "profile": "full", "paper": "maximo2024"} for v in
            ("not_reproduced", "reproduced")]  # fmt: skip
    table = pd.DataFrame(rows).assign(id=["MX1", "MX6"])
    about = {"maximo2024": contents.findings("maximo2024")}
    claims = contents.judged_claims(
        table, about, read_verdicts(tmp_path / "none.csv").set_index("id")
    )
    assert [key for key, claim in claims.items() if claim["own"]] == ["MX6", "MX7", "MX8"]


def test_the_marks_of_a_table_of_means_are_explained(tmp_path):
    path = tmp_path / "t.csv"
    means = {"choice.estimator": ["a", "b"], "with_remarks": [0, 1], "ate_rmse_m": [0.1, 0.2]}
    means |= {"ate_rmse_m_low": [0.1, 0.15], "ate_rmse_m_high": [0.1, 0.25]}
    for differs in (True, False):
        frame = pd.DataFrame({**means, "ate_rmse_m_differs": [False, differs]})
        write_frame(frame.assign(ate_rmse_over_a=[1.0, 2.0]), path)
        found = contents.table(path)
        assert "with remarks" in found["head"]
        assert ("*: differs from the reference" in found["note"]) == differs


def test_backticks_become_code_and_nothing_else_does():
    assert code("of `a_b` <i>") == "of <code>a_b</code> &lt;i&gt;"


def test_what_scrolls_sideways_can_be_reached_by_keyboard(tab):
    assert tab.js("document.querySelectorAll('.scroll').length") > 3
    assert tab.js("[...document.querySelectorAll('.scroll')].every(e => e.tabIndex == 0)")


@pytest.mark.parametrize("dark", [False, True])
def test_phones_and_dark_mode(tab, dark):
    tab.shape(360, 780, dark=dark)
    assert tab.js("document.documentElement.scrollWidth") <= 360
    tab.js("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    assert tab.js("document.documentElement.scrollWidth") <= 360
    assert tab.js("document.images[0].getBoundingClientRect().width") <= 360
    assert tab.js("parseFloat(getComputedStyle(document.body).fontSize)") >= 16
    assert tab.js("getComputedStyle(document.images[0]).backgroundColor") == "rgb(255, 255, 255)"
    page = tab.js("getComputedStyle(document.body).backgroundColor")
    for name in ("body", ".quiet", ".reproduced", ".not-reproduced", ".undecided", "a"):
        colour = tab.js(f"getComputedStyle(document.querySelector('{name}')).color")
        assert contrast(colour, page) >= 4.5, (name, colour, page)
    assert (luminance(page) < 0.1) == dark


def luminance(colour):
    parts = np.array([float(v) for v in re.findall(r"[\d.]+", colour)[:3]]) / 255.0
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def contrast(first, second):
    """Contrast ratio of WCAG 2."""
    low, high = sorted([luminance(first), luminance(second)])
    return (high + 0.05) / (low + 0.05)
