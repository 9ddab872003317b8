"""Hills, and how a car stands on them, against SciPy's interpolation and rotations and against physics."""

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.terrain import HILLINESS_DEG, Ground, flat_ground, place_on_ground, random_ground

CORNER = np.array([-100.0, -100.0])
LEVEL = np.zeros((1, 2))


def plane(east: float, north: float) -> Ground:
    """Ground that rises so many metres a metre."""
    x, y = (CORNER + 10.0 * np.arange(21)[:, None]).T
    return Ground(CORNER, 10.0, east * x[:, None] + north * y)


def rotation(heading: float, tilt: FloatArray = LEVEL, ground: Ground | None = None) -> FloatArray:
    ground = ground or flat_ground(CORNER, -CORNER)
    return place_on_ground(np.array([[3.0, -4.0, heading]]), tilt, 1.73, ground)[0, :3, :3]


def test_heights_equal_scipys() -> None:
    rng = np.random.default_rng(0)
    ground = random_ground(np.array([-70.0, 20.0]), np.array([130.0, 90.0]), rng)
    axes = [ground.corner[i] + ground.step * np.arange(n) for i, n in enumerate(ground.heights.shape)]
    expected = RegularGridInterpolator(axes, ground.heights, bounds_error=False, fill_value=None)
    points = rng.uniform([-90, 0], [150, 110], (500, 2))  # some beyond the rim
    np.testing.assert_allclose(ground.at(points), expected(points), atol=1e-9)


def test_grid_covers_what_it_was_asked_for() -> None:
    low, high = np.array([-71.0, 23.0]), np.array([133.0, 91.0])
    for ground in (random_ground(low, high, np.random.default_rng(0)), flat_ground(low, high)):
        far = ground.corner + ground.step * (np.array(ground.heights.shape) - 1)
        assert (ground.corner <= low).all()
        assert (far >= high).all()
    assert not flat_ground(low, high).heights.any()


def test_slopes_are_of_the_promised_size() -> None:
    """Over worlds, their standard deviations run over the range; within one, they are alike in x and y."""
    low, high = np.zeros(2), np.full(2, 1000.0)
    deviations = []
    for seed in range(200):
        heights = random_ground(low, high, np.random.default_rng(seed)).heights
        slopes = [np.diff(heights, axis=axis) / 5.0 for axis in range(2)]
        deviations.append(np.rad2deg(np.sqrt(np.mean([np.mean(slope**2) for slope in slopes]))))
    middle = np.exp(np.mean(np.log(HILLINESS_DEG)))
    assert 0.8 * middle < np.median(deviations) < 1.25 * middle
    assert 0.6 * HILLINESS_DEG[0] < min(deviations) < 1.5 * HILLINESS_DEG[0]
    assert 0.7 * HILLINESS_DEG[1] < max(deviations) < 1.5 * HILLINESS_DEG[1]


@pytest.mark.parametrize("heading", [-2.0, 0.0, 0.7, 3.0])
def test_rotation_is_heading_then_pitch_then_roll(heading: float) -> None:
    tilt = np.array([[0.05, -0.03]])
    expected = Rotation.from_euler("ZYX", [heading, 0.05, -0.03]).as_matrix()
    np.testing.assert_allclose(rotation(heading, tilt), expected, atol=1e-12)


@pytest.mark.parametrize("heading", [-2.0, 0.0, 0.7, 3.0])
def test_car_stands_square_on_a_slope(heading: float) -> None:
    """Its forward axis rises as the road does, its upward one is the road's normal."""
    east, north = 0.06, -0.04
    axes = rotation(heading, ground=plane(east, north))
    ahead = np.array([np.cos(heading), np.sin(heading)])
    np.testing.assert_allclose(axes[2, 0] / np.hypot(*axes[:2, 0]), ahead @ [east, north], rtol=1e-9)
    normal = np.array([-east, -north, 1]) / np.linalg.norm([-east, -north, 1])
    np.testing.assert_allclose(axes[:, 2], normal, atol=1e-4)  # roll was measured on the level
    np.testing.assert_allclose(np.arctan2(axes[1, 0], axes[0, 0]), heading, atol=1e-12)


def test_signs_of_pitch_and_roll() -> None:
    nose_down, left_up = rotation(1.0, np.array([[0.1, 0.0]])), rotation(1.0, np.array([[0.0, 0.1]]))
    assert nose_down[2, 0] < -0.09
    assert left_up[2, 1] > 0.09
    uphill, left_bank = rotation(0.0, ground=plane(0.1, 0.0)), rotation(0.0, ground=plane(0.0, 0.1))
    assert uphill[2, 0] > 0.09
    assert left_bank[2, 1] > 0.09


def test_laser_rides_at_its_height_above_the_road() -> None:
    rng = np.random.default_rng(4)
    ground = random_ground(CORNER, -CORNER, rng)
    planar = np.column_stack([rng.uniform(-80, 80, (50, 2)), rng.uniform(-4, 4, 50)])
    poses = place_on_ground(planar, rng.normal(0, 0.02, (50, 2)), 1.8, ground)
    np.testing.assert_array_equal(poses[:, :2, 3], planar[:, :2])
    np.testing.assert_allclose(poses[:, 2, 3] - ground.at(planar[:, :2]), 1.8, atol=1e-12)
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (50, 1, 1)), atol=1e-12
    )
