"""What a report says of the runs themselves: what was swept, how they ended, their time and origin."""

import shlex
from collections.abc import Callable
from datetime import datetime
from typing import TYPE_CHECKING, Any

import yaml

from rcnn_odom.evaluation.sweep_report.folders import Run
from rcnn_odom.evaluation.sweep_report.options import setting_of, show_value
from rcnn_odom.evaluation.sweep_report.runs_table import MISSING, Sweep
from rcnn_odom.evaluation.sweep_report.tables import DASH, code, duration, escape, markdown_table, number

if TYPE_CHECKING:
    import pandas as pd


def opening(sweep: Sweep, now: datetime) -> str:
    """Title, what was swept, how the runs ended, and a warning with every run that is not finished."""
    counts = {"finished": len(sweep.finished)}
    for status in ("failed", "unfinished", "damaged"):
        counts[status] = sum(run.status == status for run in sweep.runs)
    counts["missing"] = len(sweep.missing)
    told = ", ".join(f"{count} {status}" for status, count in counts.items() if count or status == "finished")
    lines = [
        f"# Runs in {code(sweep.directory.resolve().name)}",
        f"Written on {now:%Y-%m-%d at %H:%M}. Of {len(sweep.runs) + len(sweep.missing)} runs: {told}.",
        _problems(sweep),
        _swept(sweep),
    ]
    return "\n\n".join(filter(None, lines))


def _problems(sweep: Sweep) -> str:
    problems = []
    for run in sweep.runs:
        if run.status != "finished":
            # A sweep's folders are named by what their runs set.
            options = [text for text in run.overrides if text.replace("=", "-") not in run.name]
            which = f" ({escape(', '.join(options))})" if options else ""
            problems.append(f"> - **{run.status}** {code(run.name)}{which}: {escape(run.problem)}")
    problems += [f"> - **missing** {code(name)}: {MISSING}" for name in sweep.missing]
    if not problems:
        return ""
    advice = (
        "> No mean below contains them. Repeat the sweep's command to run what is not finished, "
        "then make this report again."
    )
    count = f"{len(problems)} run{'s are' if len(problems) > 1 else ' is'}"
    return "\n".join([f"> **Warning: {count} not finished.**", ">", *problems, ">", advice])


def _swept(sweep: Sweep) -> str:
    rows = []
    for place, option in enumerate(sweep.options):
        values = dict.fromkeys(show_value(setting[place]) for setting in sweep.by_setting)
        rows.append(f"- {code(option)}: {', '.join(map(code, values))}")
    seeds = sorted({run.settings["seed"] for run in sweep.runs if run.settings})
    rows.append(f"- {code('seed')}: {', '.join(map(str, seeds))}")
    first = next((run for run in sweep.runs if run.settings), None)
    name = first.settings.get("data.name") if first else None
    data = f"Tested on {', '.join(map(escape, sweep.sequences))} of {code(f'data={name}')}."
    return "\n".join(["Swept:", "", *rows, "", data])


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
    header = [name for name, _ in cells]
    names = ("run", "same training as")
    lines = ["## Runs and their time", markdown_table(header, rows, words=3, names=names)]
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
    versions: dict[str, dict[str, None]] = {}
    for run in sweep.finished:
        for package, version in run.metrics.versions.items():
            versions.setdefault(package, {})[version] = None
    told = [f"{escape(package)} {escape(' and '.join(found))}" for package, found in versions.items()]
    differing = [package for package, found in versions.items() if len(found) > 1]
    warning = f"> **Warning: the runs were made with different versions of {escape(', '.join(differing))}.**"
    return "\n\n".join(
        [
            "## Where it comes from",
            *_commands(sweep),
            *([warning] if differing else []),
            f"Versions: {', '.join(told)}." if told else "No run tells its versions.",
        ]
    )


def _commands(sweep: Sweep) -> list[str]:
    """The folder's last command, as Hydra keeps it; where it keeps none, the options of each run."""
    try:
        given = yaml.safe_load((sweep.directory / "multirun.yaml").read_text())["hydra"]["overrides"]
        options = [option for option in (*given["hydra"], *given["task"]) if option != "hydra.mode=MULTIRUN"]
        title, commands = "The last command for this folder", [["-m", *map(str, options)]]
    except (OSError, yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError):
        title = "Put together from the options of the runs"
        commands = [list(run.overrides) for run in sweep.finished if run.overrides]
    lines = dict.fromkeys("    " + shlex.join(["python", "train.py", *options]) for options in commands)
    return [f"{title}:", "\n".join(lines)] if lines else []
