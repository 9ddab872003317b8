"""Scans as JSON lines: our own short ones, and LaserScan messages as rosbridge writes them."""

import codecs
import json
import math
from collections import deque
from pathlib import Path

import numpy as np
import pytest

from data.make_carmen import PACKINGS
from rcnn_odom.errors import InputError
from rcnn_odom.recordings import json_lines
from rcnn_odom.recordings.formats import open_stream
from rcnn_odom.recordings.scan import Scan

GOOD = json.dumps({"ranges": [1.0]})


def scan_of(content: object) -> Scan:
    """The only scan of one line."""
    [scan] = json_lines.stream_lines([json.dumps(content)]).scans
    return scan


def laser_scan(**changes: object) -> dict[str, object]:
    """A LaserScan of five beams, as rosbridge of ROS 1 writes it."""
    message = {
        "header": {"seq": 7, "stamp": {"secs": 1700000000, "nsecs": 250000000}, "frame_id": "laser"},
        "angle_min": -0.5,
        "angle_max": 0.5,
        "angle_increment": 0.25,
        "time_increment": 0.001,
        "scan_time": 0.1,
        "range_min": 0.1,
        "range_max": 30.0,
        "ranges": [1.0, 0.05, 29.9, 30.0, None],
        "intensities": [],
    }
    return {**message, **changes}


def test_json_lines() -> None:
    lines = [
        json.dumps({"stamp": 1.5, "ranges": [1.0, None, 3.0]}),
        json.dumps({"ranges": [1, 2], "angle_min": -0.5, "angle_increment": 0.25, "more": "ignored"}),
        json.dumps({"stamp": 2, "points": [[1, 2], [3, 4, 5]]}),
    ]
    scans = list(json_lines.stream_lines(lines).scans)
    np.testing.assert_array_equal(scans[0].ranges, [1, np.nan, 3])
    assert (scans[0].stamp, scans[0].bearings, scans[1].stamp) == (1.5, None, None)
    np.testing.assert_array_equal(scans[1].bearings, [-0.5, -0.25])
    np.testing.assert_allclose(scans[2].ranges, np.sqrt([5, 25]))
    np.testing.assert_allclose(np.tan(scans[2].bearings), [2, 4 / 3])
    assert [scan.has_all_beams for scan in scans] == [True, True, False]


@pytest.mark.parametrize(
    "line",
    [
        "hello",
        "{",
        "[1, 2]",
        "null",
        "{}",
        '{"ranges": 5}',
        '{"ranges": "12"}',
        '{"ranges": ["a"]}',
        '{"ranges": [[1]]}',
        '{"points": [1, 2]}',
        '{"points": [[1]]}',
        '{"points": 3}',
        '{"ranges": [1], "stamp": "noon"}',
        '{"ranges": [1], "stamp": [1]}',
        '{"ranges": [1, 2], "angle_min": 0}',
        '{"ranges": [1, 2], "angle_min": 0, "angle_increment": null, "angle_max": null}',
        '{"ranges": [1, 2], "angle_min": "NaN", "angle_increment": 1}',
        '{"ranges": [1], "angle_min": 0, "angle_max": "wide"}',
        '{"ranges": [1], "range_max": "far"}',
        '{"ranges": [1], "range_max": [8]}',
        '{"ranges": [1], "range_max": 1' + "0" * 400 + "}",
        '{"ranges": [1], "header": {"stamp": {"secs": "noon"}}}',
        '{"ranges": [1], "header": {"stamp": {"sec": 1, "nanosec": {}}}}',
        '{"ranges": [1], "header": {"stamp": [1]}}',
        '{"ranges": ["one", 2]}',
        '{"op": "publish", "topic": "/odom", "msg": {"pose": [1, 2]}}',
        '{"ranges": [1], "angle_min": null, "angle_increment": 1}',
        "[" * 100_000,
        '{"ranges": [1' + "0" * 5000 + "]}",
        '{"ranges": [1' + "0" * 400 + "]}",
    ],
)
def test_lines_that_are_no_scan_are_skipped_and_counted(line: str, caplog: pytest.LogCaptureFixture) -> None:
    good = json.dumps({"ranges": [1.0]})
    stream = json_lines.stream_lines([good, "", line, good])
    assert len(list(stream.scans)) == 2
    assert stream.skipped == {"lines that are no scan": 1}
    assert "standard input:3: no scan (" in caplog.text


