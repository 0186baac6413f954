"""Pages of the documentation that are made from the code, by a hook of mkdocs (mkdocs.yml).

Commands, configuration keys, estimators, metrics, claims and the gallery of figures. The pages
exist only while mkdocs builds the site, so nothing in them is written twice.
"""

from __future__ import annotations

import dataclasses
import inspect
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from experiments.cli.main import app  # noqa: E402
from experiments.judging.claim import Verdict  # noqa: E402
from experiments.judging.folders import ROOMS, findings  # noqa: E402
from experiments.judging.results import reproduce_command  # noqa: E402
from experiments.report.contents import OWN  # noqa: E402
from experiments.report.export import significant  # noqa: E402
from experiments.report.recommend import Judged, judged, seconds_a_frame  # noqa: E402
from experiments.runs import columns, paths  # noqa: E402
from experiments.runs.compose import open_composer  # noqa: E402
from experiments.runs.schema import OPTIONS, RunOptions, TeamSettings  # noqa: E402
from sim.options import described, find  # noqa: E402

TUNED = "_tuned"
GROUPS = {
    "world": "Worlds",
    "robot": "Robots",
    "sensors": "Sensors",
    "route": "Routes",
}


def on_files(files: Any, config: Any) -> Any:
    """Add the pages to the site."""
    for place, text in pages().items():
        files.append(File.generated(config, place, content=text))
    for image in sorted((ROOT / "results" / "figures").glob("*.png")):
        files.append(File.generated(config, f"gallery/{image.name}", abs_src_path=str(image)))
    return files


def pages() -> dict[str, str]:
    """The text of each page, Markdown, by its place in the documentation."""
    names = [name for name in paths.option_names("estimator") if not name.endswith(TUNED)]
    return {
        "reference/commands.md": "\n".join(_commands()),
        "reference/configuration.md": "\n".join(_configuration()),
        "reference/metrics.md": "\n".join(_metrics()),
        "reference/estimators/index.md": "\n".join(_estimators(names)),
        **{f"reference/estimators/{_page(name)}": text for name, text in _each(names)},
        "reference/claims.md": "\n".join(_claims()),
        "gallery.md": "\n".join(_gallery()),
    }


# Commands


def _commands() -> Iterator[str]:
    import typer

    yield "# Commands\n\nMade from the program's own help: `estima COMMAND --help` says the same.\n"
    commands = dict[str, Any](vars(typer.main.get_command(app))["commands"])
    for name, group in list(commands.items()):
        inside = vars(group).get("commands", {})
        if inside:
            commands |= {f"{name} {each}": command for each, command in inside.items()}
            del commands[name]
    for name, command in commands.items():
        about, _, examples = inspect.cleandoc(command.help or "").partition("\nExamples\n")
        about, _, example = about.partition("\nExample: ")
        lines = [line.strip() for line in examples.partition("\n")[2].splitlines() if line.strip()]
        lines += [example.strip()] if example else []
        yield f"## estima {name}\n\n{about.strip()}\n"
        rows = [_parameter(each) for each in command.params if each.name != "help"]
        yield from _table(("argument or flag", "default", "meaning"), rows)
        if lines:
            yield "```text\n" + "\n".join(lines) + "\n```\n"


def _parameter(each: Any) -> tuple[str, str, str]:
    flags = [*each.opts, *getattr(each, "secondary_opts", [])]
    name = ", ".join(f"`{f}`" for f in flags) if each.param_type_name == "option" else ""
    default = "" if each.default in (None, False) or callable(each.default) else each.default
    needed = "required" if each.required else default
    return name or f"`{each.human_readable_name}`", _code(needed), getattr(each, "help", "") or ""


# Configuration keys


def _configuration() -> Iterator[str]:
    yield (
        "# Configuration keys\n\nMade from the classes of options: each key with its default, what "
        "it accepts and what it means. Set one with `KEY=VALUE` on the command line; `estima run "
        "--cfg job` prints all that a run would use, `estima options NAME` what is below. The keys "
        "of estimators are on [their pages](estimators/index.md).\n"
    )
    stated = yaml.safe_load((paths.CONF / "config.yaml").read_text())
    for place, kind in {**OPTIONS, "team": TeamSettings, "": RunOptions}.items():
        values = stated.get(place, {}) if place else stated
        yield f"## {place or 'Single keys'}\n\n{_first(kind)}\n"
        yield from _keys(kind, values, f"{place}." if place else "")
    yield (
        "Beside these, `seed` and `world_seed` begin the random streams, `recording` and "
        "`calibration` name files in place of a simulation, and `name` is the folder of the rows.\n"
    )
    for group, title in GROUPS.items():
        yield f"## {title}\n"
        yield from _options_of(group)


