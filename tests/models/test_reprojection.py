"""Scans seen from another place, against what a laser there would see: exact rooms and the simulator."""

import time

import numpy as np
import pytest

from rcnn_odom.geometry import advance, planar_to_poses, poses_to_planar
from rcnn_odom.models.encoding import Sensor, decode, encode
from rcnn_odom.models.reprojection import OCCLUSION_DEPTH, render, reproject
from rcnn_odom.recordings import simulated
from rcnn_odom.simulation import worlds
from rcnn_odom.simulation.laser import Laser

RING = Sensor()
ROUND = Sensor(0.5, 360.0, 40.0)
HALF = Sensor(0.5, 180.0, 40.0)
ASIDE = Sensor(0.5, 120.0, 40.0, facing_deg=75.0)
BEHIND = Sensor(0.5, 200.0, 40.0, facing_deg=180.0)
SENSORS = [ROUND, HALF, ASIDE, BEHIND, Sensor(0.25, 270.0, 40.0)]
ROOM = np.array([[1, 0.2, 7], [-0.3, 1, 4], [-1, -0.1, 9], [0.1, -1, 5], [0.8, 0.7, 6.5]])
"""Rows a, b, c: where a x + b y < c. It has no symmetry, and all of it is seen from everywhere."""
NOWHERE = np.zeros(3)


def bearings_of(sensor):
    return np.deg2rad(np.arange(sensor.bins) * sensor.resolution_deg + sensor.first_bin_deg)


def look(pose, sensor, walls=ROOM):
    """The exact depth vector at the middle of every bin."""
    angles = pose[2] + bearings_of(sensor)
    speed = walls[:, :2] @ [np.cos(angles), np.sin(angles)]
    distance = walls[:, 2] - walls[:, :2] @ pose[:2]
    with np.errstate(divide="ignore"):
        depth = np.where(speed > 1e-9, distance[:, None] / speed, np.inf).min(0)
    return np.where(depth < sensor.max_range, depth, 0).astype(np.float32)


