"""Reads scans as JSON lines, one scan a line, from a file or live from another program (``run --live``).

A line is an object with ``ranges`` (metres, null for no return) or ``points`` ([x, y] in metres, x ahead, y
to the left), and optionally ``stamp`` (seconds). All other fields are optional. They are those of ROS's
message LaserScan, as rosbridge writes it: ``angle_min``, ``angle_increment`` or ``angle_max`` (radians,
counter-clockwise from straight ahead), ``range_min``, ``range_max``, ``time_increment``, ``scan_time``, and
``header`` with stamp and frame.
rosbridge's envelope ``{"op": "publish", "topic": ..., "msg": {...}}`` is removed.
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
"""Characters that a message shows of a faulty value."""
_BEGINNING = re.compile(rb"\s*([\[\x1e]?)\s*\{")
"""First bytes of a file of objects; the group is the sign of a JSON list or of a JSON text sequence."""


def recognises(path: Path) -> bool:
    """Whether a file, after decompression, begins with a JSON object, or with a list or sequence of them."""
    return path.is_file() and bool(_BEGINNING.match(read_head(path).removeprefix(MARK.encode())))


def stream(path: Path, topic: str | None = None) -> ScanStream:
    """Stream the scans of a file, plain or compressed. A line that is not a scan is skipped and counted.

    Args:
        path: path of the file.
        topic: topic of rosbridge's messages, with or without its first slash; None: the first topic with a
            scan.

    Raises:
        InputError: the file cannot be read, is empty, or is a JSON list or JSON text sequence. While
            ``scans`` is read: no line is a scan of the topic, or the file cannot be read to its end.
    """
    begins = _BEGINNING.match(need_text(path))
    if begins and begins[1]:
        kind = "JSON list" if begins[1] == b"[" else "JSON text sequence (RFC 7464)"
        raise InputError(f"{path}: is a {kind}; write one object a line, with nothing around them")
    return _make_stream((line for _, line in lines_of(path)), path.name, topic, is_live=False)


def stream_lines(lines: Iterable[str], name: str = "standard input", topic: str | None = None) -> ScanStream:
    """Stream the scans of lines as they arrive. A line that is not a scan is skipped and counted.

    Args:
        lines: lines of text.
        name: name of the source, for messages.
        topic: as for :func:`stream`.

    Raises:
        InputError: ``scans`` has been read to its end, and no line was a scan of the topic.

    >>> [scan.ranges.tolist() for scan in stream_lines(['{"ranges": [1.5, 2.0]}']).scans]
    [[1.5, 2.0]]
    """
    return _make_stream(lines, name, topic, is_live=True)


def _make_stream(lines: Iterable[str], name: str, topic: str | None, is_live: bool) -> ScanStream:
    skipped: Counter[str] = Counter()
    broken = BrokenLines(name, "lines that are no scan", skipped, is_live=is_live)
    return ScanStream(name=name, scans=_read_scans(lines, broken, topic), skipped=skipped)


def _read_scans(lines: Iterable[str], broken: BrokenLines, wanted: str | None) -> Iterator[Scan]:
    skipped = broken.skipped
    chosen, others, count, contradiction = wanted, set[str](), 0, ""
    for number, line in enumerate(lines, start=1):
        line = line.lstrip(MARK)
        if not line.strip():
            continue
        try:
            message, topic = _unwrap_message(_parse_object(line))
            if message is None:
                skipped["other messages of rosbridge"] += 1
                continue
            if _is_other(topic, chosen, wanted):
                others.add(_show_topic(topic))
                skipped[f"messages {_show_topic(topic)}"] += 1
                continue
            scan = _parse_scan(message)
        except ValueError as error:
            broken.add(number, "no scan", error)
            continue
        chosen, count = topic if chosen is None else chosen, count + 1
        broken.log_warnings()
        contradiction = contradiction or _warn_of_contradiction(broken.name, message, len(scan.ranges))
        yield scan
    if not count and skipped:
        raise InputError(_why_no_scan(broken, wanted, others))


def _warn_of_contradiction(name: str, message: JSONObject, count: int) -> str:
    """Log a warning if a message's angles contradict each other, and return it; empty if they do not."""
    angles = None if message.get("points") is not None else _parse_angles(message)
    contradiction = compare_angles(*angles, count) if angles else ""
    if contradiction:
        log.warning("%s: %s", name, contradiction)
    return contradiction


def _is_other(topic: str | None, chosen: str | None, wanted: str | None) -> bool:
    """Whether a message must be skipped because of its topic.

    Args:
        topic: topic of the message; None: it has none.
        chosen: topic of the scans so far, or the one wanted; None: not known yet.
        wanted: topic that the user wants; None: any.
    """
    if topic is None or chosen is None:
        return wanted is not None
    return topic.strip("/") != chosen.strip("/")


def _show_topic(topic: str | None) -> str:
    if topic is None:
        return "without a topic"
    return f"of {topic if topic.isprintable() else ascii(topic)}"


def _why_no_scan(broken: BrokenLines, wanted: str | None, others: set[str]) -> str:
    """The error message if no line gave a scan; ``others`` are the other topics that were found."""
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
        raise ValueError(f"it is not JSON from character {error.pos + 1} on") from error
    except (ValueError, RecursionError) as error:
        raise ValueError("its numbers are too long, or its lists too deeply nested") from error
    if not isinstance(content, dict):
        raise ValueError(f"{_shorten(content)} is not a JSON object")
    return content


