"""Scans as JSON, a line each: a file of them, or what another program writes to ``rcnn-odom run --live``.

A line is an object with ``ranges`` (metres, null for no return) or ``points`` ([x, y] in metres, x ahead, y
to the left), and where known ``stamp`` (seconds). The other names are those of ROS's message LaserScan, as
rosbridge writes it: ``angle_min``, ``angle_increment`` or ``angle_max`` (radians, counter-clockwise from
straight ahead), ``range_min``, ``range_max``, ``time_increment``, ``scan_time``, and ``header`` with its
stamp and frame.
rosbridge's own ``{"op": "publish", "topic": ..., "msg": {...}}`` around it is taken off.
"""

import json
import logging
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.broken_lines import BrokenLines
from rcnn_odom.recordings.laser_scan import compare_angles, from_laser_scan
from rcnn_odom.recordings.packing import read_head
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.recordings.text import MARK, lines_of, need_text

log = logging.getLogger(__name__)

JSONObject = dict[str, Any]
LONGEST_SHOWN = 40
"""Characters of a value that is no good."""
_BEGINNING = re.compile(rb"\s*([\[\x1e]?)\s*\{")
"""Of a file of objects; before the first one what makes it a list or a sequence."""


def recognises(path: Path) -> bool:
    """Whether a file, unpacked, begins with a JSON object, or with a list or sequence of them."""
    return path.is_file() and bool(_BEGINNING.match(read_head(path).removeprefix(MARK.encode())))


def stream(path: Path, topic: str | None = None) -> ScanStream:
    """Scans of a file, plain or packed. A line that is no scan is skipped and counted.

    Args:
        path: of the file.
        topic: of rosbridge's messages, with or without its first slash; None: the first that gives a scan.

    Raises:
        InputError: the file cannot be read, is empty or a JSON list. Where ``scans`` is read: none of its
            lines is a scan of the topic, or it cannot be read to its end.
    """
    begins = _BEGINNING.match(need_text(path))
    if begins and begins[1]:
        kind = "JSON list" if begins[1] == b"[" else "JSON text sequence (RFC 7464)"
        raise InputError(f"{path}: is a {kind}; write one object a line, and nothing around them")
    return _stream((line for _, line in lines_of(path)), path.name, topic, is_live=False)


def stream_lines(lines: Iterable[str], name: str = "standard input", topic: str | None = None) -> ScanStream:
    """Scans of a text stream as they come. A line that is no scan is skipped and counted.

    Args:
        lines: the text.
        name: of where it comes from.
        topic: as of :func:`stream`.

    Raises:
        InputError: where ``scans`` is read to its end and none of its lines was a scan of the topic.
    """
    return _stream(lines, name, topic, is_live=True)


def _stream(lines: Iterable[str], name: str, topic: str | None, is_live: bool) -> ScanStream:
    skipped: Counter[str] = Counter()
    broken = BrokenLines(name, "lines that are no scan", skipped, is_live=is_live)
    return ScanStream(name=name, scans=_scans(lines, broken, topic), skipped=skipped)


def _scans(lines: Iterable[str], broken: BrokenLines, wanted: str | None) -> Iterator[Scan]:
    skipped = broken.skipped
    chosen, others, count, contradiction = wanted, set[str](), 0, ""
    for number, line in enumerate(lines, start=1):
        line = line.lstrip(MARK)
        if not line.strip():
            continue
        try:
            message, topic = _unwrap(_parse_object(line))
            if message is None:
                skipped["other messages of rosbridge"] += 1
                continue
            if _is_other(topic, chosen, wanted):
                others.add(_show_topic(topic))
                skipped[f"messages {_show_topic(topic)}"] += 1
                continue
            scan = _to_scan(message)
        except ValueError as error:
            broken.add(number, "no scan", error)
            continue
        chosen, count = topic if chosen is None else chosen, count + 1
        broken.tell()
        contradiction = contradiction or _tell_contradiction(broken.name, message, len(scan.ranges))
        yield scan
    if not count and skipped:
        raise InputError(_why_no_scan(broken, wanted, others))


def _tell_contradiction(name: str, message: JSONObject, count: int) -> str:
    """What a message's angles say against each other, told; empty where they agree."""
    angles = None if message.get("points") is not None else _angles(message)
    contradiction = compare_angles(*angles, count) if angles else ""
    if contradiction:
        log.warning("%s: %s", name, contradiction)
    return contradiction


def _is_other(topic: str | None, chosen: str | None, wanted: str | None) -> bool:
    """Whether a message is of another topic than the chosen one; without a topic only if one is wanted."""
    if topic is None or chosen is None:
        return wanted is not None
    return topic.strip("/") != chosen.strip("/")


def _show_topic(topic: str | None) -> str:
    if topic is None:
        return "without a topic"
    return f"of {topic if topic.isprintable() else ascii(topic)}"


def _why_no_scan(broken: BrokenLines, wanted: str | None, others: set[str]) -> str:
    name, skipped = broken.name, broken.skipped
    advice = 'write one object a line, as {"ranges": [1.5, null, 2.25]}'
    if broken.count and not others:
        return f"{name}: none of its {skipped.total()} lines is a scan; the first, {broken.first}; {advice}"
    of_topic = "" if wanted is None else f" of topic {wanted}"
    if others:
        has_topics = others != {_show_topic(None)}
        advice = "choose one of these with --topic" if has_topics else "leave --topic out"
    kinds = [f"{kind} ({broken.first})" if kind == broken.what else kind for kind in sorted(skipped)]
    return f"{name}: no scan{of_topic} in it, only {', '.join(kinds)}; {advice}"


