"""Whole scans through a model in a stream: what comes to it, and what becomes of it."""

from dataclasses import replace

import numpy as np
import pytest

from odometry import ANGLES, random_scans
from rcnn_odom.geometry import FORWARD_CAMERA, Step, compose, planar_to_poses, relative_steps
from rcnn_odom.models.contract import Description, Registered
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.pairs import PairTracker
from rcnn_odom.models.tracking import SWINGS, Kind, Tracking, estimate_by_tracking
from rcnn_odom.recordings.beams import PATIENCE
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.scan import Scan


class Diary:
    """A tracker that writes down what it is asked, and always answers the same."""

    period = float("nan")
    answer = Registered(Step(0.5, 0.1, 0.05, np.diag([0.01, 0.02, 0.003])))

    def __init__(self):
        self.calls, self.has_seen = [], False

    def register(self, scan, periods=1, seconds=None):
        self.calls.append((periods, seconds if seconds is None else round(seconds, 6)))
        return self.answer

    def begin(self, scan):
        self.calls.append("begin")
        self.has_seen = bool((scan.ranges > 0).any())
        return () if self.has_seen else ("no returns: none yet",)

    def reset(self):
        self.calls.append("reset")
        self.has_seen = False

    def returns(self):
        return np.zeros((0, 2))


def scan_at(stamp, value=5.0, frame="laser", count=7):
    return Scan(np.full(count, value), np.linspace(-1, 1, count), stamp=stamp, frame_id=frame)


def track(tracker, stamps, **changes):
    """Scans that are all different, at these times."""
    tracking = Tracking(tracker)
    return [tracking.step(scan_at(stamp, 5.0 + 0.01 * n, **changes)) for n, stamp in enumerate(stamps)]


def test_a_scan_comes_with_the_time_since_the_last_one():
    diary = Diary()
    found = track(diary, [10.0, 10.1, 10.2, 10.3, 10.5, 11.5, 11.6])
    assert diary.calls == [
        *["reset", "begin", (1, 0.1), (1, 0.1), (1, 0.1)],
        *[(2, 0.2), (10, 1.0), (1, 0.1)],
    ]
    assert [each.kind for each in found] == [Kind.FIRST, *[Kind.ESTIMATED] * 6]
    assert not any(each.notes for each in found), "what a gap means is told by the model"
    assert found[0].step.covariance.tolist() == np.zeros((3, 3)).tolist()
    assert found[5].step is diary.answer.step


def test_without_stamps_nothing_is_said_of_the_time():
    diary = Diary()
    track(diary, [None] * 4)
    assert diary.calls == ["reset", "begin", *[(1, None)] * 3]
    diary = Diary()
    track(diary, [1.0, 1.1, None, 1.3, 1.4])
    assert diary.calls == ["reset", "begin", (1, 0.1), (1, None), (1, None), (1, 0.1)]


def test_any_number_of_beams_and_any_laser_comes_to_a_model_of_whole_scans():
    diary = Diary()
    tracking = Tracking(diary)
    for n, count in enumerate([181, 91, 7, 1, 0, 400]):
        found = tracking.step(Scan(np.full(count, 500.0), np.linspace(0, 6, count), stamp=0.1 * n))
        assert found.notes == ()
    assert len(diary.calls) == 2 + 5


@pytest.mark.parametrize(("stamp", "kind"), [(0.2, Kind.PASSED_OVER), (-5.0, Kind.PASSED_OVER)])
def test_a_late_scan_does_not_come_to_it(stamp, kind):
    diary = Diary()
    found = track(diary, [0.1, 0.2, 0.3, stamp, 0.4])
    assert found[3].kind is kind
    assert found[3].notes[0].startswith("late scan: ")
    assert not found[3].step.array().any()
    assert not found[3].step.covariance.any()
    assert diary.calls[2:] == [(1, 0.1)] * 3


def test_over_a_clock_that_was_set_nobody_knows_the_motion():
    diary = Diary()
    found = track(diary, [0.1, 0.2, 1000.0, 1000.1])
    assert [each.kind for each in found] == [Kind.FIRST, Kind.ESTIMATED, Kind.UNKNOWN, Kind.ESTIMATED]
    assert np.isnan(found[2].step.covariance).all()
    assert not found[2].step.array().any()
    assert found[2].notes[0].startswith("clock set: from 0.2 to 1000 s")
    assert diary.calls == ["reset", "begin", (1, 0.1), "begin", (1, 0.1)], "the model is not reset"


def test_scans_of_another_frame_are_passed_over_until_it_is_the_lasers():
    diary = Diary()
    tracking = Tracking(diary)
    kinds = []
    for n in range(12):
        found = tracking.step(scan_at(0.1 * n, 5 + 0.1 * n, "front" if n < 4 else "/rear"))
        kinds.append((found.kind, found.notes[0].split(":")[0] if found.notes else ""))
    assert kinds == [
        (Kind.FIRST, ""),
        *[(Kind.ESTIMATED, "")] * 3,
        *[(Kind.PASSED_OVER, "other frame")] * (PATIENCE - 1),
        (Kind.UNKNOWN, "new frame"),
        *[(Kind.ESTIMATED, "")] * 3,
    ]
    assert diary.calls.count("reset") == 2


