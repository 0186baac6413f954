"""Where the code of a paper or of a study of ours lies."""

from pathlib import Path

from experiments.runs.paths import SOURCE

ROOMS = tuple(SOURCE / "experiments" / room for room in ("papers", "studies"))


def code_folder(study: str) -> Path:
    """Folder of a paper's or a study's code, findings and settings; it need not exist."""
    folders = [room / study for room in ROOMS]
    return next((folder for folder in folders if folder.is_dir()), folders[0])