def _options_of(group: str) -> Iterator[str]:
    """The options of a group, then the keys of each class that they name."""
    chosen: dict[str, Any] = {}
    rows = []
    for name in paths.option_names(group):
        file = paths.CONF / group / f"{name}.yaml"
        rows.append((f"`{group}={name}`", paths.about(file)["what"]))
        held = yaml.safe_load(file.read_text()) or {}
        for each in held.values() if group == "sensors" else [held]:
            if isinstance(each, Mapping) and "_target_" in each:
                chosen[each["_target_"]] = find(each["_target_"], group)
    yield from _table(("option", "what it is"), rows)
    for target, kind in sorted(chosen.items()):
        word = "NAME." if group == "sensors" else ""
        yield f"### {target}\n\n{_first(kind)}\n"
        yield from _keys(kind, {}, f"{group}.{word}")


def _keys(kind: Any, stated: Mapping[str, Any], prefix: str) -> Iterator[str]:
    rows = []
    for option in described(kind):
        if option.name in ("rng", "config", "recording"):  # which the program passes
            continue
        value = stated.get(option.name, option.default)
        rows.append((f"`{prefix}{option.name}`", _value(value), option.accepts, option.meaning))
    yield from _table(("key", "default", "accepts", "meaning"), rows)


# Metrics


def _metrics() -> Iterator[str]:
    yield (
        "# Metrics\n\nColumns of a row, in the words that tables and plots use. Those of the "
        "online path have no prefix, those of the path from `finish` have `revised_`. `answer_` is "
        "the path by which a method is ranked: revised if it has one, else online.\n"
    )
    rows = [
        (f"`{name}`", column.label, column.unit, column.better or "")
        for name, column in columns.COLUMNS.items()
        if not name.startswith((columns.REVISED, columns.ANSWER))
    ]
    yield from _table(("column", "name", "unit", "better"), rows)


# Estimators


def _estimators(names: Iterable[str]) -> Iterator[str]:
    yield (
        "# Estimators\n\nA page each, made from its class and YAML. Which one to take for a robot: "
        "`estima recommend sensors=hokuyo robot.kr=2e-5`, and [the comparison of all]"
        "(../../index.md#boards).\n"
    )
    rows = []
    for name in names:
        said = paths.about(paths.CONF / "estimator" / f"{name}.yaml")
        rows.append((f"[`{name}`]({_page(name)})", said["what"], said["not_for"]))
    yield from _table(("estimator", "what it is", "not for"), rows)


def _each(names: Iterable[str]) -> Iterator[tuple[str, str]]:
    with open_composer() as composer:
        rows = judged(composer)
        times = seconds_a_frame()
        for name in names:
            cfg = composer.compose([f"estimator={name}"]).cfg.estimator
            stated = {str(key): value for key, value in cfg.items_ex(resolve=False)}
            yield name, "\n".join(_estimator(name, stated, rows, times))


def _estimator(
    name: str, stated: Mapping[str, Any], rows: list[Judged], times: Mapping[str, float]
) -> Iterator[str]:
    said = paths.about(paths.CONF / "estimator" / f"{name}.yaml")
    kind = find(stated["_target_"], "estimator")
    yield f"# {name}\n\n{said['what']}.\n"
    yield f"**Not for** {said['not_for']}\n"
    needs = getattr(kind, "needs", frozenset())
    if isinstance(needs, frozenset):
        reads = ", ".join(sorted(need.replace("|", " or ") for need in needs))
        yield f"**Needs** {reads or 'the wheels alone'}. **Class** `{stated['_target_']}`.\n"
    for text in (inspect.getdoc(inspect.getmodule(kind)), inspect.getdoc(kind)):
        yield f"{_prose(text or '')}\n"
    yield f"```text\nestima run estimator={name}\nestima options {name}\n```\n\n## Options\n"
    yield from _keys(kind, stated, "estimator.")
    yield "## On the boards\n"
    yield from _on_the_boards(name.rpartition("/")[2], rows, times)


