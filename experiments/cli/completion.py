"""Words that the shell completes: options, overrides, estimators, sweeps, metrics.

Nothing heavy is imported here, since a shell waits for it.
"""

import re
from collections.abc import Callable, Iterable
from pathlib import Path

from experiments.runs import columns, paths

GROUPS = ("world", "robot", "sensors", "route", "estimator", "study")
_KEY = re.compile(r"^( *)(\w+):", re.MULTILINE)
_CHOICES = {
    "simulation.physics": ("bullet", "kinematic"),
    "simulation.rays": ("bullet", "exact"),
    "prior.start": ("tracking", "global"),
    "prior.map": ("none", "world"),
    "picture": ("true", "false"),
}


def overrides(incomplete: str) -> list[str]:
    """Hydra overrides: groups and their options, keys, and values of some keys."""
    word = incomplete.lstrip("+~")
    prefix = incomplete.removesuffix(word)
    key, equals, _ = word.partition("=")
    if equals:
        values: Iterable[str] = options(key) if key in GROUPS else _CHOICES.get(key, ())
        words = [f"{key}={value}" for value in values]
    else:
        group = word.partition(".")[0]
        files = (paths.CONF / group).glob("*.yaml") if "." in word and group in GROUPS else ()
        words = [f"{name}=" for name in (*GROUPS, *_keys(paths.CONF / "config.yaml"))]
        words += [f"{group}.{name}=" for path in files for name in _keys(path)]
    return sorted({prefix + text for text in words if text.startswith(word)})


def options(group: str, config_dir: Path | None = None) -> list[str]:
    """Options of a configuration group, including those of a further folder."""
    own = paths.option_names(group, config_dir) if config_dir else []
    return sorted({*paths.option_names(group), *own})


def _offering(names: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Completion by names of which a word is the beginning."""
    return lambda incomplete: [name for name in names() if name.startswith(incomplete)]


def _in_results() -> list[str]:
    """Names of folders of rows in results/runs."""
    return sorted(path.name for path in (paths.results() / "runs").glob("*") if path.is_dir())


estimators = _offering(lambda: options("estimator"))
studies = _offering(lambda: options("study"))
groups = _offering(lambda: (*GROUPS, "metrics"))
suites = _offering(lambda: (*options("suite"), *(str(path) for path in Path().glob("*.yaml"))))
sweeps = _offering(_in_results)
metrics = _offering(lambda: columns.COLUMNS)


def settings(incomplete: str) -> list[str]:
    """Columns that state a setting: choices and keys."""
    names = {f"choice.{group}" for group in GROUPS if group != "study"}
    names |= {text.removesuffix("=") for text in overrides(incomplete)} - set(GROUPS)
    return sorted(name for name in names if name.startswith(incomplete))


def _keys(path: Path) -> list[str]:
    """Dotted keys of a YAML file of mappings that are indented by two."""
    places: list[str] = []
    keys = []
    for indent, name in _KEY.findall(path.read_text(encoding="utf-8")):
        places[len(indent) // 2 :] = [name]
        if places[0] not in ("defaults", "hydra", "sweeps", "tune"):
            keys.append(".".join(places))
    return keys