def test_a_laser_scan_is_read_fully() -> None:
    for content in (laser_scan(), {"op": "publish", "topic": "/scan", "msg": laser_scan()}):
        scan = scan_of(content)
        np.testing.assert_array_equal(scan.ranges, [1, 0, 29.9, np.inf, 0])
        np.testing.assert_allclose(scan.bearings, [-0.5, -0.25, 0, 0.25, 0.5])
        np.testing.assert_allclose(scan.times, [0, 0.001, 0.002, 0.003, 0.004])
        assert (scan.stamp, scan.frame_id) == (1700000000.25, "laser")
        assert scan.has_all_beams


def test_the_time_of_a_turn_alone_is_none_of_the_beams() -> None:
    turn = {"ranges": [1.0] * 4, "angle_min": 0.0, "angle_increment": np.pi / 2, "scan_time": 0.2}
    assert (scan_of(turn).times, scan_of(turn).turn_time) == (None, 0.2)
    for other in ({"ranges": [1.0] * 4, "scan_time": 0.2}, turn | {"scan_time": None}):
        assert scan_of(other).turn_time is None, "of which part of a turn the beams are is unknown"


@pytest.mark.parametrize(
    ("changes", "stamp"),
    [
        ({"header": {"stamp": {"sec": 12, "nanosec": 500000000}, "frame_id": "laser"}}, 12.5),
        ({"header": {"stamp": {"secs": 12}}}, 12.0),
        ({"header": {"stamp": {"sec": 12, "nanosec": None}}}, 12.0),
        ({"header": {"stamp": 12.25}}, 12.25),
        ({"header": {"stamp": {}}}, None),
        ({"header": {"stamp": None}}, None),
        ({"header": {}}, None),
        ({"header": None}, None),
        ({"header": "laser"}, None),
        ({"stamp": 3}, 3.0),
        ({"stamp": None}, 1700000000.25),
    ],
)
def test_stamps(changes: dict[str, object], stamp: float | None) -> None:
    assert scan_of(laser_scan(**changes)).stamp == stamp


@pytest.mark.parametrize(
    "word", ["null", "NaN", "Infinity", "-Infinity", '"NaN"', '"nan"', '"Infinity"', '"-Infinity"', '"inf"']
)
@pytest.mark.parametrize("angles", ["", ', "angle_min": 0, "angle_increment": 0.1'])
def test_words_for_an_absent_return(word: str, angles: str) -> None:
    [scan] = json_lines.stream_lines([f'{{"ranges": [1.5, {word}, 2]{angles}}}']).scans
    assert ((scan.ranges > 0) & np.isfinite(scan.ranges)).tolist() == [True, False, True]


@pytest.mark.parametrize("maximum", [None, math.nan, "NaN", math.inf, "Infinity", 0, -1])
def test_a_maximum_that_limits_nothing(maximum: object) -> None:
    for limits in ({"range_max": maximum}, {"range_max": maximum, "range_min": None}):
        scan = scan_of({"ranges": [1, 80], "angle_min": 0, "angle_increment": 0.1, **limits})
        np.testing.assert_array_equal(scan.ranges, [1, 80])


def test_limits_of_lines_without_angles() -> None:
    scan = scan_of({"ranges": [0.05, 1, 8, None], "range_min": 0.1, "range_max": 8})
    np.testing.assert_array_equal(scan.ranges, [0, 1, np.inf, np.nan])
    assert scan.bearings is None
    scan = scan_of({"ranges": [1, 8], "range_min": None, "range_max": 8})
    np.testing.assert_array_equal(scan.ranges, [1, np.inf])
    # nan in place of the smaller limit says nothing of the larger one.
    scan = scan_of({"ranges": [1, 8], "range_min": math.nan, "range_max": 8})
    np.testing.assert_array_equal(scan.ranges, [1, np.inf])


