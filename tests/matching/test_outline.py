"""Line fits against singular value decompositions of the neighbours."""

import numpy as np
import pytest

from matching.rooms import BOX, cast, circle
from rcnn_odom.matching.outline import FEW_LINES, LINE_GAP, LINE_REACH, SPARSE_GAP, SPARSE_REACH, outline
from rcnn_odom.matching.points import find_points


def look(pose=(0.0, 0.0, 0.3), spacing=0.5, view=360.0, noise=0.01, walls=BOX, seed=0):
    bearings = circle(spacing, view)
    ranges = cast(np.array(pose), bearings, walls)
    ranges += noise * np.random.default_rng(seed).standard_normal(len(ranges))
    return find_points(ranges, bearings, 80.0)


def fit(found, spacing, closed):
    """Points, normals, and variances across and along, of all the points by brute force."""
    xy, count = found[:, :2], len(found)
    radius = np.hypot(*xy.T)
    gone = np.hypot(*(xy - np.roll(xy, 1, axis=0)).T)
    gap = LINE_GAP + SPARSE_GAP * spacing * np.minimum(radius, np.roll(radius, 1))
    joined = gone <= gap
    joined[0] &= closed
    fits = []
    for i in range(count):
        near = [i]
        for way in (1, -1):
            for k in range(1, count):
                j = (i + way * k) % count
                linked = joined[j] if way == 1 else joined[(j + 1) % count]
                if not linked or np.hypot(*(xy[j] - xy[i])) > LINE_REACH + SPARSE_REACH * spacing * radius[i]:
                    break
                near.append(j)
        neighbours = xy[sorted(set(near))]
        if len(neighbours) < 3:
            continue
        middle = neighbours.mean(axis=0)
        _, sizes, axes = np.linalg.svd(neighbours - middle)
        across, along = sizes[1] ** 2 / len(neighbours), sizes[0] ** 2 / len(neighbours)
        if across > 0.1 * along:
            continue
        normal = axes[1] * -np.sign(axes[1] @ xy[i])
        fits.append(
            (*(xy[i] - ((xy[i] - middle) @ normal) * normal), *normal, across, along, len(neighbours))
        )
    return np.array(fits)


@pytest.mark.parametrize(("view", "spacing"), [(360.0, 0.6), (270.0, 0.75), (180.0, 1.0)])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
def test_lines_are_those_of_a_decomposition(view, spacing, noise):
    found = look(view=view, spacing=spacing, noise=noise)
    seen = outline(found)
    assert seen.spacing == pytest.approx(np.deg2rad(spacing), rel=1e-6)
    want = fit(found, seen.spacing, closed=view == 360)
    count = len(want)
    assert seen.lines == count
    off = np.abs(seen.points[:count] - want[:, :2]).max(axis=1)
    turned = np.abs(seen.normals[:count] - want[:, 2:4]).max(axis=1)
    # Noise may bring a point back within reach behind one that is out of it, which not every search sees.
    share = 1.0 if noise < 0.02 else 0.98
    assert np.mean((off < 1e-7) & (turned < 1e-6)) >= share
    np.testing.assert_allclose(seen.scatter, np.sort(want[:, 4])[int(0.7 * count)], atol=1e-9, rtol=0.01)
    np.testing.assert_allclose(
        seen.normal_noise, np.mean(want[:, 4] / want[:, 5] / want[:, 6]), atol=1e-9, rtol=0.01
    )
    assert seen.returns.tolist() == found[:, :2].tolist()


def test_normals_are_those_of_the_walls():
    seen = outline(look(noise=0.0))
    normals = seen.normals[: seen.lines]
    # All walls of the box are parallel to one of two axes, which the laser sees turned by -0.3 rad.
    angles = np.arctan2(normals[:, 1], normals[:, 0]) + 0.3
    off = np.abs((angles + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    assert np.mean(off < 1e-6) > 0.9, "all but those at corners"
    np.testing.assert_allclose(np.hypot(*seen.normals.T), 1.0)
    assert ((seen.points * seen.normals).sum(axis=1) <= 1e-9).all(), "towards the laser"


def test_a_scan_of_very_many_beams_has_fewer_lines():
    found = look(spacing=0.1)
    seen = outline(found)
    assert len(found) == 3600
    assert 500 < len(seen.points) <= 601
    assert len(seen.returns) == 3600


def test_a_post_is_held_both_ways():
    bearings = np.deg2rad([-2.0, 0.0, 2.0, 90.0, 91.0, 92.0])
    seen = outline(find_points(np.array([5.0, 5.0, 5.0, 7.0, 7.0, 7.0]), bearings, 80.0))
    assert len(seen.points) <= FEW_LINES
    posts = seen.points[-4:]
    np.testing.assert_allclose(posts[0], posts[1])
    np.testing.assert_allclose(np.hypot(*posts.T), [5, 5, 7, 7], rtol=1e-3)
    ahead, aside = seen.normals[-4:-2]
    np.testing.assert_allclose(ahead, [-1, 0], atol=1e-6)
    np.testing.assert_allclose(np.abs(aside), [0, 1], atol=1e-6)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_hardly_any_points_raise_nothing(count):
    seen = outline(find_points(np.full(count, 3.0), np.linspace(0, 2, count), 80.0))
    assert len(seen.returns) == count


def test_points_at_one_place_are_no_line():
    seen = outline(find_points(np.full(20, 3.0), np.full(20, 0.5), 80.0))
    assert np.isfinite(seen.points).all()
    assert np.isfinite(seen.normals).all()
