"""The text sections of the report: swept options, scores, results of the paper, runs, and commands."""

import shlex
from collections.abc import Iterable, Sequence
from datetime import datetime
from typing import TYPE_CHECKING

from rcnn_odom.evaluation.metrics import DRIFT, Metric, all_metrics
from rcnn_odom.evaluation.scores import percent
from rcnn_odom.evaluation.sweep_report import paper
from rcnn_odom.evaluation.sweep_report.document import (
    DASH,
    Row,
    code,
    duration,
    escape,
    markdown_table,
    number,
)
from rcnn_odom.evaluation.sweep_report.folders import Run, Scores, read_hydra_value
from rcnn_odom.evaluation.sweep_report.options import setting_of, show_value
from rcnn_odom.evaluation.sweep_report.runs_table import MISSING, Sweep
from rcnn_odom.evaluation.sweep_report.statistics import mean_sd

if TYPE_CHECKING:
    import pandas as pd


def opening_section(sweep: Sweep, now: datetime) -> str:
    """Title, number of runs by status, a warning that lists all runs that are not finished, swept options."""
    counts = {"finished": len(sweep.finished)}
    for status in ("failed", "unfinished", "damaged"):
        counts[status] = sum(run.status == status for run in sweep.runs)
    counts["missing"] = len(sweep.missing)
    ended = ", ".join(
        f"{count} {status}" for status, count in counts.items() if count or status == "finished"
    )
    lines = [
        f"# Runs in {code(sweep.directory.resolve().name)}",
        f"Written on {now:%Y-%m-%d at %H:%M}. Of {len(sweep.runs) + len(sweep.missing)} runs: {ended}.",
        _warning(sweep),
        _swept_options(sweep),
    ]
    return "\n\n".join(filter(None, lines))


def _warning(sweep: Sweep) -> str:
    """A warning that lists all runs that are not finished; empty if there are none."""
    problems = []
    for run in sweep.runs:
        if run.status != "finished":
            # The names of a sweep's folders already contain the options that the runs set.
            options = [text for text in run.overrides if text.replace("=", "-") not in run.name]
            options_note = f" ({escape(', '.join(options))})" if options else ""
            problems.append(f"> - **{run.status}** {code(run.name)}{options_note}: {escape(run.problem)}")
    problems += [f"> - **missing** {code(name)}: {MISSING}" for name in sweep.missing]
    if not problems:
        return ""
    advice = (
        "> They are left out of all means below. Repeat the command of the sweep to finish them, "
        "then write this report again."
    )
    count = f"{len(problems)} run{'s are' if len(problems) > 1 else ' is'}"
    return "\n".join([f"> **Warning: {count} not finished.**", ">", *problems, ">", advice])


def _swept_options(sweep: Sweep) -> str:
    """The swept options with their values, the seeds, and the test sequences."""
    rows = []
    for place, option in enumerate(sweep.options):
        values = dict.fromkeys(show_value(setting[place]) for setting in sweep.by_setting)
        rows.append(f"- {code(option)}: {', '.join(map(code, values))}")
    seeds = sorted({run.settings["seed"] for run in sweep.runs if run.settings})
    rows.append(f"- {code('seed')}: {', '.join(map(str, seeds))}")
    first = next((run for run in sweep.runs if run.settings), None)
    name = first.settings.get("data.name") if first else None
    data = f"Tested on {', '.join(map(escape, sweep.sequences))} of {code(f'data={name}')}."
    return "\n".join(["Swept options:", "", *rows, "", data])


def drift_table(sweep: Sweep) -> tuple[Row, list[Row]]:
    """Header and rows of the drift table: settings, evaluated methods, baselines, and the floor."""
    header = ["drift in %", "seeds", "validation", *sweep.sequences, "mean", "ms a frame"]
    most = max(map(len, sweep.by_setting.values()))
    rows = []
    for setting, runs in sweep.by_setting.items():
        seeds = f"{len(runs)}" if len(runs) == most else f"{len(runs)} (fewer)"
        rows.append(_drift_row(sweep, sweep.label(setting), seeds, _scores(runs.values())))
    for name, scores in reference_methods(sweep).items():
        rows.append(_drift_row(sweep, name, DASH, scores))
    floors = _drift_cells(sweep, "floor", _scores(sweep.finished))
    rows.append(["floor of two-number motion", DASH, DASH, *floors, DASH])
    return header, rows


def _scores(runs: Iterable[Run]) -> list[Scores]:
    return [run.metrics.scores for run in runs]