def _unwrap_message(content: JSONObject) -> tuple[JSONObject | None, str | None]:
    """Take a message out of rosbridge's envelope, if it has one.

    Returns:
        The message, None if rosbridge sent something else than a message; and its topic, None if it has none.
    """
    if "op" not in content:
        return content, None
    message, topic = content.get("msg"), content.get("topic")
    if content["op"] != "publish" or not isinstance(message, dict):
        return None, None
    return message, topic if isinstance(topic, str) else None


def _parse_scan(message: JSONObject) -> Scan:
    stamp, frame_id = _parse_header(message)
    if message.get("points") is not None:
        return Scan.from_points(_parse_points(message["points"]), stamp, frame_id)
    if not isinstance(message.get("ranges"), list):
        name = "ranges" if "ranges" in message else "points"
        if name in message:
            raise ValueError(f"{name} is {_shorten(message[name])}, not a list")
        raise ValueError("it has neither a list of ranges nor a list of points")
    ranges = np.array(
        [_parse_number("a reading", value, math.nan) for value in message["ranges"]], dtype=np.float64
    )
    angles = _parse_angles(message)
    angle_min, increment, angle_max = angles or (0.0, 1.0, math.nan)
    # Without angles, it is unknown which part of a turn the beams cover.
    scan_time = _parse_number("scan_time", message.get("scan_time"), 0.0) if angles else 0.0
    scan = from_laser_scan(
        ranges,
        angle_min=angle_min,
        angle_increment=increment,
        angle_max=angle_max,
        range_min=_parse_number("range_min", message.get("range_min"), 0.0),
        range_max=_parse_number("range_max", message.get("range_max"), math.inf),
        time_increment=_parse_number("time_increment", message.get("time_increment"), 0.0),
        scan_time=scan_time,
        stamp=stamp,
        frame_id=frame_id,
    )
    if "angle_min" in message:
        return scan
    return replace(scan, ranges=np.where(np.isnan(ranges), ranges, scan.ranges), bearings=None)


def _parse_points(values: Any) -> FloatArray:
    """Points (P, 2) in metres; nan for null."""
    if not isinstance(values, list):
        raise ValueError(f"points is {_shorten(values)}, not a list")
    if not all(isinstance(point, list) and len(point) >= 2 for point in values):
        raise ValueError("points is not a list of [x, y]")
    numbers = [_parse_number("a coordinate", value, math.nan) for point in values for value in point[:2]]
    return np.array(numbers, dtype=np.float64).reshape(-1, 2)


def _parse_angles(message: JSONObject) -> tuple[float, float, float] | None:
    """Angle of the first beam, angle from beam to beam, and angle of the last beam, in radians.

    An unknown one is nan. None if the message has no angles.
    """
    further = {name: message.get(name) for name in ("angle_increment", "angle_max")}
    if "angle_min" in message:
        increment, last = (_parse_number(name, value, math.nan) for name, value in further.items())
        return _parse_number("angle_min", message["angle_min"]), increment, last
    given = next((name for name, value in further.items() if value is not None), None)
    if given:
        raise ValueError(f"it has {given}, but no angle_min")
    return None


def _parse_header(message: JSONObject) -> tuple[float | None, str]:
    """Stamp in seconds, None if unknown, and the laser's frame; a field ``stamp`` precedes the header's."""
    header = message.get("header")
    header = header if isinstance(header, dict) else {}
    frame_id = header.get("frame_id")
    name, stamp = "stamp", message.get("stamp")
    if stamp is None:
        name, stamp = "header.stamp", header.get("stamp")
    if isinstance(stamp, dict):  # the two parts of a stamp have other names in ROS 1 than in ROS 2
        seconds, rest = stamp.get("secs", stamp.get("sec")), stamp.get("nsecs", stamp.get("nanosec"))
        rest = 1e-9 * _parse_number(f"nanoseconds of {name}", rest, 0.0)
        stamp = None if seconds is None else _parse_number(f"seconds of {name}", seconds) + rest
    return None if stamp is None else _parse_number(name, stamp), frame_id if isinstance(
        frame_id, str
    ) else ""


def _parse_number(name: str, value: Any, absent: float | None = None) -> float:
    """Convert a value to a number; text is allowed, because some programs write "Infinity".

    Args:
        name: name of the value, for the error.
        value: the value.
        absent: what null and nan mean; None: the number must be given.
    """
    if value is None and absent is not None:
        return absent
    try:
        number = float(value) if type(value) in (int, float, str) else None  # bool is not allowed
    except (ValueError, OverflowError):
        number = None
    if number is None:
        raise ValueError(f"{name} is {_shorten(value)}, not a number")
    return absent if absent is not None and math.isnan(number) else number


def _shorten(value: Any) -> str:
    """A value as JSON, shortened if it is long."""
    if isinstance(value, list | dict):
        return "a list" if isinstance(value, list) else "an object"
    shown = json.dumps(value)
    return shown if len(shown) <= LONGEST_SHOWN else f"{shown[:LONGEST_SHOWN]}..."
