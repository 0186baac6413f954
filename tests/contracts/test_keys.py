"""Configuration keys are read in experiments/runs alone; others ask an Experiment."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
READ = re.compile(r"\.config(?:\[|\.get\()")
OF_RECORDING = re.compile(r"recording\.config\b")  # which holds where it came from


def test_no_other_code_reads_keys_of_a_configuration():
    found = []
    for folder in ("estima", "estimators", "experiments", "tools"):
        for path in sorted((ROOT / folder).rglob("*.py")):
            if path.parent == ROOT / "experiments" / "runs":
                continue
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
                if READ.search(OF_RECORDING.sub("", line)):
                    found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert found == []