def reference_methods(sweep: Sweep) -> dict[str, list[Scores]]:
    """Scores of the evaluations by method and folder, and those of the baselines from all finished runs."""
    methods: dict[str, list[Scores]] = {}
    for run in sweep.evaluations:
        methods[f"{run.metrics.variant} ({run.name})"] = [run.metrics.scores]
    for run in sweep.finished:
        for name, scores in run.metrics.baselines.items():
            methods.setdefault(name, []).append(scores)
    return methods


def _drift_row(sweep: Sweep, label: str, seeds: str, scores: Sequence[Scores]) -> Row:
    validation = _metric_cell(DRIFT, [each.get("val_drift") for each in scores])
    return [label, seeds, validation, *_drift_cells(sweep, "drift", scores), number(_fastest_latency(scores))]


def _drift_cells(sweep: Sweep, kind: str, scores: Sequence[Scores]) -> list[str]:
    """Cells with the drift or the floor (``kind``) of each test sequence and the mean, in percent."""
    keys = [*(f"{kind}_{name}" for name in sweep.sequences), kind]
    return [_metric_cell(DRIFT, [each.get(key) for each in scores]) for key in keys]


def _fastest_latency(scores: Sequence[Scores]) -> float | None:
    """Latency of the fastest seed in milliseconds, because other jobs on the machine can only slow a run."""
    return min((each["latency_ms"] for each in scores if each.get("latency_ms") is not None), default=None)


def drift_section(sweep: Sweep, figure: str) -> str:
    """The drift table with its explanation and its figure."""
    header, rows = drift_table(sweep)
    lines = [
        "## Drift",
        markdown_table(header, rows),
        "Mean ± sample standard deviation (divisor n-1) over seeds; the deviation is left out if there is "
        "only one seed or all values are equal. The mean column gives each test sequence the same weight. "
        "The time per frame is the median of the fastest seed, because other jobs on the machine can only "
        "slow a run.",
    ]
    if any("(fewer)" in row[1] for row in rows):
        lines.append(
            "**(fewer)**: this setting has fewer seeds than others, so its mean is over other seeds."
        )
    if sweep.evaluations:
        lines.append("Methods with a folder in brackets were scored by `evaluate.py`.")
    if sweep.left_out:
        lines.append(
            f"Left out because they were scored on other drives: {', '.join(map(code, sweep.left_out))}."
        )
    return "\n\n".join([*lines, figure])


def paper_section(sweep: Sweep) -> str:
    """The paper's claims about the swept options, and its table II beside our results on the same sequences.

    Empty if there are neither.
    """
    parts = [paper.CLAIMS[option] for option in sweep.options if option in paper.CLAIMS]
    if sweep.sequences == paper.SEQUENCES:
        names = [*paper.SEQUENCES, "mean"]
        header = ["drift in %", *(f"ours, {name}" for name in names), "ours, s a frame"]
        header += [f"paper, {name}" for name in names] + ["paper, s a frame"]
        data = escape(sweep.finished[0].metrics.data)
        ours = (
            f"Our results are on `data={data}`"
            if data == "kitti"
            else f"Our results are on {data} drives, not on KITTI's"
        )
        parts += [
            markdown_table(header, _paper_rows(sweep)),
            paper.TABLE_NOTE,
            f"{ours}; the comparison is for orientation only.",
        ]
    return "\n\n".join(["## The paper", *parts]) if parts else ""


def _paper_rows(sweep: Sweep) -> list[Row]:
    """Rows of the settings that the paper has too, then of its other networks and compared methods."""
    rows: list[Row] = []
    remaining = dict(paper.VARIANTS)
    for setting, runs in sweep.by_setting.items():
        variants = {run.metrics.variant for run in runs.values()}
        column = paper.VARIANTS.get(variants.pop()) if len(variants) == 1 else None
        if column is None or not all(paper.NETWORK.items() <= run.settings.items() for run in runs.values()):
            continue
        remaining = {name: other for name, other in remaining.items() if other is not column}
        scores = _scores(runs.values())
        latency = _fastest_latency(scores)
        seconds = number(None if latency is None else latency / 1000, 4)
        cells = _drift_cells(sweep, "drift", scores)
        rows.append([sweep.label(setting), *cells, seconds, *_paper_cells(column)])
    for column in (*remaining.values(), *paper.COMPARED_METHODS):
        rows.append([column.name, *[DASH] * 4, *_paper_cells(column)])
    return rows


def _paper_cells(column: paper.PaperColumn) -> list[str]:
    return [*(percent(drift) for drift in column.drift), number(column.seconds, 3)]


