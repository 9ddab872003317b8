"""Walls along a way: the lining of a tunnel, the walls of a corridor, poles and bushes on open ground."""

import numpy as np
from scipy.spatial import cKDTree

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.blind.way import Way
from rcnn_odom.simulation.drawing import HEIGHTS, PLASTER
from rcnn_odom.simulation.scene import Material, Walls, join
from rcnn_odom.simulation.street.street import TRUNK, Side

CONCRETE = Material(returned=0.99, roughness=0.01)
TUNNEL_HEIGHTS = (-1.0, 6.0)
"""Metres, bottom and top of a tunnel's walls."""
PIECE = 1.0
"""Metres, longest straight piece of a wall; longer pieces would give smooth bends corners to match."""

TUNNEL_WIDTH = (8.5, 10.5)
"""Metres: two lanes and a walkway on each side."""
TUNNEL_FEATURES = (25.0, 60.0)
"""Metres from one feature of the walls to the next, on both sides together."""
NICHE = (1.0, 2.5), (0.5, 1.2)
"""Metres, length along the wall and depth of a niche for a telephone or a hydrant, or of a door."""
PILLAR = (0.4, 1.0), (-0.4, -0.15)
"""Metres, length along the wall and depth of a pillar; the depth is negative because it protrudes."""
BAY = (30.0, 45.0), (2.5, 3.2)
"""Metres, length and depth of a bay for broken-down cars; its ends are slanted over ``BAY_TAPER`` metres."""
BAY_TAPER = 6.0
NICHES, PILLARS = 0.55, 0.35
"""Parts of all features that are niches and pillars; the rest are bays."""

CORRIDOR_WIDTH = (2.0, 3.2)
"""Metres."""
DOORS = (5.0, 15.0)
"""Metres from one door to the next on the same side."""
DOOR, FRAME = (0.85, 1.2), (0.06, 0.1)
"""Metres along the wall of a leaf, and of each side of its frame."""
FRAME_DEPTH, LEAF_DEPTH = (-0.04, -0.01), (0.01, 0.06)
"""Metres of depth: a frame protrudes (negative), its closed leaf is recessed."""

POLES = (25.0, 50.0)
"""Metres from one snow pole to the next, on both sides of the track."""
POLE_ASIDE, POLE_RADIUS, POLES_GONE = (2.5, 5.0), (0.03, 0.06), 0.15
"""Metres from the track to a pole, radius of a pole in metres, and part of the poles that are missing."""
BUSHES = (1 / 4000, 1 / 1200)
"""Bushes and single posts per square metre."""
SIGHT, CLEAR = 85.0, 4.0
"""Metres from the track: bushes stand within ``SIGHT``, slightly more than the laser's range; nothing stands
within ``CLEAR``."""

Feature = tuple[float, float, float, float]
"""Start and end along the wall, depth (negative: it protrudes), and length of its slanted ends; metres."""


def tunnel(way: Way, length: float, rng: np.random.Generator) -> Walls:
    """Two smooth walls of a tunnel with two lanes; there is a feature on one of them every 25 to 60 metres.

    Args:
        way: the way through the tunnel.
        length: metres of the way that have walls.
        rng: source of all random choices.
    """
    half = rng.uniform(*TUNNEL_WIDTH) / 2
    features: tuple[list[Feature], list[Feature]] = ([], [])
    along = rng.uniform(0, TUNNEL_FEATURES[1])
    while along < length - BAY[0][1]:
        kind = rng.random()
        size, depth = NICHE if kind < NICHES else PILLAR if kind < NICHES + PILLARS else BAY
        end = along + rng.uniform(*size)
        taper = BAY_TAPER if size == BAY[0] else 0.0
        features[rng.integers(2)].append((along, end, rng.uniform(*depth), taper))
        along = end + rng.uniform(*TUNNEL_FEATURES)
    sides = zip((half, -half), features, strict=True)
    return join([_wall(way, length, *side, CONCRETE, TUNNEL_HEIGHTS) for side in sides])


