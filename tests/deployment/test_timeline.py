"""What a run gathers in constant memory: against what is worked out from all of its scans at once."""

import math

import numpy as np
import pytest

from rcnn_odom.deployment.odometer import Pose
from rcnn_odom.deployment.timeline import (
    MOST_STRETCHES,
    Curves,
    Marks,
    Moment,
    RecordingTime,
    Timeline,
    causes_in,
)
from rcnn_odom.geometry import Step
from rcnn_odom.models.fused import _without_prior


def seconds_of(*stamps):
    time, seen = RecordingTime(), []
    for stamp in stamps:
        time.add(stamp)
        seen.append(time.seconds)
    return seen


@pytest.mark.parametrize(
    ("stamps", "expected"),
    [
        ((100.0, 100.5, 102.0), [0, 0.5, 2]),
        ((100.0, 100.5, 100.2, 101.0), [0, 0.5, 0.5, 1]),  # a late scan
        ((0.0, 0.1, 1.6e9, 1.6e9 + 1), [0, 0.1, 0.1, 1.1]),  # a clock that is set
        ((1.6e9, 1.6e9 + 1, 5.0, 6.0), [0, 1, 1, 2]),
        ((9.0, 10.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0), [0, 1, 1, 1, 1, 1, 1, 2]),  # set back by eight seconds
        ((None, None, 5.0, None, 6.0), [None, None, 0, 0, 1]),
        ((None, math.nan), [None, None]),
        ([5.0] * 8 + [6.0] * 8 + [7.0], [0] * 8 + [1] * 8 + [2]),  # a clock of whole seconds
        ((5.0, 5.0, 5.0, 6.0, 5.9, 7.0), [0, 0, 0, 1, 1, 2]),
    ],
)
def test_the_time_of_a_recording(stamps, expected):
    assert seconds_of(*stamps) == pytest.approx(expected)


def timeline_of(rows):
    """Of poses with stamp, x and heading."""
    timeline = Timeline()
    for stamp, x, heading in rows:
        timeline.add(Pose(stamp=stamp, x=x, heading=heading))
    return timeline


def test_speed_and_turn_rate_are_those_of_the_last_second():
    """A robot that speeds up evenly: 0.1 t^2 metres, turning at 0.3 radians a second."""
    times = np.arange(0.0, 10.0, 0.1)
    timeline = timeline_of(zip(5 + times, 0.1 * times**2, 0.3 * times, strict=True))
    speed, turn_rate = timeline.curves.column("speed"), timeline.curves.column("turn_rate")
    assert np.isnan(speed[:5]).all(), "less than half a second tells nothing"
    np.testing.assert_allclose(speed[11:], 0.2 * (times[11:] - 0.5), atol=0.011)
    np.testing.assert_allclose(turn_rate[11:], 0.3)
    assert timeline.top_speed == pytest.approx(np.nanmax(speed))
    assert timeline.seconds == pytest.approx(9.9)


def test_stamps_that_jitter_are_no_top_speed():
    """0.5 m/s at 10 Hz; with two stamps in five that come in pairs single steps say 5 m/s."""
    times = np.arange(0.0, 20.0, 0.1)
    stamps = np.where(np.arange(200) % 5 == 1, times - 0.09, times)
    timeline = timeline_of(zip(stamps, 0.5 * times, 0 * times, strict=True))
    assert timeline.top_speed == pytest.approx(0.5, rel=0.2)


def test_without_stamps_there_is_no_speed():
    timeline = timeline_of((None, 0.1 * n, 0.0) for n in range(50))
    assert (timeline.seconds, timeline.top_speed, timeline.scans) == (None, 0.0, 50)
    assert np.isnan(timeline.curves.column("speed")).all()


def moment(scan, peak, turn):
    return Moment(scan, scan / 10, peak, turn, peak, peak, peak, scan, scan, scan)