@pytest.mark.parametrize("increment", [{}, {"angle_increment": None}, {"angle_increment": 0}])
def test_a_spacing_from_the_last_angle(increment: dict[str, object]) -> None:
    scan = scan_of({"ranges": [1] * 5, "angle_min": 1, "angle_max": -1, **increment})
    np.testing.assert_allclose(scan.bearings, [1, 0.5, 0, -0.5, -1])
    assert scan_of({"ranges": [1], "angle_min": 1, "angle_max": 1, **increment}).bearings.tolist() == [1]


def test_a_clockwise_laser() -> None:
    scan = scan_of(laser_scan(angle_min=0.5, angle_max=-0.5, angle_increment=-0.25))
    np.testing.assert_allclose(scan.bearings, [0.5, 0.25, 0, -0.25, -0.5])


def test_other_messages_of_rosbridge_are_counted(caplog: pytest.LogCaptureFixture) -> None:
    lines = [
        {"op": "status", "level": "info", "msg": "subscribed"},
        {"op": "publish", "topic": "/front", "msg": laser_scan(ranges=[1, 2], angle_max=-0.25)},
        {"op": "publish", "topic": "/back", "msg": laser_scan(ranges=[3, 4], angle_max=-0.25)},
        {"op": "publish", "topic": "/front", "msg": laser_scan(ranges=[5, 6], angle_max=-0.25)},
        {"op": "service_response", "values": {}},
        {"op": "publish", "topic": "/front", "msg": "text"},
        {"op": None},
    ]
    stream = json_lines.stream_lines(json.dumps(line) for line in lines)
    assert [scan.ranges.tolist() for scan in stream.scans] == [[1, 2], [5, 6]]
    assert stream.skipped == {
        "other messages of rosbridge": 4,
        "messages of /back": 1,
    }
    assert not caplog.messages


def test_one_topic_of_rosbridge() -> None:
    of = {name: {"op": "publish", "topic": name} for name in ("/odom", "/front", "back", "/sick")}
    lines = [
        of["/odom"] | {"msg": {"pose": [1, 2]}},
        of["/front"] | {"msg": laser_scan(ranges=[1, 2])},
        laser_scan(ranges=[7, 8]),
        of["back"] | {"msg": laser_scan(ranges=[3, 4])},
        of["/odom"] | {"msg": {"pose": [1, 2]}},
        of["back"] | {"msg": laser_scan(ranges=[5, 6])},
        of["/sick"] | {"msg": {"ranges": 5}},
    ]
    texts = [json.dumps(line) for line in lines]
    for topic in ("back", "/back"):
        stream = json_lines.stream_lines(texts, topic=topic)
        assert [scan.ranges.tolist() for scan in stream.scans] == [[3, 4], [5, 6]]
        assert stream.skipped == {
            "messages of /odom": 2,
            "messages of /front": 1,
            "messages of /sick": 1,
            "messages without a topic": 1,
        }
    # Without a topic the first that gives a scan; what is known to be of another one is not looked into.
    stream = json_lines.stream_lines(texts)
    assert [scan.ranges.tolist() for scan in stream.scans] == [[1, 2], [7, 8]]
    assert stream.skipped == {
        "lines that are no scan": 1,
        "messages of back": 2,
        "messages of /odom": 1,
        "messages of /sick": 1,
    }
    only = (
        "messages of /front, messages of /odom, messages of /sick, messages of back, messages without a topic"
    )
    with pytest.raises(InputError, match=f"no scan of topic /side in it, only {only}; choose one of these"):
        list(json_lines.stream_lines(texts, topic="/side").scans)
    broken = r"only lines that are no scan \(line 7: ranges is 5, not a list\), messages of /front, "
    with pytest.raises(InputError, match=f"no scan of topic sick in it, {broken}"):
        list(json_lines.stream_lines(texts, topic="sick").scans)
    with pytest.raises(InputError, match="/scan in it, only messages without a topic; leave --topic out"):
        list(json_lines.stream_lines([GOOD], topic="/scan").scans)


