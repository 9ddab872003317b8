"""Partners, equations and alignments, against trees, numpy and known motions."""

import ast
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

import rcnn_odom
from matching.rooms import cast, circle
from rcnn_odom.matching.align import BEHIND, BINS, align, bearing_bin, build_table, nearest, solve3
from rcnn_odom.matching.local_map import LocalMap
from rcnn_odom.matching.outline import outline
from rcnn_odom.matching.points import find_points
from rcnn_odom.matching.registration import SETTINGS, WEAK_PRIOR


@pytest.mark.parametrize("seed", range(20))
def test_small_systems_are_solved(seed):
    rng = np.random.default_rng(seed)
    half = rng.standard_normal((3, 3)) * 10.0 ** rng.integers(-2, 3, 3)
    matrix, right = half @ half.T + 1e-3 * np.eye(3), rng.standard_normal(3)
    np.testing.assert_allclose(solve3(matrix, right), np.linalg.solve(matrix, right), rtol=1e-6)


def test_bins_grow_with_the_bearing():
    angles = np.linspace(-np.pi, np.pi - 1e-9, 100_000)
    bins = np.array([bearing_bin(np.cos(a), np.sin(a)) for a in angles])
    assert (np.diff(bins) >= 0).all()
    assert (bins[0], bins[-1]) == (0, BINS - 1)
    width = np.bincount(bins) * (2 * np.pi / len(angles))
    assert width.min() > 4 / BINS * 0.98
    assert width.max() < 8 / BINS * 1.02


