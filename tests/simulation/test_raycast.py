"""Where beams end, against every beam tried with every wall, and the ground looked at every 2 cm."""

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial.transform import Rotation

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation import raycast
from rcnn_odom.simulation.raycast import HIT_GROUND, NO_WALL, cast
from rcnn_odom.simulation.scene import Walls
from rcnn_odom.simulation.terrain import Ground, random_ground

MAX_RANGE = 80.0


def walls_of(ends, heights=None) -> Walls:
    ends = np.atleast_2d(np.asarray(ends, dtype=np.float64))
    heights = np.tile([-5.0, 5.0], (len(ends), 1)) if heights is None else heights
    return Walls(ends, np.asarray(heights, dtype=np.float64), np.ones(len(ends)), np.zeros(len(ends)))


def random_walls(rng: np.random.Generator, count: int, far: float = 60.0) -> Walls:
    middle = rng.uniform(-far, far, (count, 2))
    half = rng.uniform(0.1, 12, (count, 1)) * np.exp(2j * np.pi * rng.random((count, 1)))
    half = np.concatenate([half.real, half.imag], axis=1)
    bottom = rng.uniform(-4, 1, count)
    heights = np.stack([bottom, bottom + rng.uniform(0.1, 6, count)], axis=1)
    return walls_of(np.concatenate([middle - half, middle + half], axis=1), heights)


def fan(azimuth: FloatArray, slope: float = 0.0) -> FloatArray:
    return np.stack([np.cos(azimuth), np.sin(azimuth), np.full_like(azimuth, slope)], axis=1)


