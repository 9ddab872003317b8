"""LaserScan messages as scans: their limits, angles, and readings that are no returns."""

import json
import math

import numpy as np
import pytest

from data.make_bag import make_bag
from rcnn_odom.recordings import rosbag
from rcnn_odom.recordings.json_lines import stream_lines
from rcnn_odom.recordings.laser_scan import (
    assume_even_turn,
    compare_angles,
    from_laser_scan,
    has_most_beyond,
)

NAN, INF = math.nan, math.inf


def ranges_of(ranges, **limits):
    return from_laser_scan(ranges, 0.0, 0.1, **limits).ranges


@pytest.mark.parametrize(
    ("ranges", "limit", "beyond"),
    [
        (np.r_[np.full(55, 8191.0), np.linspace(100, 3000, 45)], 100, True),
        (np.r_[np.full(55, 8191.0), np.linspace(1, 30, 45)], 100, False),
        (np.r_[np.full(55, INF), np.full(20, NAN), np.zeros(9), np.linspace(100, 3000, 45)], 100, True),
        (np.r_[np.linspace(1, 30, 51), np.linspace(101, 200, 49)], 100, False),
        (np.r_[np.linspace(1, 30, 49), np.linspace(101, 200, 51), 300], 100, True),
        (np.r_[np.full(10, 1.0), np.full(10, 101.0), 300], 100, False),  # half is not most
        (np.full(50, 8191.0), 100, False),
        (np.linspace(0.99, 1, 9) * 500, 100, False),
        (np.zeros(5), 100, False),
        (np.full(5, INF), 100, False),
        (np.array([]), 100, False),
    ],
)
def test_whether_most_readings_are_beyond(ranges, limit, beyond):
    assert has_most_beyond(ranges, limit) is beyond


def test_a_maximum_that_most_readings_contradict_is_not_believed():
    far = np.linspace(1, 80, 100)
    np.testing.assert_array_equal(ranges_of(far, range_max=10.0), far)
    near = np.r_[np.linspace(1, 7, 60), np.linspace(8.5, 9.5, 10), np.full(40, 30.0)]
    expected = np.where(near < 8, near, INF)
    np.testing.assert_array_equal(ranges_of(near, range_max=8.0), expected)
    # Where nothing came back in most directions, the constant there contradicts nothing.
    np.testing.assert_array_equal(ranges_of([1.0, 2.0, *[65.5] * 20], range_max=30.0), [1, 2, *[INF] * 20])


def test_limits_count_as_in_rep_117():
    ranges = [0.05, 0.1, 7.9, 8.0, 8.5, INF, -INF, NAN, 0.0, -1.0]
    expected = [0.0, 0.1, 7.9, INF, INF, INF, 0, 0, 0, 0]
    np.testing.assert_array_equal(ranges_of(ranges, range_min=0.1, range_max=8.0), expected)


@pytest.mark.parametrize("limits", [(0, 0), (0.1, 0.1), (0.1, 0.0), (NAN, NAN), (0, INF), (0, -1), (INF, 8)])
def test_limits_that_no_laser_has_limit_nothing(limits):
    low, high = limits
    np.testing.assert_array_equal(ranges_of([0.5, 80.0], range_min=low, range_max=high), [0.5, 80])


@pytest.mark.parametrize("increment", [0.0, NAN, INF])
def test_beams_are_even_up_to_the_last_angle_where_their_spacing_is_left_out(increment):
    scan = from_laser_scan(np.ones(5), 1.0, increment, -1.0)
    np.testing.assert_allclose(scan.bearings, [1, 0.5, 0, -0.5, -1])
    np.testing.assert_array_equal(from_laser_scan([1.0], 1.0, increment).bearings, [1])
    assert len(from_laser_scan([], 1.0, increment).bearings) == 0
    for last in (NAN, INF, 1.0):
        with pytest.raises(ValueError, match=r"its angle_increment is .* and its angle_max"):
            from_laser_scan([1.0, 1.0], 1.0, increment, last)


def test_the_spacing_stands_before_the_last_angle():
    np.testing.assert_allclose(from_laser_scan(np.ones(3), 0.5, -0.25, 7.0).bearings, [0.5, 0.25, 0])
    for first in (NAN, INF):
        with pytest.raises(ValueError, match="its angle_min is"):
            from_laser_scan([1.0, 1.0], first, 0.1, 1.0)


