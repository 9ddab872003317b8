"""The Kalman filter of a motion, against textbook equations in one dimension and against drawn errors."""

import math

import numpy as np
import pytest

from rcnn_odom.geometry import advance, relative_step
from rcnn_odom.models.motion_filter import MotionFilter

CHANGE, TYPICAL = np.array([0.05, 0.02, 0.003]), np.array([1.0, 0.05, 0.02])


def correct(motion_filter, residual, covariance, periods=1):
    """The correction by a measurement, the covariance of the step, and the part of it that is taken back."""
    weighed = motion_filter.weigh(residual, covariance, periods)
    return weighed.correction, *motion_filter.correct(weighed)


def textbook(measured, noise, change, first):
    """Poses along x of a filter of position and velocity, written with its usual matrices.

    Where nothing was measured, nan, it predicts alone.
    """
    transition, seen = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    state, covariance = np.zeros(2), np.diag([0.0, (2 * first) ** 2])
    poses = []
    for place in measured:
        # The velocity changes before it is driven.
        covariance = covariance + np.diag([0.0, change**2])
        state, covariance = transition @ state, transition @ covariance @ transition.T
        if not math.isnan(place):
            gain = covariance @ seen.T / (seen @ covariance @ seen.T + noise**2)
            state = state + gain[:, 0] * (place - state[0])
            covariance = covariance - gain @ seen @ covariance
        poses.append((state[0], covariance[0, 0]))
    return np.array(poses)


def test_along_a_line_it_is_the_textbooks():
    rng = np.random.default_rng(0)
    measured = np.cumsum(1.0 + 0.05 * rng.standard_normal(30)) + 0.3 * rng.standard_normal(30)
    expected = textbook(measured, 0.3, CHANGE[0], TYPICAL[0])
    one, pose, got = MotionFilter(CHANGE, TYPICAL), np.zeros(3), []
    for place in measured:
        guess = advance(pose, one.motion)
        believed, _, _ = correct(one, np.array([place - guess[0], 0.0, 0.0]), np.diag([0.09, 1e-4, 1e-6]))
        pose = advance(guess, believed)
        got.append((pose[0], one.pose_covariance[0, 0]))
    assert np.allclose(got, expected, rtol=1e-6)


@pytest.mark.parametrize("lost", [[7], [7, 8, 9, 10], [3, 12, 13, 20]])
def test_scans_that_are_missing_or_show_nothing_are_the_textbooks_predictions(lost):
    rng = np.random.default_rng(0)
    measured = np.cumsum(1.0 + 0.05 * rng.standard_normal(30)) + 0.3 * rng.standard_normal(30)
    measured[lost] = math.nan
    expected = textbook(measured, 0.3, CHANGE[0], TYPICAL[0])
    missing, empty = MotionFilter(CHANGE, TYPICAL), MotionFilter(CHANGE, TYPICAL)
    poses, periods = [np.zeros(3), np.zeros(3)], 1
    for place, textbook_pose in zip(measured, expected, strict=True):
        if math.isnan(place):
            periods += 1
            poses[1] = advance(poses[1], empty.displacement())
            empty.predict()
            continue
        for number, (one, so_many) in enumerate(((missing, periods), (empty, 1))):
            guess = advance(poses[number], one.displacement(so_many))
            residual = np.array([place - guess[0], 0.0, 0.0])
            believed, _, _ = correct(one, residual, np.diag([0.09, 1e-4, 1e-6]), so_many)
            poses[number] = advance(guess, believed)
            assert np.allclose((poses[number][0], one.pose_covariance[0, 0]), textbook_pose, rtol=1e-6)
        periods = 1


def test_what_is_measured_surely_is_believed_whole():
    one = MotionFilter(CHANGE, TYPICAL)
    residual, noise = np.array([0.9, 0.1, 0.05]), np.diag([1e-8, 1e-8, 1e-10])
    believed, step, taken = correct(one, residual, noise)
    assert np.allclose(believed, residual, atol=1e-5)
    assert np.allclose(np.diag(step), [1e-8, 1e-8, 1e-10], rtol=1e-3)
    assert np.allclose(np.diag(taken), [1e-8, 1e-8, 1e-10], rtol=1e-3)
    assert one.motion == pytest.approx(residual, abs=1e-4)


