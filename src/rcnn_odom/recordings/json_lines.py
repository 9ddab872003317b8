"""Scans as JSON, a line each: a file of them, or what another program writes to ``rcnn-odom run --live``.

A line is an object with ``ranges`` (metres, null for no return) or ``points`` ([x, y] in metres, x ahead, y
to the left), and where known ``stamp`` (seconds). The other names are those of ROS's message LaserScan, as
rosbridge writes it: ``angle_min``, ``angle_increment`` or ``angle_max`` (radians, counter-clockwise from
straight ahead), ``range_min``, ``range_max``, ``time_increment``, and ``header`` with its stamp and frame.
rosbridge's own ``{"op": "publish", "topic": ..., "msg": {...}}`` around it is taken off.
"""

import json
import logging
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.recordings.broken_lines import BrokenLines
from rcnn_odom.recordings.laser_scan import from_laser_scan
from rcnn_odom.recordings.packing import read_head
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.recordings.text import MARK, lines_of, need_text

log = logging.getLogger(__name__)

JSONObject = dict[str, Any]


def recognises(path: Path) -> bool:
    """Whether a file, unpacked, begins with a JSON object."""
    if not path.is_file():
        return False
    return read_head(path).removeprefix(MARK.encode()).lstrip().startswith(b"{")


def stream(path: Path) -> ScanStream:
    """Scans of a file, plain or packed. A line that is no scan is skipped and counted.

    Args:
        path: of the file.

    Raises:
        InputError: the file cannot be read or is empty. Where ``scans`` is read: none of its lines is a scan,
            or it cannot be read to its end.
    """
    need_text(path)
    return _stream((line for _, line in lines_of(path)), path.name, is_live=False)


def stream_lines(lines: Iterable[str], name: str = "standard input") -> ScanStream:
    """Scans of a text stream as they come. A line that is no scan is skipped and counted.

    Args:
        lines: the text.
        name: of where it comes from.

    Raises:
        InputError: where ``scans`` is read to its end and none of its lines was a scan.
    """
    return _stream(lines, name, is_live=True)


def _stream(lines: Iterable[str], name: str, is_live: bool) -> ScanStream:
    skipped: Counter[str] = Counter()
    broken = BrokenLines(name, "lines that are no scan", skipped, is_live=is_live)
    return ScanStream(name=name, scans=_scans(lines, broken), skipped=skipped)


def _scans(lines: Iterable[str], broken: BrokenLines) -> Iterator[Scan]:
    skipped = broken.skipped
    first_topic, count = None, 0
    for number, line in enumerate(lines, start=1):
        line = line.lstrip(MARK)
        if not line.strip():
            continue
        try:
            message, topic = _unwrap(_parse_object(line))
            if message is None:
                skipped["other messages of rosbridge"] += 1
                continue
            scan = _to_scan(message)
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            broken.add(number, "no scan", error)
            continue
        if first_topic is not None and topic not in (None, first_topic):
            skipped["scans of another topic"] += 1
            continue
        first_topic, count = first_topic or topic, count + 1
        broken.tell()
        yield scan
    if not count and skipped:
        raise InputError(_why_no_scan(broken))


def _why_no_scan(broken: BrokenLines) -> str:
    name, skipped = broken.name, broken.skipped
    advice = 'write one object a line, as {"ranges": [1.5, null, 2.25]}'
    if not broken.count:
        return f"{name}: no scan in it, only {', '.join(sorted(skipped))}; {advice}"
    return f"{name}: none of its {skipped.total()} lines is a scan; the first, {broken.first}; {advice}"


def _parse_object(line: str) -> JSONObject:
    content = json.loads(line)
    if not isinstance(content, dict):
        raise ValueError("not a JSON object")
    return content


def _unwrap(content: JSONObject) -> tuple[JSONObject | None, str | None]:
    """The message in what rosbridge sends, None where it is something else, and the topic if there is one."""
    if "op" not in content:
        return content, None
    message, topic = content.get("msg"), content.get("topic")
    if content["op"] != "publish" or not isinstance(message, dict):
        return None, None
    return message, None if topic is None else str(topic)


def _to_scan(message: JSONObject) -> Scan:
    stamp, frame_id = _header(message)
    if "points" in message:
        points = np.array([[_number(x), _number(y)] for x, y, *_ in message["points"]]).reshape(-1, 2)
        return Scan.from_points(points, stamp, frame_id)
    if not isinstance(message.get("ranges"), list):
        raise ValueError("neither a list of ranges nor of points in it")
    ranges = np.array([_number(value) for value in message["ranges"]], dtype=np.float64)
    has_angles = "angle_min" in message
    scan = from_laser_scan(
        ranges,
        angle_min=float(message["angle_min"]) if has_angles else 0.0,
        angle_increment=_increment(message, len(ranges)) if has_angles else 0.0,
        range_min=_number(message.get("range_min"), 0.0),
        range_max=_number(message.get("range_max"), math.inf),
        time_increment=_number(message.get("time_increment"), 0.0),
        stamp=stamp,
        frame_id=frame_id,
    )
    if has_angles:
        return scan
    return replace(scan, ranges=np.where(np.isnan(ranges), ranges, scan.ranges), bearings=None)


def _increment(message: JSONObject, count: int) -> float:
    """Radians from beam to beam; where a message does not say it, from its last angle."""
    increment = message.get("angle_increment")
    if increment is None or (float(increment) == 0 and message.get("angle_max") is not None):
        if message.get("angle_max") is None:
            raise ValueError("angle_min, but neither angle_increment nor angle_max in it")
        return (float(message["angle_max"]) - float(message["angle_min"])) / max(count - 1, 1)
    return float(increment)


def _header(message: JSONObject) -> tuple[float | None, str]:
    """Seconds, None where unknown, and the laser's frame; a plain stamp stands before that of the header."""
    header = message.get("header")
    header = header if isinstance(header, dict) else {}
    frame_id = header.get("frame_id")
    stamp = message.get("stamp")
    if stamp is None:
        stamp = header.get("stamp")
    if isinstance(stamp, dict):  # as ROS 1 and ROS 2 name the two parts
        seconds, rest = stamp.get("secs", stamp.get("sec")), stamp.get("nsecs", stamp.get("nanosec"))
        stamp = None if seconds is None else float(seconds) + 1e-9 * _number(rest, 0.0)
    return None if stamp is None else float(stamp), frame_id if isinstance(frame_id, str) else ""


def _number(value: Any, absent: float = math.nan) -> float:
    """A number; also as text, as some write "Infinity"; null and nan are an absent one."""
    number = math.nan if value is None else float(value)
    return absent if math.isnan(number) else number
