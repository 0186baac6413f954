"""Figures of the study of self-knowledge."""

import textwrap
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.evaluation.alarm import Evidence, alarm_curve
from experiments.judging.results import Results
from experiments.studies.self_knowledge.planted import LIFTED
from experiments.viewing.plotting import with_legend
from experiments.viewing.style import BLACK, CYCLE, WALL, subplots

_FAULTS = {"start": "start misread", "wheels": "wheels lifted"}
_USEFUL = 0.5  # share of losses missed, above which a curve is grey
_CONSISTENT = 0.90, 0.99  # share inside the ellipsoid of 95 % that passes


def draw(results: Results) -> dict[str, Figure]:
    """Draw the study's figures."""
    coverage, wean, quiet = (results.optional_table(n) for n in ("coverage", "wean", "quiet"))
    said = pd.concat([results.table("said"), quiet])
    drawn = {"self_knowledge_alarms": draw_alarms(said)}
    if coverage is not None:
        drawn["self_knowledge_coverage"] = draw_coverage(coverage)
    if wean is not None:
        drawn["self_knowledge_wean"] = draw_wean(wean, curves(said))
    return drawn


def curves(said: pd.DataFrame, planted: str | None = None) -> pd.DataFrame:
    """Share of losses missed against false alarms an hour, by method.

    Parameters
    ----------
    said
        Columns `method`, `planted`, `kind` and `signal`: of losses, of windows without one, of
        failed runs.
    planted
        The fault whose losses count; None: those of every drive. Windows always count all.
    """
    if planted is not None:
        said = said[(said["planted"] == planted) | (said["kind"] != "peaks")]
    parts = []
    for method, own in said.groupby("method"):
        both = (own.loc[own["kind"] == kind, "signal"].to_numpy(float) for kind in Evidence._fields)
        evidence = Evidence(*both)
        rows = pd.DataFrame(alarm_curve([evidence]), columns=["threshold", "missed", "false_per_h"])
        failed = int((own["kind"] == "failed").sum())
        numbers = {"losses": len(evidence.peaks), "quiet": len(evidence.quiet), "failed": failed}
        parts.append(rows.assign(method=method, **numbers))
    return pd.concat(parts, ignore_index=True)


def draw_alarms(said: pd.DataFrame) -> Figure:
    """Share of losses missed against false alarms an hour, a line a method and a panel a fault.

    Those that miss half of them at one false alarm an hour, with either fault, are grey.
    """
    page, panels = subplots(6.5, 4.2, 1, len(_FAULTS), sharey=True)
    said = said[said["method"] != "smoother"]  # dead reckoning until it ends
    tables = {
        fault: curves(said, fault).dropna(subset=["missed", "false_per_h"]) for fault in _FAULTS
    }
    missed = pd.DataFrame(
        {
            fault: known[known["false_per_h"] <= 1.0].groupby("method")["missed"].min()
            for fault, known in tables.items()
        }
    )
    best = missed.min(axis=1).sort_values()
    useful = [str(method) for method in best.index if best[method] < _USEFUL]
    colours = dict(zip(useful, CYCLE, strict=False))
    for axes, (fault, known) in zip(panels, tables.items(), strict=True):
        for method, part in known.groupby("method"):
            style: dict[str, Any] = {"color": WALL, "lw": 0.8, "alpha": 0.6, "zorder": 1}
            if method in colours:
                style = {"color": colours[str(method)], "lw": 2.0, "label": method}
            axes.step(part["false_per_h"], part["missed"], where="post", **style)
        axes.axvline(1.0, color=BLACK, lw=0.8, ls=":", label="one false alarm an hour")
        axes.set_xscale("symlog", linthresh=1.0)
        axes.set_xlim(0.0, 1.1 * max(1.0, float(known["false_per_h"].max())))
        axes.set_xticks([0.0, 1.0, 10.0, 100.0], ["0", "1", "10", "100"])
        axes.set(xlabel="false alarms an hour", ylim=(-0.02, 1.02), title=_FAULTS[fault])
    poor = [str(method) for method in best.index if str(method) not in colours]
    if poor:
        label = textwrap.fill(", ".join(poor), 40)
        panels[0].plot([], [], color=WALL, lw=0.8, label=label)
    panels[0].set(ylabel="share of losses missed")
    return with_legend(page, ncols=3, of=panels[0])


def draw_coverage(table: pd.DataFrame) -> Figure:
    """Share of poses inside the 95 % ellipsoid, a row a method and answer."""
    wheels = (table["method"] == "smoother") & (table["answer"] == "online")  # as `odometry`
    ordered = table[~wheels].sort_values("inside_95_share", ignore_index=True)
    page, axes = subplots(6.5, 0.9 + 0.28 * len(ordered), 1, 1)
    axes.axvspan(*_CONSISTENT, color="#dddddd", lw=0, label="goal")
    axes.axvline(0.95, color="#999999", lw=0.8, ls=":", label="consistent")
    reach = np.abs(ordered[["low", "high"]].to_numpy().T - ordered["inside_95_share"].to_numpy())
    axes.errorbar(ordered["inside_95_share"], ordered.index, xerr=reach, fmt="o", ms=4, lw=1.0)
    names = [
        row.method if row.answer == "online" else f"{row.method} ({row.answer})"
        for row in ordered.itertuples()
    ]
    axes.set_yticks(ordered.index, names)
    left = min(0.8, float(ordered["low"].min()))
    axes.set(xlabel="share of poses inside the 95 % ellipsoid", xlim=(left - 0.02, 1.01))
    return with_legend(page, ncols=2)


def draw_wean(table: pd.DataFrame, curve: pd.DataFrame) -> Figure:
    """What `mcl` says over a real log, as logged and with wheels that are lifted."""
    page, (above, below) = subplots(6.5, 4.2, 2, 1, sharex=True)
    time_s, logged, lifted = table["stamp_s"], *CYCLE[:2]
    above.plot(time_s, table["apart_m"], color=lifted)
    above.set(ylabel="distance between\nthe two paths, m", ylim=(0.0, None))
    below.plot(
        time_s,
        table["lost_lifted"],
        color=lifted,
        lw=0.8,
        label="mcl, wheels lifted in the grey band",
    )
    below.plot(time_s, table["lost"], color=logged, lw=0.8, label="mcl, as logged")
    own = curve[(curve["method"] == "mcl") & (curve["false_per_h"] <= 1.0)]
    threshold = own["threshold"].min()
    below.axhline(threshold, color="#999999", lw=0.8, ls=":", label="alarm, from simulated drives")
    for axes in (above, below):
        axes.axvspan(*np.quantile(time_s, LIFTED), color="#e0e0e0", lw=0)
    below.set(xlabel="time, s", ylabel="scan misfit\n(signal lost)", ylim=(0.0, 1.02))
    return with_legend(page, ncols=3, of=below)