def _on_the_boards(name: str, rows: list[Judged], times: Mapping[str, float]) -> Iterator[str]:
    """Its place among all methods of a table in each world, for studies of one setting."""
    cells = []
    for table in ("leaderboard", "peers"):
        for world in sorted({row.setting["world"] for row in rows if row.table == table}):
            board = [r for r in rows if r.table == table and r.setting["world"] == world]
            board.sort(key=lambda row: row.error_m)
            for place, row in enumerate(board, start=1):
                if row.estimator.removesuffix(TUNED) == name:
                    time = times.get(row.estimator) if table == "peers" else None
                    took = f"{significant(time * 1e3, 2)} ms" if time else ""
                    error = f"{significant(row.error_m * 1e3, 2)} mm"
                    where = f"{place} of {len(board)}"
                    cells.append((f"`{table}`", world, row.estimator, error, where, took))
    if cells:
        yield "Places are among all methods of the study, whatever they read.\n"
        head = ("study", "world", "option", "position RMSE", "place", "processor time a Frame")
        yield from _table(head, cells)
    else:
        yield "It is in no table that compares all methods.\n"


def _page(name: str) -> str:
    return f"{name.replace('/', '_')}.md"


# Claims


def _claims() -> Iterator[str]:
    yield (
        "# Claims\n\nEach claim, its verdict, and what was measured. The same is in "
        "`results/verdicts.csv`, and `estima reproduce` judges all again from the tables. "
        "`results/claims.csv` has every number with its interval and its criterion; where in the "
        "code a claim is judged, [The papers](../papers.md) says.\n"
    )
    verdicts = pd.read_csv(ROOT / "results" / "verdicts.csv", keep_default_na=False)
    for study, rows in verdicts.groupby("paper", sort=False):
        yield f"## {findings(str(study))['title']}\n"
        named = rows.assign(verdict=[Verdict(verdict).label for verdict in rows["verdict"]])
        of_each = named[["id", "says", "verdict", "sentence"]].itertuples(index=False)
        yield from _table(("claim", "what is claimed", "verdict", "what was measured"), of_each)


# Figures


def _gallery() -> Iterator[str]:
    yield (
        "# Gallery\n\nEvery figure of the papers and of our studies, with the command that makes "
        "it. `estima reproduce --figures-only --paper NAME` draws those of one again from the "
        "tables on disk.\n"
    )
    for room in ROOMS:
        for study in sorted(path.parent.name for path in room.glob("*/findings.yaml")):
            page = findings(study)
            yield f"## {page['title']}\n\n{' '.join(page['about'].split())}\n"
            commands = OWN.get(study) or [reproduce_command(study)]
            yield "```text\n" + "\n".join(commands) + "\n```\n"
            for name, figure in page["figures"].items():
                if (ROOT / "results" / "figures" / f"{name}.png").exists():
                    said = " ".join(figure["alt"].split())
                    yield f"### {figure['title']}\n\n![{said}](gallery/{name}.png)\n\n{said}\n"


# Markdown


def _table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> Iterator[str]:
    rows = [[_cell(cell) for cell in row] for row in rows]
    if rows:
        head = list(head)
        lines = [head, ["---"] * len(head), *rows]
        yield "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _cell(value: Any) -> str:
    return " ".join(str(value).split()).replace("|", "\\|")


def _value(value: Any) -> str:
    if value is dataclasses.MISSING:
        return "required"
    words = {None: "null", True: "true", False: "false"}
    if dataclasses.is_dataclass(value):
        value = dataclasses.asdict(value)
    return _code(next((said for known, said in words.items() if value is known), value))


def _code(value: Any) -> str:
    return f"`{value}`" if value not in ("", "required") else str(value)


def _first(kind: Any) -> str:
    """First paragraph of a docstring."""
    return (inspect.getdoc(kind) or "").partition("\n\n")[0]


def _prose(text: str) -> str:
    """A NumPy docstring as Markdown: its headings bold, without Parameters and the like."""
    lines: list[str] = []
    for line in text.splitlines():
        if set(line) == {"-"} and lines:
            lines[-1] = f"**{lines[-1]}**\n"
        else:
            lines.append(line)
    return "\n".join(lines)