def corridor(way: Way, length: float, rng: np.random.Generator) -> Walls:
    """Two flat walls of a corridor, each with a closed door every 5 to 15 m; arguments as :func:`tunnel`."""
    half = rng.uniform(*CORRIDOR_WIDTH) / 2
    sides = []
    for aside in (half, -half):
        features: list[Feature] = []
        along = rng.uniform(0, DOORS[1])
        # All doors of a side have the same frames.
        frame, out, back = rng.uniform(*FRAME), rng.uniform(*FRAME_DEPTH), rng.uniform(*LEAF_DEPTH)
        while along < length - DOORS[0]:
            first, last = along + frame, along + frame + rng.uniform(*DOOR)
            features += [(along, first, out, 0.0), (first, last, back, 0.0), (last, last + frame, out, 0.0)]
            along = last + frame + rng.uniform(*DOORS)
        sides.append(_wall(way, length, aside, features, PLASTER, HEIGHTS))
    return join(sides)


def open_ground(way: Way, length: float, rng: np.random.Generator) -> Walls:
    """Snow poles along a track, some missing, and a few bushes and posts; arguments as :func:`tunnel`."""
    drawn = Side(rng, length, SIGHT)
    spacing, aside = rng.uniform(*POLES), rng.uniform(*POLE_ASIDE)
    for side in (aside, -aside):
        along = np.arange(rng.uniform(0, spacing), length, spacing)
        along = along + 0.05 * spacing * rng.standard_normal(len(along))
        stands = rng.random(len(along)) >= POLES_GONE
        for x, y in way.place(along, np.full(len(along), side))[stands].tolist():
            drawn.post(x, y, rng.uniform(*POLE_RADIUS), TRUNK, top=rng.uniform(2.2, 3.0))
    count = rng.poisson(rng.uniform(*BUSHES) * length * 2 * SIGHT)
    scattered = way.place(rng.uniform(0, length, count), rng.uniform(-SIGHT, SIGHT, count))
    away, _ = cKDTree(way.points).query(scattered)
    for x, y in scattered[away > CLEAR + 2].tolist():
        if rng.random() < 0.7:
            drawn.leaves(x, y, rng.uniform(0.3, 1.2), top=rng.uniform(1.5, 3.0))
        else:
            drawn.post(x, y, rng.uniform(0.04, 0.12), TRUNK, top=rng.uniform(2.0, 5.0))
    rows = np.concatenate(drawn.rows)
    return Walls(rows[:, :4], rows[:, 4:6], rows[:, 6], rows[:, 7])


def _wall(
    way: Way,
    length: float,
    aside: float,
    features: list[Feature],
    material: Material,
    heights: tuple[float, float],
) -> Walls:
    """Draw a wall beside a way in short pieces.

    Args:
        way: the way.
        length: metres of the way that have a wall.
        aside: metres from the way to the wall; negative: on the right.
        features: features of the wall, in order.
        material: material of the wall.
        heights: metres, bottom and top of the wall.
    """
    out = np.sign(aside)
    corners: list[tuple[float, float]] = [(0.0, aside)]
    for start, end, depth, taper in features:
        back = aside + out * depth
        corners += [(start, aside), (start + taper, back), (end - taper, back), (end, aside)]
    corners.append((length, aside))
    line = _add_points(np.array(corners))
    placed = way.place(line[:, 0], line[:, 1])
    count = len(line) - 1
    return Walls(
        np.concatenate([placed[:-1], placed[1:]], axis=1),
        np.tile(heights, (count, 1)),
        np.full(count, material.returned),
        np.full(count, material.roughness),
    )


def _add_points(corners: FloatArray) -> FloatArray:
    """Add points to a line with corners (K, 2), so that neighbouring points are at most ``PIECE`` apart."""
    away = np.hypot(*np.diff(corners, axis=0).T)
    kept = np.concatenate([[True], away > 0])
    corners, away = corners[kept], away[kept[1:]]
    counts = np.ceil(away / PIECE).astype(np.int64)
    at = np.concatenate([[0.0], np.cumsum(counts)])
    fine = np.arange(counts.sum() + 1)
    return np.stack([np.interp(fine, at, values) for values in corners.T], axis=1)
