"""The local map against averages in a dictionary."""

import numpy as np
import pytest

from rcnn_odom.matching import local_map
from rcnn_odom.matching.local_map import LocalMap


def turn(vectors, angle):
    cos, sin = np.cos(angle), np.sin(angle)
    return vectors @ np.array([[cos, sin], [-sin, cos]])


def side_of(normal):
    """Which of four directions a normal is nearest to."""
    return int(np.argmax([normal[0], -normal[0], normal[1], -normal[1]]))


@pytest.mark.parametrize("seed", range(4))
def test_cells_are_means_of_what_fell_into_them(seed):
    rng = np.random.default_rng(seed)
    grid, most, want = LocalMap(0.25, 4.0), 4.0, {}
    for travelled in range(6):
        points, angles = rng.uniform(-3, 3, (400, 2)), rng.uniform(-np.pi, np.pi, 400)
        normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        pose = rng.uniform(-1, 1, 3)
        grid.add(points, normals, pose, float(travelled))
        for point, normal in zip(turn(points, pose[2]) + pose[:2], turn(normals, pose[2]), strict=True):
            key = (*np.floor(point / 0.25).astype(int), side_of(normal))
            if key not in want:
                want[key] = [point, normal, 1.0, travelled]
                continue
            mean, way, weight, _ = want[key]
            share = 1 / (min(weight, most) + 1)
            way = way + share * (normal - way)
            want[key] = [
                *(mean + share * (point - mean), way / np.linalg.norm(way)),
                *(min(weight, most) + 1, travelled),
            ]
    cells = np.array([[*point, *normal, weight, seen] for point, normal, weight, seen in want.values()])
    np.testing.assert_allclose(grid.present(), cells, atol=1e-9)
    grid.forget(5.0)
    np.testing.assert_allclose(grid.present(), cells[cells[:, 5] >= 5.0], atol=1e-9)
    # What is left is still found: the same points again make no new cells.
    left = grid.present().copy()
    grid.add(left[:, :2].copy(), left[:, 2:4].copy(), np.zeros(3), 9.0)
    assert grid.count == len(left)
    grid.clear()
    assert len(grid.present()) == 0


def test_both_sides_of_a_thin_wall_stay_apart():
    grid = LocalMap(0.1, 10.0)
    points = np.array([[1.0, 0.055], [1.0, 0.045]])
    grid.add(points, np.array([[0.0, 1.0], [0.0, -1.0]]), np.zeros(3), 0.0)
    np.testing.assert_allclose(grid.present()[:, :4], [[1, 0.055, 0, 1], [1, 0.045, 0, -1]])


def test_a_full_map_takes_no_more_and_forgets_as_ever(monkeypatch):
    monkeypatch.setattr(local_map, "MOST_CELLS", 50)
    grid = LocalMap(0.1, 10.0)
    places = np.stack([np.arange(80.0), np.zeros(80)], axis=1)
    normals = np.tile([0.0, 1.0], (80, 1))
    grid.add(places[:40], normals[:40], np.zeros(3), 0.0)
    grid.add(places[40:], normals[40:], np.zeros(3), 1.0)
    assert grid.count == 50
    grid.forget(1.0)
    assert grid.present()[:, 0].tolist() == list(range(40, 50))
