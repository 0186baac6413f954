"""The documentation: built without a warning, with the API in it, and nothing from elsewhere."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import estima
from estimators.on_a_map.mcl import Mcl
from experiments.cli.main import _COMMANDS
from experiments.judging.folders import PAPERS, code_folder, findings
from experiments.papers.puzzlebot2024 import study as puzzlebot2024
from experiments.runs.paths import option_names
from sim.options import described
from sim.yaml_file import read_yaml

# studies of questions of ours, beyond the parts of the papers
NOT_OF_A_PART = {
    "decristoforis2020/beliefs",
    "decristoforis2020/office",
    "decristoforis2020/ordering",
    "gil2008/bound",
    "puzzlebot2024/engine",
}
ROOT = Path(__file__).resolve().parents[2]


def test_the_papers_page_names_what_there_is():
    """Every study, option and file on the page exists, and every study of a paper is on it."""
    page = (ROOT / "docs" / "papers.md").read_text().partition("\n## ")[2]
    studies = set(re.findall(r"study=([\w/]+)", page))
    there = set(option_names("study"))
    assert studies <= there
    papers = ("puzzlebot2024/", "decristoforis2020/", "maximo2024/", "gil2008")
    for group, option in re.findall(r" (world|robot|sensors|route|estimator)=(\w+)", page):
        assert (ROOT / "conf" / group / f"{option}.yaml").exists(), option
    for name in re.findall(r"`((?:sim|estimators|experiments|conf|docs)/[\w./]+\.\w+)`", page):
        assert (ROOT / name).exists(), name
    of_puzzlebot = page.partition("\n## ")[0]
    for name in re.findall(r"`study\.(\w+)`", of_puzzlebot):
        assert hasattr(puzzlebot2024, name), name
    assert {name for name in there if name.startswith(papers)} - studies <= NOT_OF_A_PART


def test_the_papers_and_the_version_are_cited_alike_everywhere():
    cited = read_yaml(ROOT / "CITATION.cff")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert (cited["version"], cited["license"]) == (project["version"], project["license"])
    assert [one["name"] for one in cited["authors"]] == [one["name"] for one in project["authors"]]
    readme = (ROOT / "README.md").read_text()
    references = {one["abstract"]: one for one in cited["references"]}
    assert set(references) == set(PAPERS)
    for name, one in references.items():
        said = findings(name)
        for place in (readme, said["source"]):
            assert one["title"] in place
            assert str(one["year"]) in place
            assert all(author["family-names"] in place for author in one["authors"])
        assert str(one.get("doi", "")) == str(said["doi"])
        assert str(said["doi"]) in readme


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The built site, and what the build said."""
    pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return folder, done.stdout + done.stderr


@pytest.mark.slow
def test_it_builds_without_a_warning(site):
    assert site[1] == ""


@pytest.mark.slow
def test_it_has_a_page_for_every_document(site):
    folder, _ = site
    for page in (ROOT / "docs").glob("*.md"):
        place = folder / ("" if page.stem == "index" else page.stem)
        assert (place / "index.html").exists(), page.name


@pytest.mark.slow
def test_each_command_and_estimator_has_its_place(site):
    commands = (site[0] / "reference" / "commands" / "index.html").read_text()
    for name in (name for commands in _COMMANDS.values() for name in commands):
        assert f'id="estima-{name}"' in commands, name
    for name in option_names("estimator"):
        if not name.endswith("_tuned"):
            page = site[0] / "reference" / "estimators" / name.replace("/", "_") / "index.html"
            text = page.read_text()
            assert "<strong>Not for</strong>" in text, name
            assert f"estima options {name}" in text
    mcl = (site[0] / "reference" / "estimators" / "mcl" / "index.html").read_text()
    for option in described(Mcl):
        assert f"estimator.{option.name}<" in mcl
    peer = (site[0] / "reference" / "estimators" / "peers_kiss_icp" / "index.html").read_text()
    assert "kiss_icp_tuned" in peer.partition("On the boards")[2]


@pytest.mark.slow
def test_each_key_is_in_the_reference(site):
    page = (site[0] / "reference" / "configuration" / "index.html").read_text()
    for key in ("simulation.rays", "prior.map", "team.size", "robot.kr", "route.distance_m"):
        assert f"<code>{key}</code>" in page, key
    for group in ("world", "robot", "sensors", "route"):
        for name in option_names(group):
            assert f"<code>{group}={name}</code>" in page, name


@pytest.mark.slow
def test_the_gallery_has_every_figure_and_what_makes_it(site):
    page = (site[0] / "gallery" / "index.html").read_text()
    for figure in (ROOT / "results" / "figures").glob("*.png"):
        assert f"{figure.name}" in page, figure.name
    for study in set(re.findall(r"estima reproduce --paper (\w+)", page)):
        assert code_folder(study).is_dir(), study
    for study in set(re.findall(r"-m study=([\w/]+)", page)):
        assert study in option_names("study"), study


@pytest.mark.slow
def test_it_documents_the_api(site):
    page = (site[0] / "api" / "index.html").read_text()
    functions = [name for name in estima.__all__ if name[0].islower()]
    assert len(functions) == 6
    for name in (*functions, "Run"):
        assert f'id="estima.{name}"' in page
    for name in ("Recording", "Frame", "Prior", "Belief", "Estimate", "Experiment"):
        kind = getattr(estima, name)
        assert f'id="{kind.__module__}.{name}"' in page


@pytest.mark.slow
def test_its_examples_are_the_scripts(site):
    names = ("examples/index.md", "guide.md", "programs.md", "regression.md")
    pages = [ROOT / "docs" / name for name in names]
    shown = [name for page in pages for name in re.findall(r'--8<-- "(.*?)"', page.read_text())]
    assert sorted(shown) == sorted(
        str(path.relative_to(ROOT))
        for path in (ROOT / "docs" / "examples").rglob("*")
        if path.suffix in (".py", ".yaml", ".cpp", ".sh", ".yml")
    )
    assert "Dead reckoning whose covariance" in (site[0] / "examples" / "index.html").read_text()


@pytest.mark.slow
def test_it_loads_nothing_from_elsewhere(site):
    for path in site[0].rglob("*.html"):
        text = path.read_text()
        loaded = re.findall(r'<(?:script|img|iframe)[^>]* src="?([^">\s]+)', text)
        loaded += re.findall(r'<link[^>]* rel="?(?:stylesheet|icon|preconnect)[^>]*>', text)
        assert loaded
        assert not [address for address in loaded if "//" in address], path