def brute_force(walls: Walls, origin: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Every beam with every wall: origin + depth * level direction = start + share * (end - start)."""
    depths, hits = np.full(len(directions), np.inf), np.full(len(directions), NO_WALL)
    for beam, direction in enumerate(directions):
        level = direction / np.hypot(*direction[:2])
        system = np.empty((len(walls), 2, 2))
        system[:, :, 0], system[:, :, 1] = level[:2], walls.ends[:, :2] - walls.ends[:, 2:]
        start = walls.ends[:, :2] - origin[:2]
        depth, share = np.linalg.solve(system, start[:, :, None])[:, :, 0].T
        height = origin[2] + depth * level[2]
        met = (depth > 0) & (depth < MAX_RANGE) & (share >= 0) & (share <= 1)
        met &= (height >= walls.heights[:, 0]) & (height <= walls.heights[:, 1])
        depth = np.where(met, depth, np.inf)
        if met.any():
            depths[beam], hits[beam] = depth.min(), depth.argmin()
    return depths, hits


def march(ground: Ground, origin: FloatArray, directions: FloatArray) -> FloatArray:
    """The ground's heights by SciPy, where a beam first is below them: to 2 cm along it."""
    axes = [ground.corner[i] + ground.step * np.arange(n) for i, n in enumerate(ground.heights.shape)]
    height = RegularGridInterpolator(axes, ground.heights)
    depth = np.arange(0, MAX_RANGE, 0.02)
    level = directions / np.hypot(*directions[:, :2].T)[:, None]
    below = [depth[origin[2] + depth * z < height(origin[:2] + depth[:, None] * (x, y))] for x, y, z in level]
    return np.array([one[0] if len(one) else np.inf for one in below])


@pytest.mark.parametrize("seed", range(6))
def test_depth_and_wall_equal_brute_force(seed: int) -> None:
    rng = np.random.default_rng(seed)
    walls, origin = random_walls(rng, 150), rng.uniform([-20, -20, 0], [20, 20, 2])
    turn = Rotation.from_euler("ZYX", rng.uniform([-4, -0.1, -0.1], [4, 0.1, 0.1])).as_matrix()
    directions = fan(rng.permutation(np.deg2rad(np.arange(0, 360, 0.9))), rng.uniform(-0.02, 0.02)) @ turn.T
    depth, hit, squareness = cast(walls, None, origin, directions, MAX_RANGE)
    expected, expected_hit = brute_force(walls, origin, directions)
    assert (expected < np.inf).any()
    np.testing.assert_allclose(depth, expected, rtol=1e-9)
    np.testing.assert_array_equal(hit, expected_hit)
    met = hit != NO_WALL
    normal = (walls.ends[hit, 2:] - walls.ends[hit, :2])[:, ::-1] * [1, -1]
    level = directions[:, :2] / np.hypot(*directions[:, :2].T)[:, None]
    cosine = np.abs((level * normal).sum(1)) / np.hypot(*normal.T)
    np.testing.assert_allclose(squareness, np.where(met, cosine, 0), atol=1e-9)


@pytest.mark.parametrize("heading_deg", range(-180, 181, 15))
@pytest.mark.parametrize("view_deg", [10, 90, 180, 270])
def test_a_narrow_view_sees_a_wall_that_fills_it(heading_deg: int, view_deg: int) -> None:
    heading = np.deg2rad(heading_deg)
    view = np.deg2rad(np.arange(-view_deg / 2, view_deg / 2 + 0.5))
    corners = 5 * np.exp(1j * (heading + np.deg2rad([-135, -45, 45, 135])))
    ends = [(a.real, a.imag, b.real, b.imag) for a, b in zip(corners, np.roll(corners, -1), strict=True)]
    depth, *_ = cast(walls_of(ends), None, np.zeros(3), fan(heading + view), MAX_RANGE)
    side = (view + np.pi / 4) % (np.pi / 2) - np.pi / 4
    np.testing.assert_allclose(depth, 5 * np.sqrt(0.5) / np.cos(side), rtol=1e-9)


def test_wall_behind_the_laser_lies_across_the_seam_of_azimuths() -> None:
    depth, hit, _ = cast(
        walls_of([-5, -6, -5, 6]), None, np.zeros(3), fan(2 * np.pi / 8 * np.arange(8)), 80.0
    )
    expected = [np.inf] * 3 + [5 * np.sqrt(2), 5.0, 5 * np.sqrt(2)] + [np.inf] * 2
    np.testing.assert_allclose(depth, expected)
    np.testing.assert_array_equal(hit, [NO_WALL] * 3 + [0] * 3 + [NO_WALL] * 2)


def test_walls_that_are_met_edge_on_hide_nothing() -> None:
    """Also those on which the laser itself stands: there is no depth to give."""
    views = fan(np.deg2rad(np.arange(0, 360, 45.0)))
    for ends in (
        [0, 0, 5, 0],
        [-5, 0, 5, 0],
        [1, 0, 5, 0],
        [-5, 0, -1, 0],
        [-5, -0.0, -1, 0.0],
        [2, 2, 0, 0],
    ):
        depth, *_ = cast(walls_of(ends), None, np.zeros(3), views, MAX_RANGE)
        assert (depth > 0.5).all(), ends


def test_beams_pass_over_low_walls_and_below_raised_ones() -> None:
    ends = [[5, -1, 5, 1], [10, -1, 10, 1], [20, -1, 20, 1]]
    walls = walls_of(ends, [[-1, 1.4], [2.6, 9], [-1, 9]])
    for slope, expected in ((0.0, 20.0), (0.2, 10.0), (-0.2, 5.0), (0.03, 20.0)):
        depth, *_ = cast(walls, None, np.array([0, 0, 2.0]), fan(np.zeros(1), slope), MAX_RANGE)
        np.testing.assert_allclose(depth, expected)


def test_range_ends_in_the_horizontal_plane() -> None:
    walls = walls_of([50, -1, 50, 1], [[-40, 40]])
    for max_range, expected in ((50.001, 50.0), (49.999, np.inf)):
        depth, hit, _ = cast(walls, None, np.zeros(3), fan(np.zeros(1), 0.7), max_range)
        np.testing.assert_allclose(depth, expected)
        assert (hit[0] == NO_WALL) == np.isinf(expected)


def test_without_walls_nothing_is_met() -> None:
    depth, hit, _ = cast(walls_of(np.zeros((0, 4))), None, np.zeros(3), fan(np.arange(6.0)), MAX_RANGE)
    assert np.isinf(depth).all()
    assert (hit == NO_WALL).all()


@pytest.mark.parametrize("seed", range(4))
def test_depth_of_the_ground_equals_a_fine_march(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corner = np.array([-150.0, -130.0])
    ground = random_ground(corner, -corner, rng)
    origin = np.append(rng.uniform(-20, 20, 2), 0.0)
    origin[2] = ground.at(origin[None, :2])[0] + 1.73
    turn = Rotation.from_euler("ZYX", [rng.uniform(-4, 4), 0.03, 0.01]).as_matrix()
    directions = fan(np.deg2rad(np.arange(0, 360, 3.0)), -0.008) @ turn.T
    depth, hit, _ = cast(walls_of(np.zeros((0, 4))), ground, origin, directions, MAX_RANGE)
    expected = march(ground, origin, directions)
    assert np.isfinite(expected).mean() > 0.1
    both = np.isfinite(depth) & np.isfinite(expected)
    # A hill may be grazed: a beam is a hair above it and one march misses what the other meets.
    assert np.mean(np.isfinite(depth) == np.isfinite(expected)) > 0.97
    # Two metres on, a beam at 1 degree has come 3.5 cm down: that much a bump may hide in.
    assert np.percentile(np.abs(depth[both] - expected[both]), 95) < 0.2
    np.testing.assert_array_equal(hit == HIT_GROUND, np.isfinite(depth))


def test_the_nearer_of_wall_and_ground_is_met() -> None:
    ground = Ground(np.array([-200.0, -200.0]), 400.0, np.zeros((2, 2)))
    walls, origin = walls_of([[30, -1, 30, 1], [-50, -1, -50, 1]]), np.array([0, 0, 2.0])
    depth, hit, _ = cast(walls, ground, origin, fan(np.array([0, np.pi, np.pi / 2]), -0.05), MAX_RANGE)
    np.testing.assert_allclose(depth, [30, 40, 40], rtol=1e-9)
    np.testing.assert_array_equal(hit, [0, HIT_GROUND, HIT_GROUND])


def test_compiled_and_interpreted_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(5)
    corner = np.array([-100.0, -100.0])
    ground, origin = random_ground(corner, -corner, rng), np.array([1.0, 2.0, 1.5])
    arguments = random_walls(rng, 30), ground, origin, fan(rng.uniform(-np.pi, np.pi, 100), -0.05), MAX_RANGE
    compiled = cast(*arguments)
    for name in ("_first_beam", "_nearest_walls", "_squareness", "_meet_ground"):
        monkeypatch.setattr(raycast, name, getattr(raycast, name).py_func)
    for one, other in zip(cast(*arguments), compiled, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
    assert HIT_GROUND in compiled[1]
    assert (compiled[1] >= 0).any()
