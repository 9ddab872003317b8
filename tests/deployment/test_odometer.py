"""Streaming odometry: the same numbers as a whole drive at once, and what may go wrong in a stream."""

import json
import math
import subprocess
import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch

from conftest import ROOT
from odometry import ANGLES, NAMES, build, random_scans
from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import Step, advance, compose, compound_covariance, planar_to_poses, poses_to_planar
from rcnn_odom.models.contract import Description, Registered
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.pairs import LONGEST_HOLD, PairTracker
from rcnn_odom.recordings.beams import PATIENCE
from rcnn_odom.recordings.clock import CLOCK_JUMP, LATE_IN_A_ROW
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.training.onnx_graph import to_onnx, write

PERIOD = 0.1


class Recorder:
    """A stepper that notes what it is asked and always answers the same."""

    description = Description(Sensor(1.0, 180.0, 40.0), (0.6, 0.05, 0.03), 0.5, PERIOD)
    step = np.array([0.5 * np.cos(0.1), 0.5 * np.sin(0.1), 0.1])  # a turn of 0.1, then 0.5 m
    covariance = np.diag([0.05, 0.02, 0.01]) ** 2

    def __init__(self):
        self.pairs, self.resets = [], 0

    def __call__(self, pair):
        self.pairs.append(pair)
        return Step(*self.step, self.covariance)

    def reset(self):
        self.resets += 1


class Remembering:
    """A stepper whose answer depends on all pairs since its start."""

    description = Description(Sensor(1.0, 180.0, 40.0), (0.6, 0.05, 0.03), 0.1, PERIOD)

    def __init__(self):
        self.reset()

    def reset(self):
        self.state = 0.0

    def __call__(self, pair):
        self.state = 0.5 * self.state + float(np.tanh(pair[1].mean() - pair[0].mean()))
        return Step(0.5 + 0.1 * self.state, 0.01 * self.state, 0.1 * self.state)


@pytest.fixture
def recorder():
    return Recorder()


def length(pose):
    """Metres of a pose's step."""
    return math.hypot(pose.step.x, pose.step.y)


def assert_same(poses, expected):
    assert [pose.as_dict() for pose in poses] == [pose.as_dict() for pose in expected]


def drive(odometer, scans, first=0):
    return [odometer.step(scan, PERIOD * (first + number), ANGLES) for number, scan in enumerate(scans)]


@pytest.mark.parametrize(
    ("variant", "projection"),
    [
        ("rcnn_reg", 8),
        *(pytest.param(name, None, marks=pytest.mark.slow) for name in NAMES),
    ],
)
def test_steps_equal_the_offline_estimate(variant, projection, tmp_path):
    model = build(variant, projection)
    scans = random_scans(150)  # more than two chunks of the offline estimate
    offline = model.estimate_scans(torch.from_numpy(scans))
    expected = poses_to_planar(offline.poses())
    write(to_onnx(model, "fp32"), tmp_path / "model.onnx")
    for odometer in (Odometer(model.tracker()), Odometer.from_onnx(tmp_path / "model.onnx")):
        poses = drive(odometer, scans)
        streamed = np.array([[pose.x, pose.y, pose.heading] for pose in poses])
        np.testing.assert_allclose(streamed[:, :2], expected[:, :2], atol=1e-5)
        np.testing.assert_allclose(np.exp(1j * streamed[:, 2]), np.exp(1j * expected[:, 2]), atol=1e-5)
        steps = np.array([pose.step.array() for pose in poses[1:]])
        np.testing.assert_allclose(steps, offline.values, atol=1e-5)
        covariances = np.array([pose.step.covariance for pose in poses[1:]])
        np.testing.assert_allclose(covariances, offline.covariances, atol=1e-6)
        deviations, expected_ones = (
            np.sqrt(np.diagonal(each, axis1=1, axis2=2)) for each in (covariances, offline.covariances)
        )
        np.testing.assert_allclose(deviations, expected_ones, atol=1e-5)
        assert np.isfinite(covariances).all()
        assert not any(pose.degraded for pose in poses)


