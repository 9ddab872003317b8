"""A run in three lines for people: the path, the speed, and what was wrong where."""

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rcnn_odom.geometry import wrap_angle

CAUSES_NAMED, STRETCHES_NAMED = 3, 2
"""Maximum number of causes in the line, and of stretches for each; it only says whether there are more."""


def three_lines(summary: Mapping[str, Any]) -> dict[str, str]:
    """Describes a run in three lines, by the name of the line: path, speed and trouble.

    Args:
        summary: as :func:`rcnn_odom.deployment.run.run` returns it.
    """
    return {
        "path": _describe_path(summary),
        "speed": _describe_speed(summary),
        "trouble": _describe_trouble(summary),
    }


def format_lines(summary: Mapping[str, Any], page: Path | None = None) -> str:
    """Formats the three lines for a terminal.

    Args:
        summary: of the run.
        page: the report of the run, to be named in the last line; None if there is none.
    """
    lines = three_lines(summary)
    if page:
        lines["trouble"] += f"; look at {shlex.quote(str(page))}"
    return "\n".join(f"{name:<9}{line}" for name, line in lines.items())


def _describe_path(summary: Mapping[str, Any]) -> str:
    end, driver = summary["end"], " by the robot" if summary["laser_pose"] else ""
    x, y = end["x"], end["y"]
    turn = round(math.degrees(float(wrap_angle(end["heading"]))))
    degrees = "degree" if abs(turn) == 1 else "degrees"
    turned = f"turned {abs(turn)} {degrees} {'left' if turn > 0 else 'right'}" if turn else "not turned"
    return (
        f"{summary['scans']} scans, {summary['path_m']:.1f} m driven{driver}; ended "
        f"{math.hypot(x, y):.1f} m from the start ({abs(x):.1f} m {'ahead' if x >= 0 else 'behind'}, "
        f"{abs(y):.1f} m {'left' if y >= 0 else 'right'}), {turned}"
    )


def _describe_speed(summary: Mapping[str, Any]) -> str:
    times, speed = summary["latency"], summary["speed"]
    computed = f"{_format_number(times['median_ms'])} ms a scan"
    if not speed:
        why = "have no time stamps" if summary["recording_s"] is None else "all have the same time stamp"
        return f"{computed}; the scans {why}, so the speed is unknown"
    ratio = 1e3 * summary["recording_s"] / (times["median_ms"] * summary["scans"])
    return (
        f"{computed}, {_format_number(ratio)} times as fast as the recording (without reading it); the robot "
        f"drove {speed['mean_m_s']:.2f} m/s on average, {speed['top_m_s']:.2f} m/s at most"
    )


def _format_number(value: float) -> str:
    """Rounds to two significant digits, without an exponent such as 1e+02."""
    return f"{float(f'{value:.2g}'):g}"


def _describe_trouble(summary: Mapping[str, Any]) -> str:
    marked = summary["marked"]
    parts = [
        f"{cause}: {_count_scans(sum(one['scans'] for one in stretches))}, {name_stretches(stretches)}"
        for cause, stretches in list(marked.items())[:CAUSES_NAMED]
    ]
    if len(marked) > CAUSES_NAMED:
        parts.append(f"{len(marked) - CAUSES_NAMED} more causes")
    if summary["skipped"]:
        skipped = ", ".join(f"{count} {kind}" for kind, count in summary["skipped"].items())
        parts.append(f"skipped: {skipped}")
    if stopped := summary.get("stopped"):
        parts.append(f"stopped: {stopped}")
    return "; ".join(parts) or "none"


def _count_scans(count: int) -> str:
    return f"{count} scan{'s' if count != 1 else ''}"


def name_stretches(stretches: Sequence[Mapping[str, Any]], most: int = STRETCHES_NAMED) -> str:
    """Says where the first stretches lie, at most ``most`` of them.

    >>> name_stretches([{"from_s": 31.2, "to_s": 32.4}, {"from_s": 40.0, "to_s": 40.0}])
    'from 31.2 s to 32.4 s, at 40.0 s'
    """
    named = ", ".join(map(_name_stretch, stretches[:most]))
    return f"{named}, ..." if len(stretches) > most else named


def _name_stretch(one: Mapping[str, Any]) -> str:
    if one["from_s"] is None:
        first, last = one["first_scan"], one["last_scan"]
        return f"scan {first}" if first == last else f"scans {first} to {last}"
    start, end = f"{one['from_s']:.1f}", f"{one['to_s']:.1f}"
    return f"at {start} s" if start == end else f"from {start} s to {end} s"