def metrics_table(sweep: Sweep) -> tuple[Row, list[Row]]:
    """Header and rows of all metrics except the drift over all test sequences, by setting and method."""
    metrics = [metric for metric in all_metrics().values() if metric.name != "drift"]
    header = ["over all sequences", *(f"{metric.title} ({metric.unit})" for metric in metrics)]
    methods = {sweep.label(setting): _scores(runs.values()) for setting, runs in sweep.by_setting.items()}
    rows: list[Row] = [
        [label, *(_metric_cell(metric, [each.get(metric.name) for each in scores]) for metric in metrics)]
        for label, scores in (methods | reference_methods(sweep)).items()
    ]
    return header, rows


def _metric_cell(metric: Metric, values: Sequence[float | None]) -> str:
    """Mean and standard deviation over the runs; for a largest error, the largest of all runs."""
    known = [value for value in values if value is not None]
    if metric.combine == "max" or not known:
        return metric.show(max(known, default=None))
    mean, sd = mean_sd(known)
    deviation = f" ± {metric.scale * sd:.{metric.digits}f}" if sd and max(known) - min(known) > 1e-9 else ""
    return metric.show(mean) + deviation


def metrics_section(sweep: Sweep) -> str:
    """The table of all metrics except the drift, with its explanation."""
    lines = [
        "## Other metrics",
        markdown_table(*metrics_table(sweep)),
        "Mean ± standard deviation over seeds. Mean absolute and signed errors are means over all motions of "
        "the test sequences; the largest error is the largest of all seeds.",
    ]
    has_paper_sequences = sweep.sequences == paper.SEQUENCES
    return "\n\n".join([*lines, paper.FRAME_ERRORS_NOTE] if has_paper_sequences else lines)


def runs_section(sweep: Sweep, table: "pd.DataFrame") -> str:
    """The table of all runs with setting, scores and training time, and the total training time."""
    shown = table.astype(object).where(table.notna(), None)
    labels = {run.name: sweep.label(setting_of(run, sweep.options)) for run in sweep.runs if run.settings}
    header = [
        *("run", "setting", "status", "seed", "drift %", "validation %", "training", "first stage"),
        "same training as",
    ]
    rows = [
        [
            *(row["run"], labels.get(row["run"], DASH), row["status"], show_value(row["seed"])),
            *(percent(row["drift"]), percent(row["val_drift"])),
            *(duration(row["seconds"]), duration(row["first_stage_seconds"]), show_value(row["same_as"])),
        ]
        for _, row in shown.iterrows()
    ]
    table_of_runs = markdown_table(header, rows, words=3, names=("run", "same training as"))
    lines = ["## Runs and their time", table_of_runs]
    own = table[table["same_as"].isna()]
    known = own["seconds"].notna().sum()
    total = own["seconds"].sum() + own["first_stage_seconds"].sum()
    lines.append(
        f"Total training time: {duration(total)}, of the {known} runs whose time is known. Runs that took "
        "the weights of the same training elsewhere are not counted. First stages are counted if the run "
        "trained its own."
    )
    repeats = table[table["repeats"].notna()]
    if len(repeats):
        pairs = (f"{code(row['run'])} ({code(row['repeats'])} counts)" for _, row in repeats.iterrows())
        lines.append(
            f"Left out of the means because another run has the same setting and seed: {', '.join(pairs)}."
        )
    return "\n\n".join(lines)


def origin_section(sweep: Sweep) -> str:
    """The commands of the runs, and the versions of the packages that were used."""
    every = [run.metrics.versions for run in sweep.finished]
    packages = dict.fromkeys(package for each in every for package in each)
    versions = {name: dict.fromkeys(each[name] for each in every if name in each) for name in packages}
    found = ", ".join(f"{escape(name)} {escape(' and '.join(numbers))}" for name, numbers in versions.items())
    differing = [name for name, numbers in versions.items() if len(numbers) > 1]
    warning = f"> **Warning: the runs were made with different versions of {escape(', '.join(differing))}.**"
    return "\n\n".join(
        [
            "## Commands and versions",
            *_commands(sweep),
            *([warning] if differing else []),
            f"Versions: {found}." if found else "The versions are not known.",
        ]
    )


def _commands(sweep: Sweep) -> list[str]:
    """The last command of the folder, from Hydra's files, and the commands that repeat each finished run."""
    every = [run.overrides for run in sweep.finished if run.overrides]
    titles = {"Commands of the single runs": every}
    if given := read_hydra_value(sweep.directory / "multirun.yaml", "hydra", "overrides"):
        words = [
            word for group in ("hydra", "task") for word in given[group] if word != "hydra.mode=MULTIRUN"
        ]
        titles = {"Last command of this folder": [("-m", *map(str, words))], **titles}
    lines = []
    for title, commands in titles.items():
        shown = dict.fromkeys("    " + shlex.join(["rcnn-odom", "train", *options]) for options in commands)
        lines += [f"{title}:", "\n".join(shown)] if shown else []
    return lines