@pytest.mark.parametrize(
    ("increment", "times"), [(0.001, [0, 0.001, 0.002]), (0, None), (NAN, None), (INF, None)]
)
def test_times_of_beams(increment, times):
    scan = from_laser_scan(np.ones(3), 0.0, 0.1, time_increment=increment, stamp=2.5, frame_id="laser")
    np.testing.assert_array_equal(scan.times, times)
    assert (scan.stamp, scan.frame_id) == (2.5, "laser")


@pytest.mark.parametrize(
    ("scan_time", "degrees", "last"),
    [
        (0.1, 360.0, 0.1 * 359 / 360),
        (0.1, 180.0, 0.1 / 2 * 359 / 360),  # the other half of the turn is not seen
        (0.025, -270.0, 0.025 * 0.75 * 359 / 360),  # clockwise, beam after beam all the same
        (10.0, 360.0, 10 * 359 / 360),
        (10.1, 360.0, None),
        (0.0, 360.0, None),
        (-0.1, 360.0, None),
        (NAN, 360.0, None),
        (INF, 360.0, None),
    ],
)
def test_times_by_the_time_of_a_turn(scan_time, degrees, last):
    spacing = np.deg2rad(degrees) / 360
    scan = from_laser_scan(np.ones(360), 0.0, spacing, scan_time=scan_time)
    assert scan.times is None, "depth cameras write it as well"
    if last is None:
        assert assume_even_turn(scan).times is None
    else:
        np.testing.assert_allclose(assume_even_turn(scan).times, np.linspace(0, last, 360))
    told = from_laser_scan(np.ones(360), 0.0, spacing, time_increment=1e-4, scan_time=scan_time)
    for each in (told, assume_even_turn(told)):
        np.testing.assert_allclose(each.times, 1e-4 * np.arange(360), err_msg="the increment counts")


def test_times_that_cannot_be_are_unknown():
    assert from_laser_scan(np.ones(360), 0.0, 0.01, time_increment=0.1).times is None  # 36 s
    assert from_laser_scan([], 0.0, 0.01, time_increment=0.1).times.shape == (0,)
    assert assume_even_turn(from_laser_scan([1.0], 0.0, 0.0, scan_time=0.1)).times is None


@pytest.mark.parametrize(
    ("angles", "count", "told"),
    [
        ((-1.5708, 0.0174533, 1.5708), 181, ""),
        ((-1.5708, 0.0174533, 1.5708), 180, ""),  # the last beam is left out
        ((1.5708, -0.0174533, -1.5708), 181, ""),
        ((-1.5708, 0.0174533, 0.0), 181, ""),  # not set
        ((-1.5708, 0.0174533, math.nan), 181, ""),
        ((-1.5708, 0.0, 1.5708), 181, ""),
        ((-1.5708, 0.00872665, 1.5708), 181, "its angle_increment and 181 readings say 90;"),
        ((-1.5708, 0.0174533, 1.5708), 91, "cover 180 degrees, its angle_increment and 91 readings say 90;"),
    ],
)
def test_angles_that_contradict_each_other(angles, count, told):
    assert told in (contradiction := compare_angles(*angles, count))
    assert bool(contradiction) == bool(told)


def test_a_contradiction_of_a_bag_is_told_once(caplog, tmp_path):
    bag = make_bag(tmp_path, "mcap", np.full((5, 181), 3.0), angle_max=0.5)
    assert len(list(rosbag.stream(bag).scans)) == 5
    assert [
        message for message in caplog.messages if "/scan: its angle_max says" in message
    ] == caplog.messages
    assert len(caplog.messages) == 1


def test_a_contradiction_is_told_once(caplog):
    line = {"ranges": [2.0] * 91, "angle_min": -1.5708, "angle_increment": 0.0174533, "angle_max": 1.5708}
    scans = list(stream_lines([json.dumps(line)] * 5).scans)
    np.testing.assert_allclose(scans[4].bearings[-1], 0, atol=1e-4)
    assert [message for message in caplog.messages if "its angle_max says" in message] == caplog.messages
    assert len(caplog.messages) == 1