def test_the_first_scan_is_the_origin_and_reset_begins_anew():
    odometer = Odometer(PairTracker(Remembering()))
    scans = random_scans(6)
    first = drive(odometer, scans)
    assert (first[0].x, first[0].y, first[0].heading) == (0, 0, 0)
    np.testing.assert_array_equal(first[0].matrix(), np.eye(4))
    odometer.reset()
    assert_same(drive(odometer, scans), first)
    assert first[0].step.covariance.tolist() == np.zeros((3, 3)).tolist(), "the origin is known"


def test_ranges_with_and_without_angles_and_points_are_the_same():
    scans = random_scans(5).astype(np.float64)
    expected = drive(Odometer(PairTracker(Remembering())), scans)
    even, points = (Odometer(PairTracker(Remembering())) for _ in range(2))
    for number, scan in enumerate(scans):
        stamp = PERIOD * number
        assert_same([even.step(scan, stamp)], [expected[number]])
        as_points = np.column_stack([scan * np.cos(ANGLES), scan * np.sin(ANGLES), np.ones(181)])
        pose = points.step(as_points, stamp)
        assert pose.x == pytest.approx(expected[number].x, abs=1e-6)


def test_a_scan_without_returns_lets_the_last_motion_go_on(recorder):
    scans = random_scans(7)
    odometer = Odometer(PairTracker(recorder))
    poses = drive(odometer, [*scans[:5], np.zeros(181), scans[5], scans[6]])
    assert len(recorder.pairs) == 4 + 1, "neither the empty scan nor the pair across it reaches the network"
    np.testing.assert_array_equal(recorder.pairs[-1], scans[5:])
    path = poses_to_planar(compose(np.tile(Recorder.step, (7, 1))))
    np.testing.assert_allclose([[p.x, p.y, p.heading] for p in poses], path, atol=1e-12)
    assert [bool(pose.degraded) for pose in poses] == [False] * 5 + [True, True, False]
    assert "no returns" in poses[5].degraded
    assert "gap: 2 periods" in poses[6].degraded
    for pose in poses[5:7]:
        np.testing.assert_allclose(pose.step.array(), Recorder.step)
        np.testing.assert_allclose(pose.step.covariance, np.diag([0.6, 0.05, 0.03]) ** 2)
    np.testing.assert_array_equal(poses[4].step.covariance, Recorder.covariance)
    assert recorder.resets == 1


@pytest.mark.parametrize(
    "nothing", [np.full(181, np.inf), np.full(181, np.nan), np.full(181, 40.0), np.zeros(0)]
)
def test_no_returns_in_other_words(recorder, nothing):
    odometer = Odometer(PairTracker(recorder))
    drive(odometer, random_scans(5))
    pose = odometer.step(nothing, 0.5)
    assert "no returns" in pose.degraded


def test_nothing_at_first_is_still_the_origin(recorder):
    odometer = Odometer(PairTracker(recorder))
    pose = odometer.step(np.zeros(181), 0.0)
    assert (pose.x, pose.y) == (0, 0)
    assert "no returns" in pose.degraded
    pose = odometer.step(random_scans(1)[0], 0.1)
    assert (pose.x, pose.y, pose.degraded) == (0, 0, "")


def test_dropped_scans_are_bridged_and_the_state_survives(recorder):
    scans = random_scans(20)
    odometer = Odometer(PairTracker(recorder))
    before = drive(odometer, scans[:6])
    after = odometer.step(scans[8], PERIOD * 8, ANGLES)
    assert "gap: 3 periods" in after.degraded
    pose = np.array([before[-1].x, before[-1].y, before[-1].heading])
    for _ in range(3):
        pose = advance(pose, Recorder.step)
    np.testing.assert_allclose([after.x, after.y, after.heading], pose)
    held = poses_to_planar(compose([Recorder.step] * 3))[-1]
    np.testing.assert_allclose(after.step.array(), held, err_msg="as if it were three steps")
    np.testing.assert_allclose(after.step.covariance, (3 * np.diag([0.6, 0.05, 0.03])) ** 2)
    following = odometer.step(scans[9], PERIOD * 9, ANGLES)
    assert following.degraded == ""
    np.testing.assert_array_equal(recorder.pairs[-1], scans[8:10])
    assert recorder.resets == 1


