"""A sweep's report, from its runs to its files."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.sweep_report.comparisons import (
    Comparison,
    compare,
    difference_section,
    drifts_by_setting,
    reference_setting,
    result,
)
from rcnn_odom.evaluation.sweep_report.document import image, text_table, write_report
from rcnn_odom.evaluation.sweep_report.figures import (
    curves_section,
    drift_figure,
    png,
    trajectories_section,
)
from rcnn_odom.evaluation.sweep_report.options import Values
from rcnn_odom.evaluation.sweep_report.runs_table import Sweep, read_sweep, runs_table
from rcnn_odom.evaluation.sweep_report.sections import (
    drift_section,
    drift_table,
    metrics_section,
    metrics_table,
    opening,
    origin_section,
    paper_section,
    runs_section,
)


@dataclass(frozen=True)
class Written:
    """What a report left behind.

    Attributes:
        markdown: path of ``report.md``.
        html: path of ``report.html``.
        table: of drift and of the other metrics, for a terminal.
        unfinished: runs that are not finished, missing ones included.
        content: ``runs``, the rows of ``load_runs``, and ``comparisons``, ready for JSON.
    """

    markdown: Path
    html: Path
    table: str
    unfinished: int
    content: dict[str, Any]


def make_report(
    directory: str | Path,
    only: Sequence[str] = (),
    reference: Sequence[str] = (),
    expected: Sequence[str] | None = None,
) -> Written:
    """Writes ``report.md``, ``report.html`` and ``report_figures`` into a folder of runs.

    Args:
        directory: a sweep's folder, or any around runs.
        only: ``KEY=VALUE`` of options that a run must have to be in the report.
        reference: ``KEY=VALUE`` that single out the setting to compare the others with.
        expected: names of the folders that the folder's last command asked for; None where not known.

    Raises:
        InputError: no such folder, no run in it, none of them finished, runs on different data, no such
            reference, or a file in the way that is no earlier report.
    """
    sweep = read_sweep(directory, only, expected)
    if not sweep.finished:
        first = next((run for run in sweep.runs if run.problem), None)
        why = f"; {first.name}: {first.problem}" if first else ""
        raise InputError(f"{directory}: none of its {len(sweep.runs)} runs is finished{why}")
    chosen, why = reference_setting(sweep, reference)
    drifts = drifts_by_setting(sweep)
    comparisons = compare(drifts, chosen)
    figures = {"drift": png(drift_figure({sweep.label(key): runs for key, runs in drifts.items()}))}
    table = runs_table(sweep)
    parts = [
        opening(sweep, datetime.now()),
        result(sweep, chosen, comparisons),
        drift_section(sweep, image("drift", "mean drift of every run, by setting")),
        difference_section(sweep, chosen, why, comparisons),
        paper_section(sweep),
        metrics_section(sweep),
        curves_section(sweep, figures),
        trajectories_section(sweep, figures),
        runs_section(sweep, table),
        origin_section(sweep),
    ]
    text = "\n\n".join(filter(None, parts))
    paths = write_report(sweep.directory, f"Runs in {sweep.directory.resolve().name}", text, figures)
    tables = "\n\n".join(text_table(*table(sweep)) for table in (drift_table, metrics_table))
    unfinished = len(sweep.runs) - len(sweep.finished) + len(sweep.missing)
    rows = json.loads(table.dropna(axis="columns", how="all").to_json(orient="records"))
    content = {"runs": rows, "comparisons": _comparison_rows(sweep, chosen, comparisons)}
    return Written(*paths, tables, unfinished, content)


def _comparison_rows(
    sweep: Sweep, reference: Values, comparisons: Sequence[Comparison]
) -> list[dict[str, Any]]:
    """Comparisons with a setting, ready for JSON."""
    return [
        {"setting": sweep.label(one.setting), "against": sweep.label(reference), "verdict": one.verdict}
        | {**asdict(one.ratio), "p_holm": one.adjusted_p}
        for one in comparisons
    ]