@pytest.mark.parametrize("count", [1, 7, 8, 9, 16, 17, 1000])
def test_curves_keep_every_peak_and_never_grow(count):
    curves, rng = Curves(8), np.random.default_rng(count)
    peaks, turns = rng.uniform(0, 1, count), rng.uniform(-1, 1, count)
    for number in range(count):
        curves.add(moment(number, peaks[number], turns[number]))
    scans = curves.column("scan")
    assert len(scans) <= 8
    assert scans[-1] == count - 1, "the last scan is in the last moment"
    assert np.all(np.diff(scans) > 0)
    bounds = [0, *(scans[:-1] + 1).astype(int)]
    expected = [peaks[begin : int(end) + 1].max() for begin, end in zip(bounds, scans, strict=True)]
    for name in ("speed", "x", "heading"):
        np.testing.assert_array_equal(curves.column(name), expected)
    largest = [max(turns[begin : int(end) + 1], key=abs) for begin, end in zip(bounds, scans, strict=True)]
    np.testing.assert_array_equal(curves.column("turn_rate"), largest)
    np.testing.assert_array_equal(curves.column("pose_x"), scans)


def test_what_is_unknown_hides_no_peak():
    curves = Curves(2)
    for peak in (0.5, np.nan, np.nan, np.nan, np.nan, 0.25, np.nan, np.nan):
        curves.add(moment(0, peak, -peak))
    np.testing.assert_array_equal(curves.column("x"), [0.5, 0.25])
    np.testing.assert_array_equal(curves.column("turn_rate"), [-0.5, -0.25])


def test_deviations_are_roots_of_the_variances():
    timeline = Timeline()
    timeline.add(Pose(stamp=0.0))
    step = Step(1.0, 0.0, 0.0, np.diag([0.04, 0.09, 0.01]))
    timeline.add(Pose(0.1, 1.0, 0.0, 0.0, step, np.diag([1.0, 4.0, 9.0])))
    timeline.add(Pose(0.2, 1.0, 0.0, 0.0, Step(0.0, 0.0, 0.0), np.full((3, 3), np.nan)))
    names = ("x", "y", "heading", "pose_x", "pose_y", "pose_heading")
    got = np.array([timeline.curves.column(name) for name in names]).T
    np.testing.assert_allclose(got[0], [np.nan] * 3 + [0] * 3)  # no step leads to the first scan
    np.testing.assert_allclose(got[1], [0.2, 0.3, 0.1, 1, 2, 3])
    assert np.isnan(got[2]).all()


def test_causes_are_what_stands_before_a_colon():
    fused = "no prior: other laser: its beams lie elsewhere; scan matching goes on alone"
    assert causes_in(fused) == ["no prior"]
    assert causes_in("gap: 3 periods after the last scan; few returns: 2 %") == ["gap", "few returns"]
    assert causes_in(_without_prior(("few returns: 2 %", "gap: 3 periods"))[0]) == ["no prior"]
    assert causes_in("") == []


def marks_of(marked, cause="held"):
    marks = Marks()
    for scan in marked:
        marks.add(scan, scan / 10, f"{cause}: it was so")
    return marks


def test_marked_scans_near_each_other_are_one_stretch():
    marks = marks_of([3, 4, 8, 40, 60])
    marks.add(61, 6.1, "held: again; gap: 2 periods")
    assert marks.counts() == {"held": 6, "gap": 1}
    assert marks.as_dict()["held"] == [
        {"from_s": 0.3, "to_s": 0.8, "first_scan": 3, "last_scan": 8, "scans": 3},
        {"from_s": 4.0, "to_s": 4.0, "first_scan": 40, "last_scan": 40, "scans": 1},
        {"from_s": 6.0, "to_s": 6.1, "first_scan": 60, "last_scan": 61, "scans": 2},
    ]
    assert marks.first_notes["held"] == "held: it was so"


def test_of_many_stretches_neighbours_become_one_and_no_scan_is_lost():
    marked = range(1, 200_000, 37)
    marks = marks_of(marked)
    kept = marks.stretches["held"]
    assert MOST_STRETCHES / 4 <= len(kept) <= MOST_STRETCHES or len(kept) == 1
    assert sum(one.scans for one in kept) == len(marked)
    assert (kept[0].first, kept[-1].last) == (1, marked[-1])
    far = marks_of([*range(1, 100), *range(50_000, 50_100), *range(90_000, 190_000, 50)])
    assert far.stretches["held"][0].last < 50_000, "what is far apart stays apart"
