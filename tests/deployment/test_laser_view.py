"""A network for lasers that turn all round, with a laser that does not: the run says so in one line."""

import json
import logging

import numpy as np
import pytest

from data.make_carmen import make_carmen
from outputs import Ahead
from rcnn_odom.cli import main
from rcnn_odom.deployment.laser_view import LaserViewCheck, find_shipped_network
from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.deployment.run import run
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.streaming import Description, Warping
from rcnn_odom.recordings.beams import Beams
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

WARPING = Warping(None, 2, 0.1, 0.1, 0.0, 0.0)
HALF, WHOLE = np.arange(-90.0, 90.0), np.arange(-180.0, 180.0)
SICK = Beams(-90.0, 179.0, 1.0)
WORDS = (
    "has a sensor that turns all round, but the beams of this laser lie from -90 to 89 degrees, one every 1"
)


class Network(Ahead):
    """A stand-in for a tracker with a network for a laser that turns all round."""

    description = Description(Sensor(), warping=WARPING)


def scan_of(degrees, distance=5.0):
    return Scan(np.full(len(degrees), distance), np.deg2rad(degrees))


def warnings_of(tracker, views, beams=None):
    check = LaserViewCheck(Odometer(tracker), "mine", beams)
    return [check.add(scan_of(view)) for view in views]


def test_it_is_told_once_after_five_scans_in_a_row():
    slow_start = [HALF[:60], HALF[:90], WHOLE, [], *[HALF] * 10]
    found = warnings_of(Network(), slow_start)
    assert [number for number, warning in enumerate(found) if warning] == [8]
    assert found[8] == (
        f"the network of --model mine {WORDS}; --network half_circle was trained on lasers that see a part "
        "of the circle"
    )


@pytest.mark.parametrize(
    ("description", "views"),
    [
        (Network.description, [WHOLE] * 5 + [HALF] * 9),
        (Description(Sensor(0.25, 270.0, 40.0), warping=WARPING), [HALF] * 9),
        (Description(Sensor()), [HALF] * 9),  # it needs all beams, and refuses these
        (None, [HALF] * 9),
    ],
)
def test_nothing_is_told_of_a_laser_as_in_training(description, views):
    tracker = Network()
    tracker.description = description
    assert not any(warnings_of(tracker, views))


def test_what_a_recording_says_of_its_beams_counts():
    """Its scans are points, which do not tell where the beams without a return lie."""
    points = [Scan.from_points([[2.0, 0.1], [2.0, 0.0]])] * 9
    for beams, count in ((SICK, 1), (Beams(-180.0, 360.0, 0.2), 0), (None, 0)):
        check = LaserViewCheck(Odometer(Network()), "mine", beams)
        assert sum(bool(check.add(scan)) for scan in points) == count


def test_scans_without_angles_or_returns_tell_nothing():
    check = LaserViewCheck(Odometer(Network()), "mine", None)
    scans = [Scan(np.full(181, 5.0)), scan_of(HALF, 0.0), scan_of([3.0]), scan_of([3.0, 3.0]), scan_of([])]
    assert not any(check.add(scan) for scan in scans * 5)


@pytest.mark.parametrize(
    ("beams", "name"),
    [
        (SICK, "half_circle"),
        (Beams(-135.0, 270.0, 0.25), "half_circle"),
        (Beams(0.0, 179.0, 1.0), ""),  # to the left
        (Beams(-160.0, 320.0, 1.0), ""),
    ],
)
def test_the_network_for_a_laser(beams, name):
    assert find_shipped_network(beams) == name


def half_circle_stream(count):
    return ScanStream("room.log", (scan_of(HALF) for _ in range(count)))


def test_it_is_logged_and_stands_in_the_summary_and_the_report(tmp_path, caplog):
    summary = run(Odometer(Network()), half_circle_stream(8), "mine", tmp_path / "out")
    [warning] = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert warning.startswith(f"room.log: the network of --model mine {WORDS}")
    assert summary["notes"] == [warning.removeprefix("room.log: ")]
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["notes"] == summary["notes"]
    assert WORDS in (tmp_path / "out" / "report.html").read_text()


def run_log(tmp_path, caplog, *words):
    make_carmen(tmp_path, "robot", frames=12)
    command = ["run", str(tmp_path / "robot.log"), *words, "--out", str(tmp_path / "out")]
    assert main(command) == 0
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_the_shipped_network_for_another_laser_by_the_command(tmp_path, caplog):
    [warning] = run_log(tmp_path, caplog, "--model", "all_round")
    assert warning == (
        f"robot.log: all_round {WORDS}; --model half_circle was trained on lasers that see a part of the "
        "circle"
    )


def test_the_network_that_was_advised_is_silent(tmp_path, caplog):
    assert run_log(tmp_path, caplog, "--model", "half_circle") == []


def test_the_network_of_fused_by_the_command(tmp_path, caplog):
    [warning] = run_log(tmp_path, caplog, "--model", "fused")
    assert warning == (
        f"robot.log: the network of --model fused {WORDS}; --network half_circle was trained on lasers that "
        "see a part of the circle"
    )
