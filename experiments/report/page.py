"""Pages from templates: texts are escaped, and each is a single file."""

import base64
import hashlib
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from experiments.judging.results import Profile
from experiments.report.export import plain, significant
from sim.errors import printable

TEMPLATES = Path(__file__).parent / "templates"


def render(template: str, **found: Any) -> str:
    """Fill a template of a page; texts are escaped, and only the page's own scripts may run."""
    environment = Environment(
        loader=PackageLoader("experiments.report"),
        autoescape=True,
        finalize=_printable,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"plain": plain, "interval": interval, "verdict": verdict, "code": code}
    environment.globals |= {"script": _script}
    return environment.get_template(template).render(found)


def _script(name: str) -> Mapping[str, str]:
    """Text of a script of the page, and the hash by which the page's policy allows it."""
    text = (TEMPLATES / name).read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    return {"text": Markup(text), "allowed": f"'sha256-{digest}'"}


def _printable(value: Any) -> Any:
    """What a template shows, without control characters; what it has made itself stays."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return "\n".join(map(printable, value.split("\n")))


def code(text: str) -> Markup:
    """Text with what stands between backticks as code."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(printable(text)))))


def interval(row: Mapping[str, Any]) -> str:
    """A value and its interval; the value alone where nothing is random; empty if unknown."""
    if math.isnan(row["value"]):
        return ""
    value, low, high = (_number(row[name]) for name in ("value", "low", "high"))
    if math.isnan(row["low"]) and math.isnan(row["high"]):
        return f"{value}, without an interval"
    return value if row["low"] == row["high"] == row["value"] else f"{value} [{low}, {high}]"


def _number(value: float) -> str:
    """A whole number as it is, any other with three significant digits."""
    return plain(value) if value % 1 == 0 else significant(value, 3)


def verdict(row: Mapping[str, Any]) -> str:
    """A statistic's verdict in words, with its reason."""
    words = "; ".join(filter(None, [row["verdict"].label, row["reason"]]))
    return f"{words} (quick)" if row["profile"] == Profile.QUICK else words
