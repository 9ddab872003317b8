"""A laser that moves while it turns, against each of its beams cast alone, from where it is then."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rcnn_odom.geometry import planar_to_poses
from rcnn_odom.simulation.beams import EvenBeams
from rcnn_odom.simulation.drawing import upright_walls
from rcnn_odom.simulation.laser import Laser
from rcnn_odom.simulation.raycast import cast, cast_each
from rcnn_odom.simulation.scene import NO_WALLS, Material, Scene, Walls, join
from rcnn_odom.simulation.sweep import poses_at, ring_times
from rcnn_odom.simulation.terrain import Ground

NOWHERE = np.zeros(2, dtype=np.int64)
LOW, HIGH = np.array([-4.0, -3.0]), np.array([7.0, 5.0])
"""Corners of the box room."""


def box_room() -> Scene:
    (x1, y1), (x2, y2) = LOW, HIGH
    ends = np.array([[x1, y1, x2, y1], [x2, y1, x2, y2], [x2, y2, x1, y2], [x1, y2, x1, y1]])
    return Scene(upright_walls(ends, Material()), NO_WALLS, NOWHERE)


def range_in_box(x, y, direction):
    """Metres to the walls of the box room: the first of the lines that a ray from inside crosses."""
    unit = np.array([np.cos(direction), np.sin(direction)])
    walls = np.where(unit > 0, HIGH, LOW)
    with np.errstate(divide="ignore"):
        return np.min((walls - [x, y]) / unit)


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_scan_in_a_box_room_is_what_each_beam_sees_from_its_own_pose(clockwise) -> None:
    """At 1.5 m/s, 90 degrees a second and five turns a second; to the micrometre."""
    beams, rate, period = EvenBeams(0.5, 360.0, clockwise=clockwise), 5.0, 0.25
    planar = np.array([[0.5, -0.4, 0.3], [0.8, -0.2, 0.3 + np.deg2rad(22.5)]])
    stamps = np.array([10.0, 10.0 + period])
    times = beams.times(0, rate)
    poses = poses_at(planar_to_poses(planar), stamps, stamps[0] + times)
    laser = Laser(0.5, noise=0.0, max_range=30.0)
    bearings = beams.bearings(0)
    ranges = laser.shoot(box_room(), 0, poses, bearings, np.random.default_rng(0), missing=False)
    sign = -1 if clockwise else 1
    for beam in range(720):
        share = beam * 0.5 / 360 / rate / period
        x, y, heading = planar[0] + share * (planar[1] - planar[0])
        expected = range_in_box(x, y, heading + sign * np.deg2rad(beam * 0.5 - 180))
        assert abs(ranges[beam] - expected) < 1e-6
    at_once = laser.shoot(
        box_room(), 0, planar_to_poses(planar[:1])[0], bearings, np.random.default_rng(0), missing=False
    )
    assert np.abs(at_once - ranges).max() > 0.1


def cluttered(rng, count=60) -> tuple[Walls, Ground]:
    """Small walls of many heights all about, some of them close, over hills that some beams meet."""
    middles = rng.normal(0, 12, (count, 2))
    half = rng.normal(0, 1, (count, 2))
    middles = middles[np.hypot(*middles.T) > 0.7]
    ends = np.concatenate([middles - half[: len(middles)], middles + half[: len(middles)]], axis=1)
    low = rng.uniform(-2, 1, len(ends))
    heights = np.stack([low, low + rng.uniform(0.1, 3, len(ends))], axis=1)
    rest = np.ones(len(ends))
    hills = Ground(np.full(2, -60.0), 10.0, rng.normal(-1.2, 0.4, (13, 13)))
    return join([Walls(ends, heights, rest, 0 * rest)]), hills


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("apart", [0.0, 0.05, 1.5])
def test_many_origins_give_what_each_beam_gives_alone(seed, apart) -> None:
    rng = np.random.default_rng(seed)
    walls, ground = cluttered(rng)
    azimuth = rng.permutation(np.linspace(0, 2 * np.pi, 300, endpoint=False))
    slope = rng.normal(-0.01, 0.02, 300)
    directions = np.stack([np.cos(azimuth), np.sin(azimuth), slope], axis=1) * rng.uniform(0.5, 2, (300, 1))
    origins = apart * rng.uniform(-0.5, 0.5, (300, 3)) * [1, 1, 0.1]
    depth, hit, squareness = cast_each(walls, ground, origins, directions, 40.0)
    alone = [cast(walls, ground, o, d[None], 40.0) for o, d in zip(origins, directions, strict=True)]
    np.testing.assert_array_equal(hit, [one[1][0] for one in alone])
    np.testing.assert_allclose(depth, [one[0][0] for one in alone], rtol=1e-9)
    np.testing.assert_allclose(squareness, [one[2][0] for one in alone], atol=1e-9)
    assert np.mean(hit >= 0) > 0.1
    assert np.mean(hit < 0) > 0.1


def test_no_beams_and_no_walls() -> None:
    none, three = np.zeros((0, 3)), np.eye(3)[[0, 1, 0]]
    assert len(cast_each(NO_WALLS, None, none, none, 10.0)[0]) == 0
    assert np.isinf(cast_each(NO_WALLS, None, np.zeros((3, 3)), three, 10.0)[0]).all()


def test_poses_between_frames_go_straight_and_turn_evenly() -> None:
    """Against SciPy's rotations by the angle that a vector says, and the straight line."""
    rng = np.random.default_rng(0)
    poses = np.tile(np.eye(4), (3, 1, 1))
    turns = [np.zeros(3), np.array([0.02, -0.01, 0.4]), np.array([0.0, 0.1, -0.2])]
    for frame in (1, 2):
        poses[frame, :3, :3] = poses[frame - 1, :3, :3] @ Rotation.from_rotvec(turns[frame]).as_matrix()
        poses[frame, :3, 3] = poses[frame - 1, :3, 3] + rng.normal(0, 1, 3)
    stamps = np.array([0.0, 0.1, 0.3])
    for moment, start, share in (
        (0.0, 0, 0.0),
        (0.025, 0, 0.25),
        (0.1, 1, 0.0),
        (0.2, 1, 0.5),
        (0.4, 1, 1.5),
        (-0.05, 0, -0.5),
    ):
        found = poses_at(poses, stamps, np.array([moment]))[0]
        turned = Rotation.from_rotvec(share * turns[start + 1]).as_matrix()
        np.testing.assert_allclose(found[:3, :3], poses[start, :3, :3] @ turned, atol=1e-9)
        line = poses[start, :3, 3] + share * (poses[start + 1, :3, 3] - poses[start, :3, 3])
        np.testing.assert_allclose(found[:3, 3], line, atol=1e-9)


def test_a_ring_looks_behind_ahead_and_behind_clockwise() -> None:
    azimuth = np.deg2rad([180.0, 90.0, 0.0, 270.0, 181.0])
    expected = [-0.05, -0.025, 0.0, 0.025, 0.1 * 179 / 360]
    np.testing.assert_allclose(np.abs(ring_times(azimuth, 10.0)), np.abs(expected), atol=1e-9)
    np.testing.assert_allclose(ring_times(azimuth, 10.0)[1:], expected[1:], atol=1e-9)