def test_over_a_long_gap_the_motion_ends(recorder):
    odometer = Odometer(PairTracker(recorder))
    last = drive(odometer, random_scans(6))[-1]
    pose = odometer.step(random_scans(1)[0], 0.5 + CLOCK_JUMP - 0.1, ANGLES)
    assert math.hypot(pose.x - last.x, pose.y - last.y) <= LONGEST_HOLD * 0.5
    held = poses_to_planar(compose([Recorder.step] * LONGEST_HOLD))[-1]
    np.testing.assert_allclose(pose.step.array(), held)
    assert pose.step.covariance[0, 0] == pytest.approx((99 * 0.6) ** 2)
    odometer.reset()
    drive(odometer, random_scans(6))
    empty = [odometer.step(np.zeros(181), 0.1 * n) for n in range(6, 30)]
    assert [length(pose) for pose in empty] == pytest.approx(
        [0.5] * LONGEST_HOLD + [0.0] * (24 - LONGEST_HOLD)
    ), "held for so long, then standing still"
    assert empty[-1].step.covariance[0, 0] == pytest.approx(0.6**2)


def test_a_late_scan_is_passed_over():
    scans = random_scans(8)
    straight, disturbed = (Odometer(PairTracker(Remembering())) for _ in range(2))
    expected = drive(straight, scans)
    drive(disturbed, scans[:5])
    for stamp in (0.4, 0.1, -5.0):
        late = disturbed.step(random_scans(1, seed=9)[0], stamp, ANGLES)
        assert late.degraded.startswith("late scan")
        assert (late.x, late.y, late.heading, late.stamp) == (
            expected[4].x,
            expected[4].y,
            expected[4].heading,
            0.4,
        )
        assert not late.step.array().any()
        assert not late.step.covariance.any()
    assert_same(drive(disturbed, scans[5:], first=5), expected[5:])


def test_a_late_scan_after_an_empty_one_does_not_take_it_back(recorder):
    odometer = Odometer(PairTracker(recorder))
    drive(odometer, random_scans(5))
    empty = odometer.step(np.zeros(181), 0.5)
    late = odometer.step(np.full(361, 5.0), 0.45)
    assert (late.x, late.y, late.stamp, length(late)) == (empty.x, empty.y, 0.5, 0.0)
    assert "beam count" in odometer.step(np.full(361, 5.0), 0.6).degraded, "of a scan that counts"


@pytest.mark.parametrize("jump", [-1.7e9, -1000.0, -10.5, 10.5, 1000.0, 1.7e9])
def test_over_a_jump_of_the_clock_no_motion_is_added(recorder, jump):
    """Without a jump there would be 39 steps; over the one nobody knows, the rest is as if nothing were."""
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(40)
    before = drive(odometer, scans[:20])
    after = [odometer.step(scan, 2.0 + jump + 0.1 * n, ANGLES) for n, scan in enumerate(scans[20:])]
    assert after[0].degraded.startswith("clock set: from 1.9 to ")
    assert (after[0].x, after[0].y, after[0].heading) == (before[-1].x, before[-1].y, before[-1].heading)
    assert not after[0].step.array().any()
    assert np.isnan(after[0].step.covariance).all(), "how far it went is unknown"
    assert after[0].stamp == 2.0 + jump
    assert [pose.degraded for pose in after[1:]] == [""] * 19
    assert len(recorder.pairs) == 38
    np.testing.assert_array_equal(recorder.pairs[19], scans[20:22])
    assert recorder.resets == 1


def test_a_clock_that_goes_back_a_little_costs_a_few_scans(recorder):
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(60)
    drive(odometer, scans[:20])
    later = [odometer.step(scan, 2.1 - 5.0 + 0.1 * n, ANGLES) for n, scan in enumerate(scans[21:])]
    kinds = [pose.degraded.split(":")[0] for pose in later]
    assert kinds == ["late scan"] * (LATE_IN_A_ROW - 1) + ["gap"] + [""] * (39 - LATE_IN_A_ROW)
    held = poses_to_planar(compose([Recorder.step] * LATE_IN_A_ROW))[-1]
    assert length(later[LATE_IN_A_ROW - 1]) == pytest.approx(math.hypot(*held[:2]))
    assert recorder.resets == 1