def test_one_topic_of_a_file(tmp_path: Path) -> None:
    messages = {"/a\n": laser_scan(ranges=[1, 2]), "/b": laser_scan(ranges=[3, 4])}
    lines = [json.dumps({"op": "publish", "topic": topic, "msg": m}) for topic, m in messages.items()]
    (tmp_path / "log.jsonl").write_text("\n".join(lines))
    stream = open_stream(tmp_path / "log.jsonl", {"topic": "b"})
    assert [scan.ranges.tolist() for scan in stream.scans] == [[3, 4]]
    assert stream.skipped == {r"messages of '/a\n'": 1}


@pytest.mark.parametrize("angle", ["angle_increment", "angle_max"])
@pytest.mark.parametrize("value", [-0.25, 0, "NaN"])
def test_angles_without_a_first_one_are_not_dropped(angle: str, value: object) -> None:
    with pytest.raises(InputError, match=f"line 1: it has {angle}, but no angle_min; "):
        scan_of({"ranges": [1, 2], angle: value})
    assert scan_of({"ranges": [1, 2], angle: None}).bearings is None


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"angle_min": None}, "angle_min is null, not a number"),
        ({"angle_increment": "wide"}, 'angle_increment is "wide", not a number'),
        ({"angle_max": []}, "angle_max is a list, not a number"),
        ({"stamp": "2020-01-01"}, 'stamp is "2020-01-01", not a number'),
        ({"stamp": True}, "stamp is true, not a number"),
        ({"header": {"stamp": "2020-01-01"}}, 'header.stamp is "2020-01-01", not a number'),
        ({"header": {"stamp": {"secs": "noon"}}}, 'seconds of header.stamp is "noon", not a number'),
        ({"stamp": {"sec": 1, "nanosec": {}}}, "nanoseconds of stamp is an object, not a number"),
        ({"range_max": "x"}, 'range_max is "x", not a number'),
        ({"range_min": "x" * 1000}, f'range_min is "{"x" * 39}..., not a number'),
        ({"time_increment": False}, "time_increment is false, not a number"),
        ({"ranges": ["one"]}, 'a reading is "one", not a number'),
        ({"ranges": None}, "ranges is null, not a list"),
        ({"ranges": None, "points": [[1, "y"]]}, 'a coordinate is "y", not a number'),
        ({"points": 3}, "points is 3, not a list"),
        ({"points": [[1]]}, r"points is not a list of \[x, y\]"),
    ],
)
def test_faults_are_told_by_field_and_value(changes: dict[str, object], says: str) -> None:
    with pytest.raises(InputError, match=f"the first, line 1: {says}; ") as raised:
        scan_of(laser_scan(**changes))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("{]", "it is not JSON from character 2 on"),
        ("[1, 2]", "a list is not a JSON object"),
        ("null", "null is not a JSON object"),
        ('{"points": null}', "points is null, not a list"),
        ("{}", "it has neither a list of ranges nor a list of points"),
        ("[" * 100_000, "its numbers are too long, or its lists too deeply nested"),
    ],
)
def test_lines_of_something_else_are_told(line: str, says: str) -> None:
    with pytest.raises(InputError, match=f"the first, line 1: {says}; "):
        list(json_lines.stream_lines([line]).scans)


def test_a_single_beam_needs_no_spacing() -> None:
    np.testing.assert_array_equal(scan_of({"ranges": [1], "angle_min": 0.5}).bearings, [0.5])


