"""Writes the report of a sweep from the folders of its runs."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.sweep_report.comparisons import (
    Comparison,
    compare_settings,
    difference_section,
    drifts_by_setting,
    reference_setting,
    result_text,
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
    opening_section,
    origin_section,
    paper_section,
    runs_section,
)


@dataclass(frozen=True)
class WrittenReport:
    """The files and contents of a report.

    Attributes:
        markdown: path of ``report.md``.
        html: path of ``report.html``.
        table: tables of the drift and of the other metrics as text for a terminal.
        unfinished: number of runs that are not finished, including missing ones.
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
) -> WrittenReport:
    """Writes ``report.md``, ``report.html`` and ``report_figures`` into a folder of runs.

    Args:
        directory: the folder of a sweep, or any folder that contains runs.
        only: texts ``KEY=VALUE``; only runs with these values are in the report.
        reference: texts ``KEY=VALUE`` that match the one setting to compare_settings the others with.
        expected: names of the run folders that the last command of the folder should have made; None if they
            are not known.

    Raises:
        InputError: there is no such folder, it contains no run or no finished run, the runs have different
            data, no single setting matches the reference, or a file of the same name is not a report.
    """
    sweep = read_sweep(directory, only, expected)
    if not sweep.finished:
        first = next((run for run in sweep.runs if run.problem), None)
        why = f"; {first.name}: {first.problem}" if first else ""
        raise InputError(f"{directory}: none of its {len(sweep.runs)} runs is finished{why}")
    chosen, why = reference_setting(sweep, reference)
    drifts = drifts_by_setting(sweep)
    comparisons = compare_settings(drifts, chosen)
    figures = {"drift": png(drift_figure({sweep.label(key): runs for key, runs in drifts.items()}))}
    table = runs_table(sweep)
    parts = [
        opening_section(sweep, datetime.now()),
        result_text(sweep, chosen, comparisons),
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
    return WrittenReport(*paths, tables, unfinished, content)


def _comparison_rows(
    sweep: Sweep, reference: Values, comparisons: Sequence[Comparison]
) -> list[dict[str, Any]]:
    """The comparisons with the reference, ready for JSON."""
    return [
        {"setting": sweep.label(each.setting), "against": sweep.label(reference), "verdict": each.verdict}
        | {**asdict(each.ratio), "p_holm": each.adjusted_p}
        for each in comparisons
    ]