def test_one_wild_stamp_costs_two_steps(recorder):
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(10)
    stamps = [0.0, 0.1, 0.2, 1e6, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]
    poses = [odometer.step(scan, stamp, ANGLES) for scan, stamp in zip(scans, stamps, strict=True)]
    assert [pose.degraded.split(":")[0] for pose in poses] == [""] * 3 + ["clock set"] * 2 + [""] * 5
    assert len(recorder.pairs) == 7


@pytest.mark.parametrize("stamp", [0.0, 5.0])
def test_a_clock_that_stands_still_is_none(recorder, stamp):
    """A 0 at once; of another stamp the first four might have come late."""
    odometer = Odometer(PairTracker(recorder))
    poses = [odometer.step(scan, stamp, ANGLES) for scan in random_scans(30)]
    kinds = [pose.degraded.split(":")[0] for pose in poses]
    lost = 0 if stamp == 0 else LATE_IN_A_ROW - 1
    assert kinds == ["", *["late scan"] * lost, *(["gap"] if lost else []), *[""] * (29 - lost - bool(lost))]
    assert sum(map(length, poses)) == pytest.approx(0.5 * len(recorder.pairs))


def test_a_stamp_of_zero_among_others_is_none(recorder):
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(30)
    stamps = [0.0 if n in (0, 7, 12, 13) else 1000 + 0.1 * n for n in range(30)]
    poses = [odometer.step(scan, stamp, ANGLES) for scan, stamp in zip(scans, stamps, strict=True)]
    assert not any(pose.degraded for pose in poses)
    assert len(recorder.pairs) == 29


