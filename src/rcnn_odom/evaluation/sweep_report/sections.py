"""The report's sections in words and tables: what was swept, every score, the paper's beside it, the runs."""

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
from rcnn_odom.evaluation.sweep_report.folders import Run, Scores, hydras
from rcnn_odom.evaluation.sweep_report.options import setting_of, show_value
from rcnn_odom.evaluation.sweep_report.runs_table import MISSING, Sweep
from rcnn_odom.evaluation.sweep_report.statistics import mean_sd

if TYPE_CHECKING:
    import pandas as pd


def opening(sweep: Sweep, now: datetime) -> str:
    """Title, what was swept, how the runs ended, and a warning with every run that is not finished."""
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


def drift_table(sweep: Sweep) -> tuple[Row, list[Row]]:
    """Header and rows of the comparison table: settings, reference methods, baselines, the floor."""
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
    """Scores of evaluations by name and folder, then of the baselines as each run has them."""
    methods: dict[str, list[Scores]] = {}
    for run in sweep.evaluations:
        methods[f"{run.metrics.variant} ({run.name})"] = [run.metrics.scores]
    for run in sweep.finished:
        for name, scores in run.metrics.baselines.items():
            methods.setdefault(name, []).append(scores)
    return methods


def _drift_row(sweep: Sweep, label: str, seeds: str, scores: Sequence[Scores]) -> Row:
    validation = _metric_cell(DRIFT, [one.get("val_drift") for one in scores])
    return [label, seeds, validation, *_drift_cells(sweep, "drift", scores), number(_latency(scores))]


def _drift_cells(sweep: Sweep, kind: str, scores: Sequence[Scores]) -> list[str]:
    """``drift`` or ``floor`` of each test sequence and their mean, in percent."""
    keys = [*(f"{kind}_{name}" for name in sweep.sequences), kind]
    return [_metric_cell(DRIFT, [one.get(key) for one in scores]) for key in keys]


def _latency(scores: Sequence[Scores]) -> float | None:
    """Of the fastest seed, in milliseconds: other jobs on a machine only ever slow it."""
    return min((one["latency_ms"] for one in scores if one.get("latency_ms") is not None), default=None)


def drift_section(sweep: Sweep, figure: str) -> str:
    """The comparison table and how to read it."""
    header, rows = drift_table(sweep)
    lines = [
        "## Drift",
        markdown_table(header, rows),
        "Mean ± standard deviation over seeds (sample, divisor n-1); without one where there is one seed, or "
        "all are the same. The mean column gives every test sequence the same weight. The time of a frame is "
        "the fastest seed's median, as other jobs on the machine only ever slow it.",
    ]
    if any("(fewer)" in row[1] for row in rows):
        lines.append("**(fewer)**: fewer seeds than the others have; its mean is not over the same seeds.")
    if sweep.evaluations:
        lines.append("Methods with a folder in brackets were scored by `evaluate.py`.")
    if sweep.left_out:
        lines.append(f"Left out, as scored on other drives: {', '.join(map(code, sweep.left_out))}.")
    return "\n\n".join([*lines, figure])


def paper_section(sweep: Sweep) -> str:
    """The paper's table II beside ours, and what it claims of the swept options; empty for other drives."""
    parts = [paper.CLAIMS[option] for option in sweep.options if option in paper.CLAIMS]
    if sweep.sequences == paper.SEQUENCES:
        names = [*paper.SEQUENCES, "mean"]
        header = ["drift in %", *(f"ours, {name}" for name in names), "ours, s a frame"]
        header += [f"paper, {name}" for name in names] + ["paper, s a frame"]
        data = escape(sweep.finished[0].metrics.data)
        ours = (
            f"Ours are on `data={data}`" if data == "kitti" else f"Ours are on {data} drives, not on KITTI's"
        )
        parts += [
            markdown_table(header, _paper_rows(sweep)),
            paper.TABLE_NOTE,
            f"{ours}: for orientation only.",
        ]
    return "\n\n".join(["## The paper", *parts]) if parts else ""


def _paper_rows(sweep: Sweep) -> list[Row]:
    rows: list[Row] = []
    left = dict(paper.VARIANTS)
    for setting, runs in sweep.by_setting.items():
        variants = {run.metrics.variant for run in runs.values()}
        column = paper.VARIANTS.get(variants.pop()) if len(variants) == 1 else None
        if column is None or not all(paper.NETWORK.items() <= run.settings.items() for run in runs.values()):
            continue
        left = {name: other for name, other in left.items() if other is not column}
        scores = _scores(runs.values())
        latency = _latency(scores)
        seconds = number(None if latency is None else latency / 1000, 4)
        cells = _drift_cells(sweep, "drift", scores)
        rows.append([sweep.label(setting), *cells, seconds, *_paper_cells(column)])
    for column in (*left.values(), *paper.COMPARED_METHODS):
        rows.append([column.name, *[DASH] * 4, *_paper_cells(column)])
    return rows