def test_a_source_without_a_scan_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    stream = json_lines.stream_lines(["", *['{"ranges": 5}'] * 120], "scans")
    with pytest.raises(
        InputError, match=r"scans: none of its 120 lines is a scan; the first, line 2: ranges is 5"
    ):
        list(stream.scans)
    assert len(caplog.messages) == 3
    assert stream.skipped == {"lines that are no scan": 120}
    with pytest.raises(InputError, match="no scan in it, only other messages of rosbridge; write"):
        list(json_lines.stream_lines(['{"op": "status"}']).scans)
    assert list(json_lines.stream_lines([]).scans) == []


def test_most_lines_that_are_no_scan_are_only_counted(caplog: pytest.LogCaptureFixture) -> None:
    stream = json_lines.stream_lines([GOOD, *["rubbish"] * 50, GOOD])
    assert len(list(stream.scans)) == 2
    assert len(caplog.messages) == 3
    assert stream.skipped.total() == 50


# Files


@pytest.mark.parametrize("compress", [None, *PACKINGS])
@pytest.mark.parametrize("start", ["", "\n  \n", "\ufeff", "\ufeff\n"])
def test_a_file_is_recognised_by_its_first_bytes(tmp_path: Path, compress: str | None, start: str) -> None:
    lines = [json.dumps(laser_scan(ranges=[number + 1.0] * 5)) for number in range(4)]
    content = (start + "\r\n".join(lines)).encode()
    path = tmp_path / "scans.log"
    path.write_bytes(PACKINGS[compress](content) if compress else content)
    assert json_lines.recognises(path)
    stream = open_stream(path)
    assert (stream.name, stream.has_clock) == ("scans.log", True)
    assert [scan.ranges[0] for scan in stream.scans] == [1, 2, 3, 4]


@pytest.mark.parametrize("content", [b"", b"FLASER 1 2", b"[1, 2]", codecs.BOM_UTF8, b"\x00{"])
def test_other_files_are_not_recognised(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "file").write_bytes(content)
    assert not json_lines.recognises(tmp_path / "file")
    assert not json_lines.recognises(tmp_path)
    assert not json_lines.recognises(tmp_path / "none")


def test_a_file_of_something_else_in_json(tmp_path: Path) -> None:
    path = tmp_path / "settings.json"
    path.write_text(json.dumps({"a": {"b": 1}}, indent=2))
    with pytest.raises(
        InputError, match=r"settings\.json: none of its 5 lines is a scan; .*; write one object"
    ):
        list(open_stream(path).scans)


@pytest.mark.parametrize("compress", [None, "gz"])
@pytest.mark.parametrize(
    ("start", "between", "says"),
    [
        ("[", ",\n", "is a JSON list; write one object a line"),
        ("\ufeff [\n  ", ",\n", "is a JSON list; write one object a line"),
        ("\x1e", "\n\x1e", r"is a JSON text sequence \(RFC 7464\); write one object a line"),
    ],
)
def test_lists_and_sequences_are_refused(
    tmp_path: Path, compress: str | None, start: str, between: str, says: str
) -> None:
    content = (start + between.join([GOOD, GOOD])).encode()
    (tmp_path / "scans.json").write_bytes(PACKINGS[compress](content) if compress else content)
    with pytest.raises(InputError, match=rf"scans\.json: {says}"):
        open_stream(tmp_path / "scans.json")


def test_a_file_that_is_cut_off_gives_what_is_there(tmp_path: Path) -> None:
    numbers = np.random.default_rng(0).uniform(1, 30, (60, 200)).tolist()
    content = "\n".join(json.dumps({"ranges": ranges}) for ranges in numbers).encode()
    path = tmp_path / "scans.jsonl.gz"
    path.write_bytes(PACKINGS["gz"](content)[:-20000])
    scans: deque[Scan] = deque()
    with pytest.raises(InputError, match=r"scans\.jsonl\.gz: cannot be read to its end"):
        scans.extend(open_stream(path).scans)
    assert 0 < len(scans) < 60
