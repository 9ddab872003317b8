"""Steps and their composition, by hand."""

from math import cos, pi, sin

import numpy as np
import pytest

from rcnn_odom.geometry import (
    FORWARD_CAMERA,
    AccumulatedCovariance,
    Step,
    Steps,
    advance,
    change_frame,
    change_step_frame,
    compose,
    compound_covariance,
    motions_of,
    planar_to_poses,
    poses_to_planar,
    relative_steps,
    turn_to_middle,
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


def by_differences(function, at):
    """The Jacobian of a function of three numbers."""
    return np.transpose([(function(at + h) - function(at - h)) / 2e-6 for h in 1e-6 * np.eye(3)])


def random_covariance(seed):
    root = np.random.default_rng(seed).normal(0, 0.1, (3, 3))
    return root @ root.T


@pytest.mark.parametrize("seed", range(5))
def test_covariances_are_carried_as_differences_of_matrices_do(seed):
    rng = np.random.default_rng(seed)
    pose, step, on_robot = rng.normal(0, 1, (3, 3))
    of_pose, of_step = random_covariance(seed), random_covariance(seed + 50)

    def after(pose, step):
        return poses_to_planar(planar_to_poses([pose]) @ planar_to_poses([step]))[0]

    by_pose = by_differences(lambda value: after(value, step), pose)
    by_step = by_differences(lambda value: after(pose, value), step)
    np.testing.assert_allclose(
        compound_covariance(pose, of_pose, Step(*step, of_step)),
        by_pose @ of_pose @ by_pose.T + by_step @ of_step @ by_step.T,
        atol=1e-7,
    )

    def of_robot(step):
        matrix = planar_to_poses([on_robot])
        return poses_to_planar(matrix @ planar_to_poses([step]) @ np.linalg.inv(matrix))[0]

    moved = change_step_frame(Step(*step, of_step), tuple(on_robot))
    np.testing.assert_allclose(moved.array(), of_robot(step), atol=1e-12)
    jacobian = by_differences(of_robot, step)
    np.testing.assert_allclose(moved.covariance, jacobian @ of_step @ jacobian.T, atol=1e-7)

    def in_middle(step):
        half = planar_to_poses([[0, 0, step[2] / 2]])[0, :2, :2]
        return np.append(half.T @ step[:2], step[2])

    turned = turn_to_middle(Step(*step, of_step))
    np.testing.assert_allclose(turned.array(), in_middle(step), atol=1e-12)
    jacobian = by_differences(in_middle, step)
    np.testing.assert_allclose(turned.covariance, jacobian @ of_step @ jacobian.T, atol=1e-7)


def test_what_is_unknown_spreads_to_what_depends_on_it_alone():
    heading_only = np.full((3, 3), np.nan)
    heading_only[2, 2] = 0.04
    found = compound_covariance(np.zeros(3), np.eye(3), Step(1.0, 0.0, 0.0, heading_only))
    assert found[2, 2] == pytest.approx(1.04)
    assert np.isnan(found[:2]).all()
    assert np.isnan(compound_covariance(np.zeros(3), np.eye(3), Step(0.0, 0.0, 0.0))).all()


def test_accumulated_covariances_are_those_of_many_drives():
    """Monte Carlo: the ends of 20,000 drives whose steps err at random."""
    rng = np.random.default_rng(0)
    steps = np.tile([0.5, 0.02, 0.05], (12, 1))
    noise = np.diag([0.02, 0.01, 0.01]) ** 2
    ends = np.zeros((20000, 3))
    for step in steps:
        moves = step + rng.normal(0, np.sqrt(np.diag(noise)), ends.shape)
        c, s = np.cos(ends[:, 2]), np.sin(ends[:, 2])
        ends += np.stack(
            [c * moves[:, 0] - s * moves[:, 1], s * moves[:, 0] + c * moves[:, 1], moves[:, 2]], 1
        )
    pose, covariance = np.zeros(3), np.zeros((3, 3))
    for step in steps:
        covariance = compound_covariance(pose, covariance, Step(*step, noise))
        pose = advance(pose, step)
    expected = np.cov(ends.T)
    np.testing.assert_allclose(covariance, expected, atol=0.05 * expected.max())


def step_with_noise(step, drift, noise):
    """The step between two poses of a map: each has the noise, and the map drifts."""
    lever, turned = np.eye(3), np.eye(3)
    lever[:2, 2] = -step[1], step[0]
    turned[:2, :2] = planar_to_poses([step])[0, :2, :2]
    return Step(*step, drift + lever @ noise @ lever.T + turned @ noise @ turned.T, noise)


@pytest.mark.parametrize("on_robot", [None, (0.8, -0.3, 2.0)])
def test_errors_that_are_taken_back_do_not_add_up(on_robot):
    """Monte Carlo: 20,000 drives through a map, whose poses err by much more than the map drifts."""
    rng, count = np.random.default_rng(0), 20000
    step, drift = np.array([0.5, 0.02, 0.05]), np.diag([0.004, 0.003, 0.002]) ** 2
    noise = np.diag([0.03, 0.02, 0.01]) ** 2
    moved = planar_to_poses(step + rng.normal(0, np.sqrt(np.diag(drift)), (30, count, 3)).reshape(-1, 3))
    moved = moved.reshape(30, count, 4, 4)
    poses, total, at = np.tile(np.eye(4), (count, 1, 1)), AccumulatedCovariance(), np.zeros(3)
    told = step_with_noise(step, drift, noise)
    turned = np.eye(3)
    turned[:2, :2] = planar_to_poses([step])[0, :2, :2]
    first = Step(*step, drift + turned @ noise @ turned.T, noise)  # the first pose is the map's
    for number, each in enumerate(moved):
        poses = poses @ each
        made = told if number else first
        made = made if on_robot is None else change_step_frame(made, on_robot)
        total.add(at, made)
        at = advance(at, made.array())
    poses = poses @ planar_to_poses(rng.normal(0, np.sqrt(np.diag(noise)), (count, 3)))
    if on_robot is not None:
        mount = planar_to_poses([on_robot])[0]
        poses = mount @ poses @ np.linalg.inv(mount)
    ends = poses_to_planar(poses)
    np.testing.assert_allclose(at[:2], ends.mean(0)[:2], atol=0.02)
    expected = np.cov((ends - ends.mean(0)).T)
    np.testing.assert_allclose(total.value, expected, atol=0.05 * expected.max())
    adding = np.zeros((3, 3))
    for _ in range(30):
        adding = compound_covariance(np.zeros(3), adding, told)
    assert adding[2, 2] > 3 * expected[2, 2], "as if all errors were independent"


def test_more_taken_back_than_there_is_leaves_a_covariance():
    total = AccumulatedCovariance()
    for _ in range(5):
        total.add(np.zeros(3), Step(0.1, 0.0, 0.0, 1e-6 * np.eye(3), 1e-4 * np.eye(3)))
        assert np.linalg.eigvalsh(total.value).min() > 0
    total.add(np.zeros(3), Step(0.1, 0.0, 0.0))
    assert np.isnan(total.value).all()
