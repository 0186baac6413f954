"""Where the code of a paper or of a study of ours lies, and what it says of its findings."""

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

from experiments.runs.paths import SOURCE
from sim.yaml_file import read_yaml

PAPERS = ("puzzlebot2024", "decristoforis2020", "maximo2024", "gil2008")
LOGS = ("real_logs", "twins")  # run only where the logs are
NAMED = ("teams", "exploration")  # judged, run when named
OWN = (
    "mcl_office",
    "fastslam_consistency",
    "peers",
    "self_knowledge",
)  # our own, which judge no claim: run when named
STUDIES = (*PAPERS, *LOGS, *NAMED, *OWN)
SWEEPS = ("leaderboard", "all_estimators")  # only their figures are made by `estima reproduce`
ROOMS = tuple(SOURCE / "experiments" / room for room in ("papers", "studies"))


def code_folder(study: str) -> Path:
    """Folder of a paper's or a study's code, findings and settings; it need not exist."""
    folders = [room / study for room in ROOMS]
    return next((folder for folder in folders if folder.is_dir()), folders[0])


def part(study: str, name: str) -> ModuleType:
    """Return a module of a paper or study: `study`, `claims` or `figures`."""
    return importlib.import_module(f"experiments.{code_folder(study).parent.name}.{study}.{name}")


def findings(study: str) -> dict[str, Any]:
    """A study's findings in our words.

    They are its `title`, the paper's `source` and `doi`, `about`, `claims` and `sentences` by id,
    those claims that are our `own` rather than the paper's, when criteria changed (`criteria`) by
    id, and `figures` by file name.
    """
    found = _read(study, "findings")
    empty = {"title": study, "claims": {}, "own": [], "sentences": {}, "figures": {}}
    empty |= dict.fromkeys(("about", "source", "doi"), "")
    whole = {**empty, **found}
    pages = {
        f"{study}_region_{claim}": _region_page(claim) for claim in design(study).get("regions", {})
    }
    return whole | {"figures": {**whole["figures"], **pages}}


def design(study: str) -> dict[str, Any]:
    """How a study's claims are judged: sequential `designs` and free settings (`regions`) by id.

    Its rows depend on them, and not on the findings' words.
    """
    return _read(study, "design")


def _read(study: str, name: str) -> dict[str, Any]:
    path = code_folder(study) / f"{name}.yaml"
    return read_yaml(path) if path.exists() else {}


def _region_page(claim: str) -> dict[str, Any]:
    """What the report says of the figure of a claim's region."""
    return {
        "title": f"Where {claim} holds",
        "alt": (
            f"Left, where {claim} holds for sure, fails for sure, and neither, over the two "
            "settings that decide it most, with the sampled points and the anchor. Middle, the "
            "ratio that misses first along the first of them, with its 95 % interval; orange below "
            "it, where another ratio fails. Right, the share of the variance that each free "
            "setting explains alone."
        ),
        "paper": "The paper leaves these settings open; this figure adds them.",
        "claims": [claim],
    }