def _parse_object(line: str) -> JSONObject:
    try:
        content = json.loads(line)
    except json.JSONDecodeError as error:
        raise ValueError(f"no JSON from its character {error.pos + 1} on") from error
    except (ValueError, RecursionError) as error:
        raise ValueError("no JSON with numbers of a usual length and lists of a usual depth") from error
    if not isinstance(content, dict):
        raise ValueError(f"{_show(content)} is no JSON object")
    return content


def _unwrap(content: JSONObject) -> tuple[JSONObject | None, str | None]:
    """The message in what rosbridge sends, None where it is something else, and the topic if there is one."""
    if "op" not in content:
        return content, None
    message, topic = content.get("msg"), content.get("topic")
    if content["op"] != "publish" or not isinstance(message, dict):
        return None, None
    return message, topic if isinstance(topic, str) else None


def _to_scan(message: JSONObject) -> Scan:
    stamp, frame_id = _header(message)
    if message.get("points") is not None:
        return Scan.from_points(_points(message["points"]), stamp, frame_id)
    if not isinstance(message.get("ranges"), list):
        name = "ranges" if "ranges" in message else "points"
        if name in message:
            raise ValueError(f"{name} is {_show(message[name])}, no list")
        raise ValueError("neither a list of ranges nor of points in it")
    ranges = np.array(
        [_number("a reading", value, math.nan) for value in message["ranges"]], dtype=np.float64
    )
    angles = _angles(message)
    angle_min, increment, angle_max = angles or (0.0, 1.0, math.nan)
    # Without angles nobody knows for which part of a turn the beams stand.
    scan_time = _number("scan_time", message.get("scan_time"), 0.0) if angles else 0.0
    scan = from_laser_scan(
        ranges,
        angle_min=angle_min,
        angle_increment=increment,
        angle_max=angle_max,
        range_min=_number("range_min", message.get("range_min"), 0.0),
        range_max=_number("range_max", message.get("range_max"), math.inf),
        time_increment=_number("time_increment", message.get("time_increment"), 0.0),
        scan_time=scan_time,
        stamp=stamp,
        frame_id=frame_id,
    )
    if "angle_min" in message:
        return scan
    return replace(scan, ranges=np.where(np.isnan(ranges), ranges, scan.ranges), bearings=None)


def _points(values: Any) -> FloatArray:
    """(P, 2) metres; nan for null."""
    if not isinstance(values, list):
        raise ValueError(f"points is {_show(values)}, no list")
    if not all(isinstance(point, list) and len(point) >= 2 for point in values):
        raise ValueError("points is no list of [x, y]")
    numbers = [_number("a coordinate", value, math.nan) for point in values for value in point[:2]]
    return np.array(numbers, dtype=np.float64).reshape(-1, 2)


def _angles(message: JSONObject) -> tuple[float, float, float] | None:
    """Radians: of the first beam, from beam to beam, of the last; nan where unknown. None without angles."""
    further = {name: message.get(name) for name in ("angle_increment", "angle_max")}
    if "angle_min" in message:
        increment, last = (_number(name, value, math.nan) for name, value in further.items())
        return _number("angle_min", message["angle_min"]), increment, last
    given = next((name for name, value in further.items() if value is not None), None)
    if given:
        raise ValueError(f"{given}, but no angle_min in it")
    return None


def _header(message: JSONObject) -> tuple[float | None, str]:
    """Seconds, None where unknown, and the laser's frame; a plain stamp stands before that of the header."""
    header = message.get("header")
    header = header if isinstance(header, dict) else {}
    frame_id = header.get("frame_id")
    name, stamp = "stamp", message.get("stamp")
    if stamp is None:
        name, stamp = "header.stamp", header.get("stamp")
    if isinstance(stamp, dict):  # as ROS 1 and ROS 2 name the two parts
        seconds, rest = stamp.get("secs", stamp.get("sec")), stamp.get("nsecs", stamp.get("nanosec"))
        rest = 1e-9 * _number(f"nanoseconds of {name}", rest, 0.0)
        stamp = None if seconds is None else _number(f"seconds of {name}", seconds) + rest
    return None if stamp is None else _number(name, stamp), frame_id if isinstance(frame_id, str) else ""


def _number(name: str, value: Any, absent: float | None = None) -> float:
    """A number; also as text, as some write "Infinity". Null and nan stand for one that may be absent."""
    if value is None and absent is not None:
        return absent
    try:
        number = float(value) if type(value) in (int, float, str) else None  # true is no number
    except (ValueError, OverflowError):
        number = None
    if number is None:
        raise ValueError(f"{name} is {_show(value)}, no number")
    return absent if absent is not None and math.isnan(number) else number


def _show(value: Any) -> str:
    """A value as it stands in JSON, only the beginning of a long one."""
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "an object"
    shown = json.dumps(value)
    return shown if len(shown) <= LONGEST_SHOWN else f"{shown[:LONGEST_SHOWN]}..."
