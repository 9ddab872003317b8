"""Scans as JSON, a line each: what another program writes to ``rcnn-odom run --live``.

A line is an object with ``ranges`` (metres, null for no return) or ``points`` ([x, y] in metres, x ahead, y
to the left), and where known ``stamp`` (seconds), ``angle_min`` and ``angle_increment`` (radians,
counter-clockwise from straight ahead) of the ranges.
"""

import json
import logging
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

log = logging.getLogger(__name__)


def stream(lines: Iterable[str], name: str = "standard input") -> ScanStream:
    """Scans of a text stream as they come. A line that is no scan is told, skipped and counted.

    Args:
        lines: the text.
        name: of where it comes from.
    """
    skipped: Counter[str] = Counter()
    return ScanStream(name=name, scans=_scans(lines, name, skipped), skipped=skipped)


def _scans(lines: Iterable[str], name: str, skipped: Counter[str]) -> Iterator[Scan]:
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            yield parse(line)
        except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
            skipped["lines that are no scan"] += 1
            log.warning("%s:%d: no scan (%s), skipped", name, number, error)


def parse(line: str) -> Scan:
    """The scan of one line.

    Raises:
        ValueError, TypeError, KeyError: it is none; OverflowError, RecursionError: digits or brackets
            without end.
    """
    content = json.loads(line)
    if not isinstance(content, dict):
        raise ValueError("not a JSON object")
    stamp = None if content.get("stamp") is None else float(content["stamp"])
    if "points" in content:
        points = np.array([[_number(x), _number(y)] for x, y, *_ in content["points"]]).reshape(-1, 2)
        return Scan.from_points(points, stamp)
    if not isinstance(content.get("ranges"), list):
        raise ValueError("neither a list of ranges nor of points in it")
    ranges = np.array([_number(value) for value in content["ranges"]])
    bearings = None
    if "angle_min" in content:
        with np.errstate(over="ignore", invalid="ignore"):  # encoders leave out bearings that are no numbers
            steps = float(content["angle_increment"]) * np.arange(len(ranges), dtype=np.float64)
            bearings = float(content["angle_min"]) + steps
    return Scan(ranges, bearings, stamp=stamp)


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)