@pytest.mark.parametrize("size", [2, 3, 10])
def test_a_coarse_clock_is_followed(recorder, size):
    """Stamps that several scans share, as whole seconds: soon only the time between the groups counts."""
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(100)
    stamps = [5.0 + PERIOD * (n // size) * size for n in range(100)]
    poses = [odometer.step(scan, stamp, ANGLES) for scan, stamp in zip(scans, stamps, strict=True)]
    assert [pose.degraded for pose in poses[30:]] == [""] * 70
    assert len(recorder.pairs) > 80


def test_a_scan_that_is_sent_twice_counts_once(recorder):
    odometer, scans = Odometer(PairTracker(recorder)), np.repeat(random_scans(40), 2, axis=0)
    poses = [odometer.step(scan, 1 + PERIOD * (n // 2), ANGLES) for n, scan in enumerate(scans)]
    assert [pose.degraded.split(":")[0] for pose in poses] == ["", "late scan"] * 40
    assert len(recorder.pairs) == 39


@pytest.mark.parametrize("stamps", [100.0 * np.arange(1, 41), 1e6 * (-1.0) ** np.arange(40)])
def test_a_wild_clock_is_none_after_a_while(recorder, stamps):
    """As stamps in milliseconds."""
    odometer = Odometer(PairTracker(recorder))
    poses = [odometer.step(scan, stamp, ANGLES) for scan, stamp in zip(random_scans(40), stamps, strict=True)]
    kinds = [pose.degraded.split(":")[0] for pose in poses]
    assert kinds == ["", *["clock set"] * 5, *[""] * 34]
    assert "stamps are not used from here on" in poses[5].degraded
    assert len(recorder.pairs) == 34


def test_a_laser_that_does_not_fit_gives_way_to_one_that_does(recorder):
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(20).astype(np.float64)
    for n, scan in enumerate(scans):
        front = Scan(scan, ANGLES, stamp=PERIOD * n, frame_id="front")
        rear = Scan(scan[:91], ANGLES[:91], stamp=PERIOD * n - PERIOD / 2, frame_id="rear")
        kinds = [odometer.step(each).degraded.split(":")[0] for each in (rear, front)]
        assert kinds == (["other frame", ""] if n else ["other laser", "new frame"])
    assert len(recorder.pairs) == 19


def test_a_scan_of_another_frame_is_passed_over(recorder):
    """Two lasers on one topic: the first one's scans are compared, the others' are not."""
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(20).astype(np.float64)
    frames = ["front", "rear", "/front", "rear", *["front", "rear"] * 8]
    poses = [
        odometer.step(Scan(scan, ANGLES, stamp=PERIOD / 2 * n, frame_id=frame))
        for n, (scan, frame) in enumerate(zip(scans, frames, strict=True))
    ]
    for pose, frame in zip(poses, frames, strict=True):
        assert pose.degraded == ("other frame: rear after front, passed over" if frame == "rear" else "")
    assert poses[3].stamp == poses[2].stamp
    np.testing.assert_array_equal(recorder.pairs, [scans[n : n + 3 : 2] for n in range(0, 18, 2)])
    assert recorder.resets == 1


def test_a_frame_that_changes_for_good_is_the_lasers(recorder):
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(20).astype(np.float64)
    poses = [
        odometer.step(Scan(scan, ANGLES, stamp=0.1 * n, frame_id="front" if n < 8 else "laser_link"))
        for n, scan in enumerate(scans)
    ]
    kinds = [pose.degraded.split(":")[0] for pose in poses]
    assert kinds == [""] * 8 + ["other frame"] * (PATIENCE - 1) + ["new frame"] + [""] * 7
    assert length(poses[12]) == 0
    assert np.isnan(poses[12].step.covariance).all()
    assert len(recorder.pairs) == 7 + 7, "no pair across the change"
    assert recorder.resets == 2


@pytest.mark.parametrize(
    ("other", "says"),
    [
        (Scan(np.full(181, 5.0), ANGLES + np.pi / 2), "its beams lie from 0 to 180 degrees, one every 1"),
        (Scan(np.full(91, 5.0), ANGLES[:91]), "its beams lie from -90 to 0 degrees"),
        (Scan(np.full(181, 5.0), np.rad2deg(ANGLES)), "more than a circle"),
        (Scan(np.linspace(100, 900, 181), ANGLES), "which cannot be metres"),
        (Scan(np.full(30, 5.0), ANGLES[::6][:30]), "one every 6"),
    ],
)
def test_a_scan_of_another_laser_is_not_used(recorder, other, says):
    odometer = Odometer(PairTracker(recorder))
    drive(odometer, random_scans(5))
    poses = [odometer.step(replace(other, stamp=0.5 + 0.1 * n)) for n in range(PATIENCE + 3)]
    for pose in poses:
        assert pose.degraded.startswith("other laser: ")
        assert says in pose.degraded
        assert length(pose) == pytest.approx(0.5), "the last motion goes on"
        assert len(odometer.returns()) == 0
    assert odometer.beam_check.in_a_row == len(poses)
    assert odometer.beam_check.is_another_laser
    assert len(recorder.pairs) == 4


def test_a_bursty_clock_is_no_gap(recorder):
    """Scans that arrive in pairs, 10 ms apart every 200 ms."""
    odometer = Odometer(PairTracker(recorder))
    stamps = [0.2 * (number // 2) + 0.01 * (number % 2) for number in range(200)]
    poses = [
        odometer.step(scan, stamp, ANGLES) for scan, stamp in zip(random_scans(200), stamps, strict=True)
    ]
    assert sum(map(length, poses)) == pytest.approx(0.5 * 199, rel=0.02)
    assert sum(bool(pose.degraded) for pose in poses) <= 1


def test_gaps_are_seen_from_the_first_scans_on(recorder):
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(3)
    odometer.step(scans[0], 0.0, ANGLES)
    assert odometer.step(scans[1], 0.1, ANGLES).degraded == ""
    assert "gap: 10 periods" in odometer.step(scans[2], 1.1, ANGLES).degraded


def test_another_rate_than_trainings_is_told(recorder):
    odometer = Odometer(PairTracker(recorder))
    poses = [odometer.step(scan, 0.3 * number, ANGLES) for number, scan in enumerate(random_scans(20))]
    assert all("gap" in pose.degraded for pose in poses[1:4])
    assert [pose.degraded for pose in poses[10:]] == [
        "slow scans: one every 0.3 s, in training every 0.1 s"
    ] * 10
    fast = Odometer(PairTracker(recorder))
    poses = [fast.step(scan, 0.05 * number, ANGLES) for number, scan in enumerate(random_scans(20))]
    assert [pose.degraded for pose in poses[10:]] == [
        "fast scans: one every 0.05 s, in training every 0.1 s"
    ] * 10


@pytest.mark.parametrize("unstamped", [[7], range(3, 23), range(1, 40, 2)])
def test_scans_without_stamps_among_others_count_once(recorder, unstamped):
    odometer = Odometer(PairTracker(recorder))
    for number, scan in enumerate(random_scans(40)):
        pose = odometer.step(scan, None if number in unstamped else PERIOD * number, ANGLES)
        assert pose.degraded == ""
    assert len(recorder.pairs) == 39


def test_wild_stamps_and_angles_do_not_raise(recorder):
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(8)
    drive(odometer, scans[:5])
    assert odometer.step(scans[5], 1e308, ANGLES).degraded.startswith("clock set: from 0.4 to 1e+308 s")
    odometer.reset()
    assert (
        "not finite, or too large to be angles" in odometer.step(scans[6], 0.0, np.full(181, 1e307)).degraded
    )


def test_one_scan_without_a_stamp_does_not_forget_the_others(recorder):
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(4)
    for scan, stamp in zip(scans[:3], (1.0, 1.1, None), strict=True):
        odometer.step(scan, stamp, ANGLES)
    assert "late scan" in odometer.step(scans[3], 0.5, ANGLES).degraded


def test_a_network_that_gives_nan_starts_anew(recorder):
    odometer, scans = Odometer(PairTracker(recorder)), random_scans(6)
    drive(odometer, scans[:4])
    recorder.step = np.array([np.nan, 0.0, 0.1])
    broken = odometer.step(scans[4], 0.4, ANGLES)
    assert broken.degraded == "no estimate: the last motion goes on"
    assert (length(broken), recorder.resets) == (pytest.approx(0.5), 2)
    del recorder.step
    assert odometer.step(scans[5], 0.5, ANGLES).degraded == ""


def test_without_stamps_the_order_counts():
    scans = random_scans(5)
    odometer = Odometer(PairTracker(Remembering()))
    expected = drive(Odometer(PairTracker(Remembering())), scans)
    for scan, pose in zip(scans, expected, strict=True):
        got = odometer.step(scan, float("nan"), ANGLES)
        assert (got.x, got.y, got.stamp, got.degraded) == (pose.x, pose.y, None, "")


def test_another_number_of_beams_is_told_and_goes_on(recorder):
    odometer = Odometer(PairTracker(recorder))
    drive(odometer, random_scans(3))
    pose = odometer.step(np.full(361, 5.0), 0.3)
    assert pose.degraded == "beam count: 361 after 181"
    assert length(pose) == pytest.approx(0.5)
    assert recorder.pairs[-1].shape == (2, 181)
    np.testing.assert_allclose(recorder.pairs[-1][1], 5.0)
    assert odometer.step(np.full(361, 5.0), 0.4).degraded == ""


def test_returns_alone_change_their_number_and_that_is_nothing(recorder):
    odometer, rng = Odometer(PairTracker(recorder)), np.random.default_rng(0)
    for number in range(20):
        returned = rng.random(181) < 0.9
        pose = odometer.step(np.full(returned.sum(), 5.0), 0.1 * number, ANGLES[returned])
        assert pose.degraded == ""
    twice = np.deg2rad(np.arange(-90.0, 90.5, 0.5))
    assert odometer.step(np.full(361, 5.0), 2.0, twice).degraded.startswith("beam count: 361 after")


def test_few_returns_are_told(recorder):
    odometer = Odometer(PairTracker(recorder))
    drive(odometer, random_scans(3))
    few = np.where(np.arange(181) < 60, 5.0, 0.0)
    pose = odometer.step(few, 0.3)
    assert pose.degraded == "few returns: 33.1% of the bins have one"
    assert len(recorder.pairs) == 3


def test_a_jittering_clock_is_no_gap(recorder):
    odometer, rng = Odometer(PairTracker(recorder)), np.random.default_rng(0)
    for number, scan in enumerate(random_scans(50)):
        pose = odometer.step(scan, PERIOD * number + rng.uniform(-0.02, 0.02), ANGLES)
        assert pose.degraded == ""


@pytest.mark.slow
def test_memory_does_not_grow(recorder):
    scans, odometer = random_scans(20), Odometer(PairTracker(recorder))
    recorder.pairs = type("", (), {"append": lambda self, pair: None})()
    drive(odometer, scans)
    tracemalloc.start()
    for round_ in range(1, 100):
        drive(odometer, scans, first=20 * round_)
        if round_ == 9:
            before = tracemalloc.get_traced_memory()[0]
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 20_000, "1,800 more scans of 724 bytes each"


def test_what_is_not_known_of_a_step_is_null_in_json(recorder):
    recorder.covariance = np.diag([0.25, np.nan, 0.01])
    pose = drive(Odometer(PairTracker(recorder)), random_scans(2))[1].as_dict()
    assert pose == json.loads(json.dumps(pose))
    assert list(pose) == ["stamp", "x", "y", "heading", "step", "covariance", "pose_covariance", "degraded"]
    assert pose["step"] == recorder.step.tolist()
    assert pose["covariance"] == [[0.25, 0.0, 0.0], [0.0, None, 0.0], [0.0, 0.0, 0.01]]


def test_a_held_step_of_unknown_size_is_known_of_nothing(recorder):
    recorder.description = replace(Recorder.description, typical_step=(0.6, np.nan, 0.03))
    odometer = Odometer(PairTracker(recorder))
    drive(odometer, random_scans(3))
    covariance = odometer.step(np.zeros(181), 0.3).step.covariance
    expected = [[0.36, np.nan, 0.0], [np.nan] * 3, [0.0, np.nan, 0.0009]]
    np.testing.assert_allclose(covariance, expected)


def test_scans_with_bearings_of_their_own(recorder):
    """The same beams clockwise, counter-clockwise, and beginning behind: one stream, nothing unusual."""
    odometer, values = Odometer(PairTracker(recorder)), random_scans(4).astype(np.float64)
    poses = [
        odometer.step(Scan(values[0], ANGLES, stamp=0.0)),
        odometer.step(Scan(values[1][::-1], ANGLES[::-1], stamp=0.1)),
        odometer.step(Scan(np.roll(values[2], 90)[1:], np.roll(ANGLES, 90)[1:], stamp=0.2)),
        odometer.step(replace(Scan(values[3], ANGLES), has_all_beams=False)),
    ]
    assert [pose.degraded for pose in poses] == [""] * 4
    assert [pose.stamp for pose in poses] == [0.0, 0.1, 0.2, None]
    np.testing.assert_allclose(recorder.pairs[0], values[:2], rtol=1e-6)


def test_points_say_nothing_of_the_beams(recorder):
    odometer, rng = Odometer(PairTracker(recorder)), np.random.default_rng(0)
    for number in range(10):
        bearings = np.sort(rng.uniform(-1.5, 1.5, 181 - number))
        points = 5 * np.column_stack([np.cos(bearings), np.sin(bearings)])
        assert "beam count" not in odometer.step(points, 0.1 * number).degraded


def test_returns_are_those_of_the_last_scan_alone(recorder):
    odometer = Odometer(PairTracker(recorder))
    assert odometer.returns().shape == (0, 2)
    wall = np.full(181, 5.0)
    pose = drive(odometer, [wall, wall])[-1]
    seen = odometer.returns()
    np.testing.assert_allclose(np.hypot(*(seen - [pose.x, pose.y]).T), 5.0, atol=1e-5)
    odometer.step(wall, 0.05)
    assert odometer.returns().shape == (0, 2), "a late scan was taken elsewhere"
    odometer.step(np.zeros(181), 0.2)
    assert odometer.returns().shape == (0, 2), "nothing was seen from there"
    after = odometer.step(wall, 0.3)
    assert "gap" in after.degraded
    np.testing.assert_allclose(np.hypot(*(odometer.returns() - [after.x, after.y]).T), 5.0, atol=1e-5)


def test_a_checkpoint_says_that_it_is_exported_first():
    with pytest.raises(
        InputError, match=r"best\.ckpt: .*rcnn-odom export best\.ckpt.*load_odometer\('best\.ckpt'\)"
    ):
        Odometer.from_checkpoint("best.ckpt")


@pytest.mark.parametrize(
    ("scan", "angles"),
    [
        (np.zeros((2, 2, 2)), None),
        (np.zeros((2, 1)), None),
        (np.ones(5), np.zeros(1)),
        (np.ones(5), np.zeros(6)),
        (3.0, None),
    ],
)
def test_shapes_that_are_no_scan(recorder, scan, angles):
    with pytest.raises(ValueError, match=r"a scan has ranges|points are"):
        Odometer(PairTracker(recorder)).step(scan, angles=angles)


def test_a_file_of_another_sensor_is_refused():
    sensor = Odometer.from_onnx("all_round").sensor
    assert Odometer.from_onnx("all_round", sensor=sensor)
    with pytest.raises(InputError, match=r"trained for .*360.*, not .*180"):
        Odometer.from_onnx("all_round", sensor=Sensor(1.0, 180.0, 40.0))


# --- poses of a robot, and how far off they are -----------------------------------------------------


class AnyLaser:
    """A model of whole scans that always answers the same."""

    period = float("nan")
    step = Step(0.4, -0.1, 0.3, np.diag([0.02, 0.01, 0.005]) ** 2)

    def __init__(self):
        self.reset()

    def reset(self):
        self.has_seen, self.scan = False, None

    def begin(self, scan):
        self.has_seen, self.scan = True, scan
        return ()

    def register(self, scan, periods=1, seconds=None):
        self.scan = scan
        return Registered(self.step, is_estimated=periods == 1)

    def returns(self):
        ranges, bearings = self.scan.ranges, self.scan.bearings
        return np.column_stack([ranges * np.cos(bearings), ranges * np.sin(bearings)])


def test_the_covariance_of_a_pose_is_that_of_its_steps():
    odometer = Odometer(AnyLaser())
    poses = drive(odometer, random_scans(6))
    covariance, pose = np.zeros((3, 3)), np.zeros(3)
    np.testing.assert_array_equal(poses[0].covariance, covariance)
    for each in poses[1:]:
        covariance = compound_covariance(pose, covariance, AnyLaser.step)
        pose = advance(pose, AnyLaser.step.array())
        np.testing.assert_allclose(each.covariance, covariance)
    assert (np.diff([np.trace(each.covariance) for each in poses]) > 0).all()
    late = odometer.step(random_scans(1)[0], 0.2, ANGLES)
    np.testing.assert_array_equal(late.covariance, covariance)
    assert odometer.estimates == 5
    unknown = odometer.step(random_scans(1)[0], 1e6, ANGLES)
    assert np.isnan(unknown.covariance).all(), "after a set clock nobody knows"
    assert np.isnan(odometer.step(random_scans(1)[0], 1e6 + 0.1, ANGLES).covariance).all()
    odometer.reset()
    assert not odometer.step(random_scans(1)[0], 0.0, ANGLES).covariance.any()


def test_the_robot_moves_where_its_laser_does_not():
    """By products of matrices: the laser sits ahead and aside, and looks backwards."""
    laser_pose = (0.6, -0.2, 3.0)
    odometer = Odometer(AnyLaser(), laser_pose)
    wall = np.full(181, 5.0)
    on_robot, step = planar_to_poses([laser_pose, AnyLaser.step.array()])
    robot = np.eye(4)
    for number, pose in enumerate(drive(odometer, [wall] * 5)):
        if number:
            robot = robot @ on_robot @ step @ np.linalg.inv(on_robot)
        np.testing.assert_allclose(pose.matrix(), robot, atol=1e-12)
    laser = robot @ on_robot
    expected = laser[:2, 3] + 5 * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)]) @ laser[:2, :2].T
    np.testing.assert_allclose(odometer.returns(), expected, atol=1e-5)
    moved = planar_to_poses(pose.step.array()[None])[0]
    np.testing.assert_allclose(np.linalg.inv(on_robot) @ moved @ on_robot, step, atol=1e-12)
    assert pose.step.covariance[1, 1] > AnyLaser.step.covariance[1, 1], "the turn moves the robot too"


def test_any_laser_has_to_say_where_its_beams_lie():
    odometer = Odometer(AnyLaser())
    with pytest.raises(ValueError, match="give the angles of the beams"):
        odometer.step(np.full(181, 5.0))
    assert (odometer.beam_check, odometer.sensor) == (None, None)
    assert Odometer(PairTracker(Recorder())).sensor == Recorder.description.sensor


def test_the_default_is_scan_matching_and_costs_nothing_to_import():
    heavy = "{'torch', 'numba', 'scipy', 'onnxruntime'} & sys.modules.keys()"
    code = f"""import sys
from rcnn_odom.deployment.odometer import Odometer
assert not {heavy}, {heavy}
assert type(Odometer().tracker).__name__ == "MatcherTracker"
assert "torch" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
