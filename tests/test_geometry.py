"""Steps and their composition, by hand."""

from math import cos, pi, sin

import numpy as np
import pytest

from rcnn_odom.geometry import (
    FORWARD_CAMERA,
    Steps,
    advance,
    change_frame,
    compose,
    motions_of,
    planar_to_poses,
    poses_to_planar,
    relative_steps,
    wrap_angle,
)


def random_steps(seed, frames=200):
    rng = np.random.default_rng(seed)
    return rng.normal([0.5, 0.0, 0.0], [1.0, 0.3, 0.5], (frames, 3))


def random_rigid(seed):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    pose[:3, 3] = rng.normal(size=3)
    return pose


def test_composition_equals_products_of_matrices():
    steps = random_steps(0)
    pose, expected = np.eye(4), [np.eye(4)]
    for x, y, heading in steps:
        step = [
            [cos(heading), -sin(heading), 0, x],
            [sin(heading), cos(heading), 0, y],
            [0, 0, 1, 0],
            [0, 0, 0, 1],
        ]
        pose = pose @ step
        expected.append(pose)
    np.testing.assert_allclose(compose(steps), expected, atol=1e-10)
    np.testing.assert_array_equal(Steps.with_unknown_covariance(steps).poses(), compose(steps))


def test_one_step_at_a_time_equals_composition():
    steps, pose = random_steps(1), np.zeros(3)
    for step in steps:
        pose = advance(pose, step)
    np.testing.assert_allclose(planar_to_poses(pose[None])[0], compose(steps)[-1], atol=1e-10)


def test_steps_survive_composition():
    steps = random_steps(2)
    steps[:, 2] = wrap_angle(steps[:, 2])
    np.testing.assert_allclose(relative_steps(compose(steps)), steps, atol=1e-10)


def test_steps_do_not_depend_on_the_world():
    poses = compose(random_steps(4))
    moved = random_rigid(5) @ poses
    np.testing.assert_allclose(relative_steps(moved), relative_steps(poses), atol=1e-10)


def test_unknown_covariances_are_nan():
    assert np.isnan(Steps.with_unknown_covariance(random_steps(3)).covariances).all()


@pytest.mark.parametrize("heading", [0.0, 1.0, pi / 2, 3.0, -2.5])
def test_reversing_is_a_negative_distance(heading):
    ahead = np.array([cos(heading), sin(heading)])
    planar = [[3, 4, heading], [*(np.array([3, 4]) - 0.7 * ahead), heading]]
    np.testing.assert_allclose(motions_of(relative_steps(planar_to_poses(planar))), [(-0.7, 0)], atol=1e-12)


def test_distance_is_the_projection_on_the_heading_in_mid_turn():
    # A chord of a circle points where the heading is in mid-turn: it counts as a whole.
    chord = 2 * 10 * sin(0.1)
    np.testing.assert_allclose(
        motions_of([chord * cos(0.1), chord * sin(0.1), 0.2]), [chord, 0.2], atol=1e-12
    )
    # What goes sideways to it does not count.
    np.testing.assert_allclose(motions_of([-sin(0.1), cos(0.1), 0.2]), [0, 0.2], atol=1e-12)


def test_distance_is_continuous_for_a_laser_off_the_axis_of_a_turning_robot():
    # 0.3 m ahead of the axis, turning on the spot by growing angles either way.
    turns = np.linspace(-0.5, 0.5, 2001)
    steps = np.stack([0.3 * np.cos(turns) - 0.3, 0.3 * np.sin(turns), turns], axis=1)
    distances = motions_of(steps)[:, 0]
    assert np.abs(np.diff(distances)).max() < 1e-6  # the sign of x alone would jump by 0.3 m
    np.testing.assert_allclose(distances, 0, atol=1e-12)


def test_noise_hardly_changes_the_distance_of_a_robot_that_turns_on_the_spot():
    rng = np.random.default_rng(0)
    turn = 0.3
    steps = np.array([0.3 * cos(turn) - 0.3, 0.3 * sin(turn), turn]) + rng.normal(
        0, [0.02, 0.02, 0], (500, 3)
    )
    assert np.abs(motions_of(steps)[:, 0]).max() < 0.1


def test_turn_across_the_seam_is_small():
    planar = [[0, 0, pi - 0.1], [0, 0, -pi + 0.1]]
    np.testing.assert_allclose(relative_steps(planar_to_poses(planar))[:, 2], [0.2], atol=1e-12)


def test_wrapped_angles_lie_in_one_turn():
    angles = np.linspace(-20, 20, 997)
    wrapped = wrap_angle(angles)
    assert ((wrapped >= -pi) & (wrapped < pi)).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-12)


def test_planar_rows_survive_poses():
    rng = np.random.default_rng(6)
    planar = np.stack([*rng.normal(0, 50, (2, 40)), rng.uniform(-pi, pi, 40)], axis=1)
    np.testing.assert_allclose(poses_to_planar(planar_to_poses(planar)), planar, atol=1e-12)


def test_forward_camera_sees_ahead_as_z_and_left_as_minus_x():
    np.testing.assert_array_equal(FORWARD_CAMERA @ [1, 0, 0, 1], [0, 0, 1, 1])
    np.testing.assert_array_equal(FORWARD_CAMERA @ [0, 1, 0, 1], [-1, 0, 0, 1])
    np.testing.assert_array_equal(FORWARD_CAMERA @ [0, 0, 1, 1], [0, -1, 0, 1])


def test_changed_frame_sees_the_same_points():
    camera_from_laser, laser_pose, point = random_rigid(7), random_rigid(8), np.array([1.0, 2.0, 3.0, 1.0])
    [camera_pose] = change_frame(laser_pose[None], camera_from_laser)
    # A point in the laser's frame, taken into the first frame by either sensor.
    by_laser = camera_from_laser @ (laser_pose @ point)
    by_camera = camera_pose @ (camera_from_laser @ point)
    np.testing.assert_allclose(by_camera, by_laser, atol=1e-12)
    back = change_frame(camera_pose[None], np.linalg.inv(camera_from_laser))
    np.testing.assert_allclose(back[0], laser_pose, atol=1e-12)
