"""Formats the table of a benchmark: a row for each method, a column for each set."""

from collections.abc import Callable, Mapping
from typing import Any

from rcnn_odom.evaluation.metrics import Report
from rcnn_odom.evaluation.scores import aligned, percent

Rows = Mapping[str, Mapping[str, Report]]
"""Scores by the name of the method and that of the set."""
Cells = list[list[str]]

NO_SCORE = "-"
"""Shown if a method was not measured on a set, or if a set does not have this score."""


def _times(scores: Report) -> str:
    return f"{scores['median_ms']:.2f} / {scores['p99_ms']:.2f}"


def _failures(scores: Report) -> str:
    errors = f" ({scores['errors']} errors)" if scores["errors"] else ""
    return f"{scores['failures']}{errors}"


def _path(scores: Report) -> str:
    ratio = scores["path_ratio"]
    return NO_SCORE if ratio is None else f"{ratio:.3f}"


def _stretch(scores: Report) -> str:
    if "stretch" not in scores:
        return NO_SCORE
    errors = scores["stretch"]
    distance, heading = errors["smoothed_distance_mae_m"], errors["heading_mae_deg"]
    return f"{distance:.4f} m, {heading:.4f} deg, {percent(errors['end_ratio'])} %"


def _relations(scores: Report) -> str:
    errors = scores.get("relations", {}).get("sequential", {})
    if not errors.get("count"):
        return NO_SCORE
    return f"{100 * errors['translation_mean_m']:.1f} cm, {errors['rotation_mean_deg']:.2f} deg"


PARTS: dict[str, Callable[[Report], str]] = {
    "drift, %": lambda scores: percent(scores["drift"]),
    "ms a scan, median / 99th percentile": _times,
    "failed steps": _failures,
    "path length over the true one": _path,
    "stretch: mean abs distance (smoothed truth) and heading, end point": _stretch,
    "relations in sequence: mean translation and rotation": _relations,
}
"""The parts of the table: title, and function that formats the cell of a method and a set."""


def table_parts(rows: Rows) -> dict[str, Cells]:
    """The parts of the table by title, each with a header as first row; empty columns are left out."""
    sets = list(dict.fromkeys(name for scores in rows.values() for name in scores))
    parts = {}
    for title, show in PARTS.items():
        columns = {
            name: [show(scores[name]) if name in scores else NO_SCORE for scores in rows.values()]
            for name in sets
        }
        columns = {name: cells for name, cells in columns.items() if set(cells) != {NO_SCORE}}
        if columns:
            body = [list(row) for row in zip(rows, *columns.values(), strict=True)]
            parts[title] = [["", *columns], *body]
    return parts


def as_text(rows: Rows) -> str:
    """Formats the table for a terminal."""
    return "\n\n".join(
        aligned([[title, *header[1:]], *body]) for title, (header, *body) in table_parts(rows).items()
    )


def as_markdown(rows: Rows, about: Mapping[str, Any]) -> str:
    """Formats the table as a page of Markdown.

    Args:
        rows: scores by method and set.
        about: properties of the machine by name.
    """
    lines = ["# Comparison of methods", ""]
    lines += [f"- {name}: {value}" for name, value in about.items()]
    for title, (header, *body) in table_parts(rows).items():
        lines += ["", f"## {title[0].upper()}{title[1:]}", ""]
        lines += [_line(header), _line(["---", *["---:"] * (len(header) - 1)]), *map(_line, body)]
    return "\n".join(lines) + "\n"


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"