def _paper_cells(column: paper.PaperColumn) -> list[str]:
    return [*(percent(drift) for drift in column.drift), number(column.seconds, 3)]


def metrics_table(sweep: Sweep) -> tuple[Row, list[Row]]:
    """Header and rows of every metric but the drift, by setting and method, over all test sequences."""
    metrics = [metric for metric in all_metrics().values() if metric.name != "drift"]
    header = ["over all sequences", *(f"{metric.title} ({metric.unit})" for metric in metrics)]
    methods = {sweep.label(setting): _scores(runs.values()) for setting, runs in sweep.by_setting.items()}
    rows: list[Row] = [
        [label, *(_metric_cell(metric, [one.get(metric.name) for one in scores]) for metric in metrics)]
        for label, scores in (methods | reference_methods(sweep)).items()
    ]
    return header, rows


def _metric_cell(metric: Metric, values: Sequence[float | None]) -> str:
    """Mean and deviation over the runs; of the largest errors the largest."""
    known = [value for value in values if value is not None]
    if metric.combine == "max" or not known:
        return metric.show(max(known, default=None))
    mean, sd = mean_sd(known)
    deviation = f" ± {metric.scale * sd:.{metric.digits}f}" if sd and max(known) - min(known) > 1e-9 else ""
    return metric.show(mean) + deviation


def metrics_section(sweep: Sweep) -> str:
    """The table of all metrics but the drift, and how to read it."""
    lines = [
        "## Other metrics",
        markdown_table(*metrics_table(sweep)),
        "Mean ± standard deviation over seeds. Mean absolute and signed errors are over all motions of the "
        "test sequences; the largest error is that of any seed.",
    ]
    is_papers = sweep.sequences == paper.SEQUENCES
    return "\n\n".join([*lines, paper.FRAME_ERRORS_NOTE] if is_papers else lines)


def runs_section(sweep: Sweep, table: "pd.DataFrame") -> str:
    """Every run with its setting, scores, time and place; the time of all together."""
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
        f"Trained for {duration(total)} in all, by the {known} runs whose time is known. A run that "
        "took the weights of the same training elsewhere is not counted; first stages are where a run "
        "trained its own."
    )
    repeats = table[table["repeats"].notna()]
    if len(repeats):
        pairs = (f"{code(row['run'])} ({code(row['repeats'])} counts)" for _, row in repeats.iterrows())
        lines.append(f"Not counted, as another run has the same setting and seed: {', '.join(pairs)}.")
    return "\n\n".join(lines)


def origin_section(sweep: Sweep) -> str:
    """The commands that made the runs, and what computed them."""
    every = [run.metrics.versions for run in sweep.finished]
    packages = dict.fromkeys(package for one in every for package in one)
    versions = {name: dict.fromkeys(one[name] for one in every if name in one) for name in packages}
    found = ", ".join(f"{escape(name)} {escape(' and '.join(numbers))}" for name, numbers in versions.items())
    differing = [name for name, numbers in versions.items() if len(numbers) > 1]
    warning = f"> **Warning: the runs were made with different versions of {escape(', '.join(differing))}.**"
    return "\n\n".join(
        [
            "## Where it comes from",
            *_commands(sweep),
            *([warning] if differing else []),
            f"Versions: {found}." if found else "The versions are not known.",
        ]
    )


def _commands(sweep: Sweep) -> list[str]:
    """The folder's last command, as Hydra keeps it, and the one that repeats each finished run."""
    every = [run.overrides for run in sweep.finished if run.overrides]
    titles = {"Each run alone": every}
    if given := hydras(sweep.directory / "multirun.yaml", "hydra", "overrides"):
        words = [
            word for group in ("hydra", "task") for word in given[group] if word != "hydra.mode=MULTIRUN"
        ]
        titles = {"The last command for this folder": [("-m", *map(str, words))], **titles}
    lines = []
    for title, commands in titles.items():
        shown = dict.fromkeys("    " + shlex.join(["rcnn-odom", "train", *options]) for options in commands)
        lines += [f"{title}:", "\n".join(shown)] if shown else []
    return lines
