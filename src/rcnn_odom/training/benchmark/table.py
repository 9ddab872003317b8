"""The table of a benchmark: a row for each method, a column for each set."""

from collections.abc import Callable, Mapping
from typing import Any

from rcnn_odom.evaluation.metrics import Report
from rcnn_odom.evaluation.scores import aligned, percent

Rows = Mapping[str, Mapping[str, Report]]
"""Scores by the name of the method and that of the set."""
Cells = list[list[str]]

NONE = "-"
"""Of a method that does not know the set's laser, or of a set without such a score."""


def _times(scores: Report) -> str:
    return f"{scores['median_ms']:.2f} / {scores['p99_ms']:.2f}"


def _failures(scores: Report) -> str:
    errors = f" ({scores['errors']} errors)" if scores["errors"] else ""
    return f"{scores['failures']}{errors}"


def _path(scores: Report) -> str:
    ratio = scores["path_ratio"]
    return NONE if ratio is None else f"{ratio:.3f}"


def _stretch(scores: Report) -> str:
    if "stretch" not in scores:
        return NONE
    errors = scores["stretch"]
    distance, heading = errors["smoothed_distance_mae_m"], errors["heading_mae_deg"]
    return f"{distance:.4f} m, {heading:.4f} deg, {percent(errors['end_ratio'])} %"


def _relations(scores: Report) -> str:
    errors = scores.get("relations", {}).get("sequential", {})
    if not errors.get("count"):
        return NONE
    return f"{100 * errors['translation_mean_m']:.1f} cm, {errors['rotation_mean_deg']:.2f} deg"


PARTS: dict[str, Callable[[Report], str]] = {
    "drift, %": lambda scores: percent(scores["drift"]),
    "ms a scan, median / 99th percentile": _times,
    "failed steps": _failures,
    "path length over the true one": _path,
    "stretch: mean abs distance (smoothed truth) and heading, end point": _stretch,
    "relations in sequence: mean translation and rotation": _relations,
}
"""What is shown of each method and set, one part of the table after the other."""


def table_parts(rows: Rows) -> dict[str, Cells]:
    """The table in parts by their titles, each with a header as its first row, and without empty columns."""
    sets = list(dict.fromkeys(name for scores in rows.values() for name in scores))
    parts = {}
    for title, show in PARTS.items():
        columns = {
            name: [show(scores[name]) if name in scores else NONE for scores in rows.values()]
            for name in sets
        }
        columns = {name: cells for name, cells in columns.items() if set(cells) != {NONE}}
        if columns:
            body = [list(row) for row in zip(rows, *columns.values(), strict=True)]
            parts[title] = [["", *columns], *body]
    return parts


def as_text(rows: Rows) -> str:
    """The table for a terminal."""
    return "\n\n".join(
        aligned([[title, *header[1:]], *body]) for title, (header, *body) in table_parts(rows).items()
    )


def as_markdown(rows: Rows, about: Mapping[str, Any]) -> str:
    """The table as a page of Markdown.

    Args:
        rows: as above.
        about: what it was measured with, by name.
    """
    lines = ["# Methods beside each other", ""]
    lines += [f"- {name}: {value}" for name, value in about.items()]
    for title, (header, *body) in table_parts(rows).items():
        lines += ["", f"## {title[0].upper()}{title[1:]}", ""]
        lines += [_line(header), _line(["---", *["---:"] * (len(header) - 1)]), *map(_line, body)]
    return "\n".join(lines) + "\n"


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"