def test_what_is_not_seen_goes_on_and_gets_less_sure():
    one = MotionFilter(CHANGE, TYPICAL)
    for _ in range(5):
        correct(one, np.array([1.0, 0.0, 0.0]) - one.motion, np.diag([1e-4, 1e-4, 1e-6]))
    motion, deviations = one.motion, []
    for _ in range(100):
        # Nothing is seen along x, and what the network says there is always a little too far.
        _, step, _ = correct(one, np.array([0.02, 0.0, 0.0]), np.diag([0.5, 1e-4, 1e-6]))
        deviations.append(math.sqrt(step[0, 0]))
    assert one.motion[0] - motion[0] < 0.2  # where taking all of it up would add 2
    assert deviations[50] > 2 * deviations[0]


@pytest.mark.parametrize("motion", [(1.0, 0.0, 0.0), (1.0, 0.1, 0.15), (-0.5, 0.0, -0.3)])
def test_a_prediction_over_periods_is_as_many_predictions(motion):
    at_once, one_by_one = MotionFilter(CHANGE, TYPICAL), MotionFilter(CHANGE, TYPICAL)
    for each in (at_once, one_by_one):
        correct(each, np.array(motion), np.diag([1e-3, 1e-3, 1e-5]))
        correct(each, np.zeros(3), np.diag([1e-3, 1e-3, 1e-5]))
    displacement, pose = at_once.displacement(7), np.zeros(3)
    at_once.predict(7)
    for _ in range(7):
        pose = advance(pose, one_by_one.displacement())
        one_by_one.predict()
    assert np.allclose(displacement, pose)
    assert np.allclose(at_once.pose_covariance, one_by_one.pose_covariance, rtol=1e-9)
    # And so are the covariances with the motion, which decide what the next measurement corrects.
    corrected = [correct(each, np.full(3, 0.1), np.diag([1e-3] * 3)) for each in (at_once, one_by_one)]
    for first, second in zip(*corrected, strict=True):
        assert np.allclose(first, second, rtol=1e-9)
    assert np.allclose(at_once.motion, one_by_one.motion, rtol=1e-9)


def test_a_long_prediction_of_a_turning_laser_has_the_covariance_of_drawn_errors():
    """Ten periods of 9 degrees each, without a measurement; linear errors, so that few draws tell."""
    rng = np.random.default_rng(0)
    change, first, motion = np.array([3e-3, 1e-3, 4e-4]), np.array([5e-3, 1e-3, 1e-3]), (1.0, 0.0, 0.15)
    one = MotionFilter(change, first / 2)
    one.motion = np.array(motion)
    one.predict(10)
    ends = []
    for _ in range(4000):
        pose, drawn = np.zeros(3), motion + first * rng.standard_normal(3)
        for _ in range(10):
            drawn = drawn + change * rng.standard_normal(3)
            pose = advance(pose, drawn)
        ends.append(pose)
    exact = np.zeros(3)
    for _ in range(10):
        exact = advance(exact, np.array(motion))
    errors = np.array([relative_step(exact, end) for end in ends])
    assert np.allclose(np.sqrt(np.mean(errors**2, 0)), np.sqrt(np.diag(one.pose_covariance)), rtol=0.05)


@pytest.mark.parametrize("periods", [(1, 1, 1, 1, 1, 1), (1, 1, 3, 1, 1, 2), (1, 1, 10, 1, 8, 1)])
def test_covariances_are_those_of_drawn_errors(periods):
    """Steps and poses beside a key of 3,000 drives that turn, over the deviations that the filter gave."""
    rng = np.random.default_rng(1)
    change, noise = np.array([0.03, 0.01, 0.004]), np.array([0.05, 0.2, 0.01])
    steps, poses = [], []
    for _ in range(3000):
        one = MotionFilter(change, TYPICAL)
        motion = 2 * TYPICAL * rng.standard_normal(3) * [1, 1, 0.2]
        true, pose = np.zeros(3), np.zeros(3)
        for so_many in periods:
            before_true = true
            for _ in range(so_many):
                motion = motion + change * rng.standard_normal(3)
                true = advance(true, motion)
            guess = advance(pose, one.displacement(so_many))
            measured = advance(true, noise * rng.standard_normal(3))
            believed, step, _ = correct(one, relative_step(guess, measured), np.diag(noise**2), so_many)
            before, pose = pose, advance(guess, believed)
        steps.append(
            (relative_step(before, pose) - relative_step(before_true, true)) / np.sqrt(np.diag(step))
        )
        poses.append(relative_step(true, pose) / np.sqrt(np.diag(one.pose_covariance)))
    assert np.sqrt(np.mean(np.square(steps), axis=0)) == pytest.approx([1, 1, 1], abs=0.15)
    assert np.sqrt(np.mean(np.square(poses), axis=0)) == pytest.approx([1, 1, 1], abs=0.15)
