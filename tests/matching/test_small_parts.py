"""Turns from normals, readings that are no returns, and scans that take time."""

import numpy as np
import pytest

from matching.rooms import BOX, cast, circle
from rcnn_odom.matching.deskew import deskew
from rcnn_odom.matching.no_return import NoReturn
from rcnn_odom.matching.outline import outline
from rcnn_odom.matching.points import find_points
from rcnn_odom.matching.yaw import turn_candidates


def normals_at(heading):
    bearings = circle(1.0)
    return outline(find_points(cast(np.array([0.0, 0.0, heading]), bearings), bearings, 80.0)).normals


@pytest.mark.parametrize("turn_deg", [0, 7, -30, 44, 90, -120, 179])
def test_the_true_turn_is_among_the_candidates(turn_deg):
    turns = turn_candidates(normals_at(0.2), normals_at(0.2 + np.deg2rad(turn_deg)), 5)
    off = np.rad2deg(np.abs((turns - np.deg2rad(turn_deg) + np.pi) % (2 * np.pi) - np.pi))
    assert len(turns) <= 5
    assert off.min() < 1.5
    assert (np.abs(turns) <= np.pi).all()


def limit(scans, farthest=120.0):
    no_return = NoReturn()
    return [no_return.limit(np.asarray(ranges, dtype=float), farthest) for ranges in scans]


@pytest.mark.parametrize("code", ["81.83", "50", "51.1 to 51.22"])
def test_numbers_of_logs_that_mean_no_return_are_found(code):
    rng = np.random.default_rng(0)
    scans = []
    for _ in range(10):
        ranges = rng.uniform(1, 25, 181)
        none = rng.random(181) < 0.2
        ranges[none] = {"81.83": 81.83, "50": 50.0}.get(code, rng.uniform(51.1, 51.22, none.sum()))
        scans.append(ranges)
    limits = limit(scans)
    assert all(25 < each <= scan[scan > 25].min() for each, scan in zip(limits, scans, strict=True))


def test_walls_are_not_taken_for_it():
    # A long wall at the edge of sight, a round room, and a small one where all readings are the largest.
    wall = 20 / np.cos(np.deg2rad(np.arange(-70, 70.1, 0.25)))
    assert limit([wall] * 5) == [120.0] * 5
    assert limit([np.full(360, 3.0)] * 5) == [120.0] * 5
    room = cast(np.zeros(3), circle(1.0))
    assert limit([room] * 5) == [120.0] * 5
    assert limit([np.full(10, np.inf), []], farthest=80.0) == [80.0, 80.0]


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.0), (1.0, 0.3, 0.0), (0.5, -0.2, 1.5), (0.0, 0.0, -1.57)])
def test_a_scan_on_an_arc_becomes_one_from_its_stamp(velocity):
    velocity, bearings = np.array(velocity), circle(1.0)
    times = (np.arange(len(bearings)) / len(bearings) - 0.3) * 0.2
    # Exact: the laser goes round the centre of its turn, or straight on.
    turn = velocity[2] * times
    safe = np.where(turn == 0, 1.0, velocity[2])
    along = np.where(turn == 0, times, np.sin(turn) / safe)
    aside = np.where(turn == 0, 0.0, (1 - np.cos(turn)) / safe)
    poses = np.stack(
        [velocity[0] * along - velocity[1] * aside, velocity[0] * aside + velocity[1] * along, turn], axis=1
    )
    ranges = cast(poses, bearings)
    moved, turned = deskew(ranges, bearings, times, velocity)
    points = moved * np.exp(1j * turned)
    want = poses[:, 0] + 1j * poses[:, 1] + ranges * np.exp(1j * (bearings + poses[:, 2]))
    np.testing.assert_allclose(points, want, atol=1e-4)
    # From the stamp's pose the same walls are seen in these directions; but corners hide other things.
    off = np.abs(cast(np.zeros(3), turned, BOX) - moved)
    assert np.mean(off < 1e-3) > 0.97


def test_beams_without_a_return_or_a_time_stay():
    ranges, bearings = np.array([np.inf, np.nan, 0.0, 3.0, 3.0]), np.linspace(0, 1, 5)
    moved, turned = deskew(ranges, bearings, np.array([0.1, 0.1, 0.1, 5.0, np.nan]), np.array([1.0, 0, 0]))
    np.testing.assert_array_equal(moved, ranges)
    np.testing.assert_array_equal(turned, bearings)