def see_segments(pose, sensor, segments, spacing_deg=None):
    """The depth vector of walls (W, 4) from x, y to x, y, one beam a bin or beams so far apart."""
    angles = bearings_of(sensor)
    if spacing_deg:
        first, covered = np.deg2rad(sensor.first_bin_deg), np.deg2rad(sensor.field_of_view_deg)
        angles = first + np.deg2rad(spacing_deg) * np.arange(round(covered / np.deg2rad(spacing_deg)))
    elif sensor.field_of_view_deg == 360:
        angles = angles[:-1]
    rays = np.stack([np.cos(angles + pose[2]), np.sin(angles + pose[2])], axis=1)
    best = np.full(len(angles), np.inf)
    for x, y, end_x, end_y in segments:
        start, along = np.array([x, y]) - pose[:2], np.array([end_x - x, end_y - y])
        cross = rays[:, 0] * along[1] - rays[:, 1] * along[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (start[0] * along[1] - start[1] * along[0]) / cross
            part = (start[0] * rays[:, 1] - start[1] * rays[:, 0]) / cross
        hit = (distance > 0) & (part >= 0) & (part <= 1)
        best = np.where(hit & (distance < best), distance, best)
    return encode(angles, best, sensor)


# --- points moved --------------------------------------------------------------------------------


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("see", [reproject, lambda *given: render(*given, given[1])])
@pytest.mark.parametrize("viewpoint", [[0.3, -0.2, 0.1], [-1.0, 0.5, -0.4], [0.0, 0.0, 0.7], [2.0, 0.0, 0.0]])
def test_a_room_is_seen_as_from_there(sensor, see, viewpoint):
    pose = np.array([0.5, -0.7, 0.4])
    seen = see(look(pose, sensor), sensor, viewpoint)
    expected = look(advance(pose, np.array(viewpoint)), sensor)
    error = np.abs(seen - expected)[seen > 0]
    # Half a bin of a wall that is grazed is more than of one that is hit squarely.
    assert np.median(error) < 0.01
    assert np.quantile(error, 0.95) < 0.12
    assert np.count_nonzero(seen) > 0.4 * sensor.bins
    assert seen.dtype == np.float32


@pytest.mark.parametrize("sensor", SENSORS)
def test_from_the_same_place_all_is_as_it_was(sensor):
    scan = look(np.array([0.5, -0.7, 0.4]), sensor)
    scan[10:15] = 0
    if sensor is ROUND:
        scan[-1] = scan[0]
    np.testing.assert_allclose(reproject(scan, sensor, NOWHERE), scan, rtol=1e-6)
    drawn = render(scan, sensor, NOWHERE, sensor)
    kept = np.delete(np.arange(sensor.bins), range(10, 15))
    np.testing.assert_allclose(drawn[kept], scan[kept], rtol=1e-5)


@pytest.mark.parametrize("sensor", SENSORS)
@pytest.mark.parametrize("bins", [1, -3, 40])
def test_a_turn_by_whole_bins_shifts_them(sensor, bins):
    scan = look(np.array([0.5, -0.7, 0.4]), sensor)
    seen = reproject(scan, sensor, [0, 0, bins * np.deg2rad(sensor.resolution_deg)])
    if sensor.field_of_view_deg == 360:
        expected = np.roll(scan[:-1], -bins)
        np.testing.assert_allclose(seen, np.append(expected, expected[0]), rtol=1e-6)
    else:
        expected = np.roll(scan, -bins)
        expected[slice(len(scan) - bins, None) if bins > 0 else slice(0, -bins)] = 0
        np.testing.assert_allclose(seen, expected, rtol=1e-6)


@pytest.mark.parametrize("see", [reproject, lambda *given: render(*given, given[1])])
def test_the_circle_is_closed(see):
    scan = look(np.array([0.5, -0.7, 0.4]), ROUND)
    for turn in np.linspace(-np.pi, np.pi, 9):
        seen = see(scan, ROUND, [0.1, 0.1, turn])
        assert seen[0] == seen[-1] > 0


def test_points_behind_the_laser_are_not_seen_by_one_that_looks_ahead():
    wall = see_segments(NOWHERE, HALF, [(2.0, -8.0, 2.0, 8.0)])
    assert np.count_nonzero(wall)
    for see in (reproject, lambda *given: render(*given, given[1])):
        assert not see(wall, HALF, [3.0, 0.0, 0.0]).any(), "driven past"
        assert not see(wall, HALF, [0.0, 0.0, np.pi]).any(), "turned away"
        assert not see(np.zeros(HALF.bins, np.float32), HALF, [0.1, 0.0, 0.0]).any()


def test_what_is_beyond_the_range_is_not_seen():
    wall = see_segments(NOWHERE, HALF, [(39.0, -5.0, 39.0, 5.0)])
    for see in (reproject, lambda *given: render(*given, given[1])):
        assert see(wall, HALF, [1.0, 0.0, 0.0]).max() == pytest.approx(38, abs=0.4)
        assert not see(wall, HALF, [-1.1, 0.0, 0.0]).any()


@pytest.mark.parametrize("sensor", [ROUND, HALF])
def test_the_mirror_image_moves_as_in_a_mirror(sensor):
    scan = look(np.array([0.5, -0.7, 0.4]), sensor)
    viewpoint = np.array([0.4, 0.3, 0.2])
    for see in (reproject, lambda *given: render(*given, given[1])):
        seen = see(scan, sensor, viewpoint)
        mirrored = see(scan[::-1].copy(), sensor, viewpoint * [1, -1, -1])[::-1]
        # A point on the border of two bins may go to the other one.
        same = np.isclose(seen, mirrored, rtol=1e-4) | ((seen == 0) != (mirrored == 0))
        assert same.mean() > 0.99


# --- what hides what -----------------------------------------------------------------------------

NEAR, FAR = (3.0, 0.5, 3.0, 3.0), (8.0, -8.0, 8.0, 8.0)


@pytest.mark.parametrize(("see", "least"), [(reproject, 0.9), (lambda *given: render(*given, given[1]), 1.0)])
def test_a_wall_behind_a_nearer_one_is_not_seen(see, least):
    """From a metre to the left the near wall hides a part of the far one that was seen before.

    Between points of the near one that are now more than a bin apart, points of the far one are left.
    """
    scan = see_segments(NOWHERE, HALF, [NEAR, FAR])
    viewpoint = np.array([0.0, 1.0, 0.0])
    seen, truth = see(scan, HALF, viewpoint), see_segments(viewpoint, HALF, [NEAR, FAR])
    hidden = np.rad2deg(bearings_of(HALF))
    behind = (hidden > np.rad2deg(np.arctan2(-0.5, 3)) + 1) & (hidden < -1)
    far_before = see(see_segments(NOWHERE, HALF, [FAR]), HALF, viewpoint)
    assert (far_before[behind] > 7.9).any(), "it would be there without the near one"
    assert (truth[behind] < 3.2).all()
    filled = seen[behind] > 0
    assert filled.mean() > 0.5
    assert (seen[behind][filled] < 3.2).mean() >= least


def test_points_less_than_half_a_metre_apart_are_averaged():
    sensor = Sensor(10.0, 180.0, 40.0)
    scan = np.zeros(sensor.bins, np.float32)
    scan[9], scan[10] = 5.0, 5.3
    ahead = reproject(scan, sensor, [-20.0, 0.0, 0.0])
    both = [np.hypot(*point) for point in decode(scan, sensor) + np.array([20, 0])]
    assert abs(both[0] - both[1]) < OCCLUSION_DEPTH
    assert ahead[9] == pytest.approx(np.mean(both))
    scan[10] = 8.0
    assert reproject(scan, sensor, [-20.0, 0.0, 0.0])[9] == pytest.approx(25.0)


def test_backs_of_walls_are_not_drawn():
    """A plate between the old and the new place: only its other side would be seen."""
    scan = see_segments(NOWHERE, ROUND, [(3.0, -1.0, 3.0, 1.0)])
    assert render(scan, ROUND, [2.0, 0.0, 0.0], ROUND).any()
    assert not render(scan, ROUND, [4.0, 0.0, 0.0], ROUND).any()
    assert reproject(scan, ROUND, [4.0, 0.0, 0.0]).any(), "points have no side"


@pytest.mark.parametrize("quarter_turns", range(4))
def test_a_wall_seen_edge_on_has_no_negative_ranges(quarter_turns):
    """From a place in the line of the wall, but for rounding errors, it is a point at the middle of a bin."""
    sensor, rng = Sensor(resolution_deg=1.0), np.random.default_rng(0)
    sines = np.maximum(np.sin(bearings_of(sensor)), 1e-9)
    depth = np.where(sines > 1 / 15, 2.0 / sines, 0.0).astype(np.float32)
    for _ in range(100):
        place = rng.uniform(-3, 3), 2.0 + 1e-8 * rng.standard_normal(), quarter_turns * np.pi / 2
        assert (render(depth, sensor, np.array(place), sensor) >= 0).all()


def test_no_line_is_drawn_between_two_things():
    scan = see_segments(NOWHERE, HALF, [NEAR, (8.0, -8.0, 8.0, 0.6)])
    drawn = render(scan, HALF, NOWHERE, Sensor(0.1, 180.0, 40.0))
    depths = drawn[drawn > 0]
    assert ((depths < 4.5) | (depths > 7.9)).all()
    post = np.zeros(HALF.bins, np.float32)
    post[200] = 4.0
    alone = render(post, HALF, NOWHERE, HALF)
    np.testing.assert_array_equal(alone, post)


# --- other beams ---------------------------------------------------------------------------------


@pytest.mark.parametrize("spacing", [0.05, 0.1, 0.13, 0.18, 0.2, 0.25, 0.3])
def test_a_wall_is_drawn_the_same_however_the_beams_were_spaced(spacing):
    walls = [
        (-9.0, 6.0, 14.0, 4.0),
        (14.0, 4.0, 13.0, -9.0),
        (13.0, -9.0, -9.0, -7.0),
        (-9.0, -7.0, -9.0, 6.0),
    ]
    scan = see_segments(NOWHERE, RING, walls, spacing)
    rng = np.random.default_rng(0)
    noisy = np.where(scan > 0, scan + rng.normal(0, 0.01, len(scan)), 0).astype(np.float32)
    noisy[-1] = noisy[0]
    viewpoint = np.array([0.6, -0.2, 0.05])
    expected = see_segments(viewpoint, RING, walls)
    for given, most in ((scan, 0.02), (noisy, 0.035)):
        drawn = render(given, RING, viewpoint, RING)
        assert (drawn > 0).mean() > 0.995, "no gaps that would tell of the beams"
        assert np.quantile(np.abs(drawn - expected)[drawn > 0], 0.95) < most


def test_a_coarse_laser_and_a_fine_one_draw_on_each_other():
    pose = np.array([0.5, -0.7, 0.4])
    coarse, fine = Sensor(1.0, 180.0, 40.0), Sensor(0.25, 270.0, 40.0)
    upon_fine = render(look(pose, coarse), coarse, NOWHERE, fine)
    inside = np.abs(np.rad2deg(bearings_of(fine))) <= 89.5
    assert not upon_fine[np.abs(np.rad2deg(bearings_of(fine))) > 90.2].any()
    np.testing.assert_allclose(upon_fine[inside], look(pose, fine)[inside], rtol=0.02)
    np.testing.assert_allclose(render(look(pose, fine), fine, NOWHERE, coarse), look(pose, coarse), rtol=0.01)


# --- the simulator -------------------------------------------------------------------------------


class NoNoise:
    """In place of a generator: a laser without noise that loses no shot."""

    def standard_normal(self, count):
        return np.zeros(count)

    def random(self, count):
        return np.zeros(count)


def simulated_scans(world, frames, sensor):
    """What a level laser without noise sees along a drive (N, bins), without movers, and its poses (N, 3)."""
    recipe = worlds.Recipe("reprojected", 0, world, 60, movers=False, tilt=False, other_paces=False)
    poses = worlds.poses_of(recipe)[frames]
    laser = Laser(sensor.resolution_deg, max_range=sensor.max_range, noise=0.0)
    bearings, scans = bearings_of(sensor)[:-1], []
    scene = worlds.scene_near(recipe, 0, 2 * sensor.max_range)
    for pose in poses:
        ranges = laser.shoot(scene, 0, pose, bearings, NoNoise(), missing=False)
        scans.append(encode(bearings, ranges, sensor))
    return np.stack(scans), poses_to_planar(poses)


@pytest.mark.parametrize(("world", "sensor"), [("indoor", Sensor(0.25, 360.0, 40.0)), ("street", RING)])
@pytest.mark.parametrize("see", [reproject, lambda *given: render(*given, given[1])])
def test_the_next_scan_of_the_simulator_is_seen_from_the_one_before(world, sensor, see):
    scans, planar = simulated_scans(world, slice(0, 40, 4), sensor)
    steps = np.linalg.inv(planar_to_poses(planar[:-1])) @ planar_to_poses(planar[1:])
    errors, near = [], []
    for before, after, step in zip(scans, scans[1:], poses_to_planar(steps), strict=False):
        seen = see(before, sensor, step)
        both = (seen > 0) & (after > 0)
        errors.append(np.abs(seen - after)[both])
        points, there = decode(seen, sensor), decode(after, sensor)
        distance = np.hypot(*(points[:, None] - there).transpose(2, 0, 1)).min(1)
        near.append(distance < 0.1)
    assert np.median(np.concatenate(errors)) < 0.02
    assert np.concatenate(near).mean() > 0.85, "what is hidden from one of the two places is the rest"


def test_what_it_costs_is_printed():
    """No bound: other work on the machine would break it. On a free core both take less than 0.1 ms."""
    drive = simulated.load("reprojected", frames=3)
    scan = RING.encode(drive.read_scan(1))
    viewpoint = np.array([0.3, 0.1, 0.02])
    for name, see in (
        ("reproject", lambda: reproject(scan, RING, viewpoint)),
        ("render", lambda: render(scan, RING, viewpoint, RING)),
    ):
        see()
        times = []
        for _ in range(300):
            start = time.perf_counter()
            see()
            times.append(time.perf_counter() - start)
        returns = np.count_nonzero(scan)
        print(f"{name}: {1e6 * min(times):.0f} microseconds for {returns} returns in {len(scan)} bins")