@pytest.mark.parametrize(
    ("there", "told"),
    [
        ((0.5, 0.0, np.pi), True),  # one laser looks ahead, one back
        ((0.3, 0.4, 0.0), True),
        ((0.0, 0.0, 0.3), True),
        ((0.05, 0.0, 0.1), False),  # a robot that shakes
    ],
)
def test_two_lasers_on_one_topic_are_told(there, told):
    """Under one frame or none: every second scan is taken from another place, while both move on."""
    diary = Diary()
    tracking, on_robot = Tracking(diary), planar_to_poses([(0, 0, 0), there])
    robot = compose([(0.02, 0.0, 0.01)] * 11)
    answers = relative_steps(robot @ on_robot[np.arange(12) % 2])
    kinds = []
    for n in range(12):
        diary.answer = Registered(Step(*answers[max(n - 1, 0)].tolist()))
        kinds += [note.split(":")[0] for note in tracking.step(scan_at(0.1 * n, 5 + 0.1 * n)).notes]
    assert kinds == ["to and fro"] * (11 - SWINGS if told else 0)


def test_steps_that_go_on_or_turn_back_once_are_not_to_and_fro():
    diary = Diary()
    tracking = Tracking(diary)
    for n, x in enumerate([0.0, 0.5, 0.5, -0.5, -0.5, 0.5, 0.1, 0.05, -0.05, 0.05, -0.3, 0.1]):
        diary.answer = Registered(Step(x, 0.0, 0.0))
        assert tracking.step(scan_at(0.1 * n, 5 + 0.1 * n)).notes == ()


def test_until_something_is_seen_every_scan_is_the_first():
    diary = Diary()
    tracking = Tracking(diary)
    found = [tracking.step(scan_at(0.1 * n, 0.0 if n < 3 else 5.0 + n)) for n in range(5)]
    assert [each.kind for each in found] == [Kind.FIRST] * 4 + [Kind.ESTIMATED]
    assert [each.notes for each in found] == [("no returns: none yet",)] * 3 + [()] * 2


def test_what_a_model_holds_is_told_apart():
    diary = Diary()
    diary.answer = Registered(Step(0.5, 0.0, 0.0), ("lost: no match",), is_estimated=False)
    found = track(diary, [0.1, 0.2])[1]
    assert (found.kind, found.notes) == (Kind.HELD, ("lost: no match",))


def test_a_drive_is_estimated_as_a_stream_is():
    """Zero steps with zero covariance to scans that are passed over; N - 1 steps in all."""
    stamps = [0.1, 0.2, 0.3, 0.15, 0.4]
    scans = [scan_at(stamp, 5.0 + n) for n, stamp in enumerate(stamps)]
    steps = estimate_by_tracking(Diary(), iter(scans))
    moved = Diary.answer.step
    np.testing.assert_array_equal(steps.values, [[0, 0, 0] if n == 2 else moved.array() for n in range(4)])
    np.testing.assert_array_equal(
        steps.covariances, [0 * moved.covariance if n == 2 else moved.covariance for n in range(4)]
    )
    assert estimate_by_tracking(Diary(), scans[:1]).values.shape == (0, 3)
    used = Diary()
    track(used, [5.0, 5.1])
    np.testing.assert_array_equal(estimate_by_tracking(used, scans).values, steps.values)


def test_a_recording_without_a_clock_is_taken_in_its_order():
    scans = [scan_at(stamp, 5.0 + n) for n, stamp in enumerate([3.0, 2.0, 1e6, 0.0])]
    drive = Drive(
        "robot",
        "k",
        np.empty((4, 0), np.float32),
        compose(np.zeros((3, 3))),
        np.zeros(4),
        FORWARD_CAMERA,
        has_clock=False,
        read_scan=scans.__getitem__,
    )
    steps = estimate_by_tracking(Diary(), drive.raw_scans())
    np.testing.assert_array_equal(steps.values, [Diary.answer.step.array()] * 3)


class Straight:
    """A model of pairs, as long a step as there are pairs before."""

    description = Description(Sensor(1.0, 180.0, 40.0), (0.6, 0.05, 0.03), 0.1, 0.1)

    def __init__(self):
        self.reset()

    def reset(self):
        self.pairs = []

    def __call__(self, pair):
        self.pairs.append(pair)
        return Step(0.1 * len(self.pairs), 0.0, 0.0, np.eye(3))


def test_pairs_are_those_of_consecutive_scans():
    scans, stepper = random_scans(5), Straight()
    tracker = PairTracker(stepper)
    assert (tracker.period, tracker.has_seen, tracker.returns().shape) == (0.1, False, (0, 2))
    found = track_arrays(tracker, scans)
    np.testing.assert_array_equal(stepper.pairs, [scans[n : n + 2] for n in range(4)])
    assert [each.step.x for each in found] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    ranges = np.hypot(*tracker.returns().T)
    np.testing.assert_allclose(ranges, scans[-1][scans[-1] > 0], rtol=1e-6)


def track_arrays(tracker, scans):
    tracking = Tracking(tracker)
    return [tracking.step(Scan(scan.astype(float), ANGLES, stamp=0.1 * n)) for n, scan in enumerate(scans)]


def test_models_of_pairs_hold_the_motion_over_a_gap_and_refuse_other_lasers():
    stepper = Straight()
    tracking = Tracking(PairTracker(stepper))
    scans = [Scan(scan.astype(float), ANGLES, stamp=0.1 * n) for n, scan in enumerate(random_scans(9))]
    for scan in scans[:4]:
        tracking.step(scan)
    across = tracking.step(scans[6])
    assert (across.kind, len(stepper.pairs)) == (Kind.HELD, 3)
    assert across.notes == ("gap: 3 periods after the last scan, the last motion goes on",)
    assert across.step.x == pytest.approx(3 * 0.3)
    np.testing.assert_allclose(across.step.covariance, (3 * np.diag([0.6, 0.05, 0.03])) ** 2)
    other = tracking.step(replace(scans[7], bearings=ANGLES + np.pi / 2))
    assert other.kind is Kind.HELD
    assert other.notes[0].startswith("other laser: its beams lie from 0 to 180 degrees")
    assert len(tracking.tracker.returns()) == 0
