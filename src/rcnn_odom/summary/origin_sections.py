"""Sections about the runs themselves: a list of them with their time, their commands and versions."""

import shlex
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rcnn_odom.summary.folders import Run
from rcnn_odom.summary.options import setting_of
from rcnn_odom.summary.runs_table import Sweep
from rcnn_odom.summary.tables import DASH, code, duration, escape, markdown_table, number

if TYPE_CHECKING:
    import pandas as pd


def runs_section(sweep: Sweep, table: "pd.DataFrame") -> str:
    """Every run with its setting, scores, time and place; the time of all together."""
    labels = {run.name: _run_label(sweep, run) for run in sweep.runs}
    cells: list[tuple[str, Callable[[Any], str]]] = [
        ("run", lambda row: row["run"]),
        ("setting", lambda row: labels.get(row["run"], DASH)),
        ("status", lambda row: row["status"]),
        ("seed", lambda row: _known(row["seed"])),
        ("drift %", lambda row: number(100 * row["drift"])),
        ("validation %", lambda row: number(100 * row["val_drift"])),
        ("training", lambda row: duration(row["seconds"])),
        ("first stage", lambda row: duration(row["first_stage_seconds"])),
        ("same training as", lambda row: _known(row["same_as"])),
    ]
    rows = [[tell(row) for _, tell in cells] for _, row in table.iterrows()]
    lines = ["## Runs and their time", markdown_table([name for name, _ in cells], rows, words=3)]
    own = table[table["same_as"].isna()]
    known = own["seconds"].notna().sum()
    total = own["seconds"].sum() + own["first_stage_seconds"].sum()
    lines.append(
        f"Trained for {duration(total)} in all, by the {known} runs that tell their time. A run that "
        "took the weights of the same training elsewhere is not counted; first stages are where a run "
        "trained its own."
    )
    repeats = table[table["repeats"].notna()]
    if len(repeats):
        pairs = (f"{code(row['run'])} ({code(row['repeats'])} counts)" for _, row in repeats.iterrows())
        lines.append(f"Not counted, as another run has the same setting and seed: {', '.join(pairs)}.")
    return "\n\n".join(lines)


def _run_label(sweep: Sweep, run: Run) -> str:
    return sweep.label(setting_of(run, sweep.options)) if run.settings else DASH


def _known(value: Any) -> str:
    return DASH if value is None or value != value else str(value)


def origin_section(sweep: Sweep) -> str:
    """The commands that made the runs, and what computed them."""
    lines = ["## Where it comes from"]
    for title, commands in commands_of(sweep).items():
        listing = "\n".join(f"    {line}" for line in commands)
        lines.append(f"{title}:\n\n{listing}")
    versions = versions_of(sweep)
    differing = {package: found for package, found in versions.items() if len(found) > 1}
    if differing:
        lines.append(
            f"> **Warning: the runs were made with different versions of {escape(', '.join(differing))}.**"
        )
    told = (f"{escape(package)} {escape(' and '.join(found))}" for package, found in versions.items())
    return "\n\n".join(
        [*lines, f"Versions: {', '.join(told)}." if versions else "No run tells its versions."]
    )


def commands_of(sweep: Sweep) -> dict[str, list[str]]:
    """Command lines under what they are, each once.

    A finished run that does not tell its command has it put together from what it set.
    """
    told, rebuilt = [], []
    for run in sweep.finished:
        if command := run.metrics.get("command"):
            told.append(" ".join(str(command).split()))
        elif run.overrides:
            rebuilt.append(shlex.join(["python", "train.py", *run.overrides]))
    found = {
        "As given": told,
        "Put together from the options of a run that does not tell its command": rebuilt,
    }
    return {title: list(dict.fromkeys(commands)) for title, commands in found.items() if commands}


def versions_of(sweep: Sweep) -> dict[str, list[str]]:
    """The versions of each package that the finished runs name."""
    versions: dict[str, dict[str, None]] = {}
    for run in sweep.finished:
        for package, version in (run.metrics.get("versions") or {}).items():
            versions.setdefault(package, {})[str(version)] = None
    return {package: list(found) for package, found in versions.items()}