def random_cells(rng, count):
    """Cells with some at the centre, some exactly behind it and some on the axes."""
    cells = np.zeros((count, 6))
    cells[:, :2] = rng.uniform(-10, 10, (count, 2))
    cells[: count // 10, 1] = rng.choice([0.0, -0.0], count // 10)
    cells[0, :2] = 0.0
    angle = rng.uniform(-np.pi, np.pi, count)
    cells[:, 2], cells[:, 3] = np.cos(angle), np.sin(angle)
    cells[:, 5] = rng.uniform(0, 10, count)
    return cells


@pytest.mark.parametrize("seed", range(8))
def test_partners_are_those_of_a_tree(seed):
    rng = np.random.default_rng(seed)
    cells = random_cells(rng, int(rng.integers(5, 800)))
    centre = rng.uniform(-1, 1, 2) if seed % 2 else np.zeros(2)
    table = build_table(cells, 2.0, centre, 9.0)
    at = cells[:, :2] - centre
    kept = (cells[:, 5] >= 2.0) & (np.hypot(*at.T) < 9.0) & ((at * cells[:, 2:4]).sum(axis=1) < BEHIND)
    order = np.lexsort(np.hstack([at, cells[:, 2:4]])[kept].T)
    np.testing.assert_allclose(
        table.entries[np.lexsort(table.entries.T)], np.hstack([at, cells[:, 2:4]])[kept][order], atol=1e-12
    )
    tree, same = cKDTree(table.entries[:, :2]), np.cos(np.deg2rad(45))
    points = [*rng.uniform(-11, 11, (200, 2)), (0.0, 0.0), (-3.0, 0.0), (-3.0, -0.0), (-3.0, -1e-12)]
    for x, y in points:
        angle, gate = rng.uniform(-np.pi, np.pi), rng.choice([0.3, 1.0, 5.0])
        found = nearest(table.entries, table.starts, x, y, np.cos(angle), np.sin(angle), gate, same)
        near = np.array(tree.query_ball_point((x, y), gate), dtype=int)
        near = near[table.entries[near, 2:] @ [np.cos(angle), np.sin(angle)] > same]
        if len(near) == 0:
            assert found == -1
        else:
            distances = np.hypot(*(table.entries[near, :2] - (x, y)).T)
            assert found in near
            assert np.hypot(*(table.entries[found, :2] - (x, y))) == pytest.approx(distances.min(), abs=1e-12)


def scan_of(pose, noise=0.0, seed=0, spacing=0.5):
    bearings = circle(spacing)
    ranges = cast(np.array(pose), bearings)
    ranges += noise * np.random.default_rng(seed).standard_normal(len(ranges))
    return outline(find_points(ranges, bearings, 80.0))


def align_to_first(motion, noise, gate=1.0):
    """The pose that aligning finds for a scan from ``motion``, in a map of some scans from the origin."""
    grid = LocalMap(0.1, 10.0)
    for seed in range(1 if noise == 0 else 5):
        first = scan_of(np.zeros(3), noise, seed=100 + seed)
        grid.add(first.points, first.normals, np.zeros(3), 0.0)
    scan, found = scan_of(motion, noise), np.zeros((7, 3))
    table = build_table(grid.present(), 0.0, np.zeros(2), 100.0)
    pose, score = run(scan, table, np.zeros(3), np.asarray(motion, dtype=float), 0 * WEAK_PRIOR, gate, found)
    return pose, score, found


def run(scan, table, start, guess, stiffness, gate, found):
    pose, score, of_lines = align(
        *(
            scan.points,
            scan.normals,
            table.entries,
            table.starts,
            table.centre,
            start,
            guess,
            stiffness,
            gate,
        ),
        *(4 * scan.spacing, len(scan.points), SETTINGS, found),
    )
    assert of_lines == score, "all points count as lines"
    return pose, score


@pytest.mark.parametrize("motion", [(0, 0, 0), (0.3, 0, 0), (0.2, -0.3, 0.1), (-0.4, 0.1, -0.15)])
def test_a_known_motion_is_found(motion):
    pose, score, found = align_to_first(motion, noise=0.0)
    np.testing.assert_allclose(pose, motion, atol=2e-4)
    assert score > 0.9
    assert found[6, 2] > 0.9
    pose, score, _ = align_to_first(motion, noise=0.01)
    np.testing.assert_allclose(pose, motion, atol=5e-3)
    assert score > 0.9


def test_the_information_is_that_of_the_walls():
    _, _, found = align_to_first((0, 0, 0), noise=0.0)
    scan = scan_of(np.zeros(3))
    rows = np.column_stack(
        [scan.normals, scan.points[:, 0] * scan.normals[:, 1] - scan.points[:, 1] * scan.normals[:, 0]]
    )
    expected = rows.T @ rows / len(rows)
    np.testing.assert_allclose(found[:3], expected, rtol=0.05, atol=0.05)


def test_nothing_to_align_with_scores_nothing():
    scan, found = scan_of(np.zeros(3)), np.zeros((7, 3))
    table = build_table(np.empty((0, 6)), 0.0, np.zeros(2), 100.0)
    pose, score = run(scan, table, np.ones(3), np.ones(3), WEAK_PRIOR, 1.0, found)
    assert pose.tolist() == [1, 1, 1]
    assert score == 0


def test_a_wall_without_end_tells_nothing_along_it():
    walls = np.array([[-500, -1, 500, -1], [-500, 1.5, 500, 1.5]], dtype=float)
    bearings = circle()
    seen = outline(find_points(cast(np.zeros(3), bearings, walls), bearings, 30.0))
    assert np.abs(seen.normals[:, 0]).max() < 1e-6


def test_compiled_functions_use_nothing_compiled_of_other_files():
    """Numba's cache would go on using what such a function was when it was compiled."""
    for path in (Path(rcnn_odom.__file__).parent / "matching").glob("*.py"):
        tree = ast.parse(path.read_text())
        imported = {
            name.asname or name.name
            for node in tree.body
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rcnn_odom")
            for name in node.names
        }
        for node in tree.body:
            marks = [each.id for each in getattr(node, "decorator_list", []) if isinstance(each, ast.Name)]
            if "compiled" in marks:
                used = {
                    each.id for line in node.body for each in ast.walk(line) if isinstance(each, ast.Name)
                }
                assert not used & imported, f"{path.name}: {node.name} uses {used & imported}"
