"""What stands along a way: a tunnel's lining, a corridor's walls, poles and bushes on open ground."""

import numpy as np
from scipy.spatial import cKDTree

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.blind.way import Way
from rcnn_odom.simulation.drawing import HEIGHTS, PLASTER
from rcnn_odom.simulation.scene import Material, Walls, join
from rcnn_odom.simulation.street.street import TRUNK, Side

CONCRETE = Material(returned=0.99, roughness=0.01)
TUNNEL_HEIGHTS = (-1.0, 6.0)
PIECE = 1.0
"""Metres, longest straight wall: with longer ones a smooth bend would have corners to hold on to."""

TUNNEL_WIDTH = (8.5, 10.5)
"""Two lanes and a walkway at each side."""
TUNNEL_FEATURES = (25.0, 60.0)
"""Metres from one thing on the walls to the next, on either side."""
NICHE = (1.0, 2.5), (0.5, 1.2)
"""Metres of a niche for a telephone or a hydrant, or of a door: along the wall, and deep."""
PILLAR = (0.4, 1.0), (-0.4, -0.15)
BAY = (30.0, 45.0), (2.5, 3.2)
"""A bay for cars that break down, whose ends are slanted by ``BAY_TAPER`` metres."""
BAY_TAPER = 6.0
NICHES, PILLARS = 0.55, 0.35
"""Their shares of all things on the walls; the rest are bays."""

CORRIDOR_WIDTH = (2.0, 3.2)
DOORS = (5.0, 15.0)
"""Metres from one door to the next on the same side."""
DOOR, FRAME = (0.85, 1.2), (0.06, 0.1)
"""Metres along the wall of a leaf and of each side of its frame."""
FRAME_DEPTH, LEAF_DEPTH = (-0.04, -0.01), (0.01, 0.06)
"""Metres by which a frame stands out and its closed leaf stands back."""

POLES = (25.0, 50.0)
"""Metres from one snow pole to the next, at both sides of the track."""
POLE_ASIDE, POLE_RADIUS, POLES_GONE = (2.5, 5.0), (0.03, 0.06), 0.15
BUSHES = (1 / 4000, 1 / 1200)
"""Bushes and lonely posts a square metre."""
SIGHT, CLEAR = 85.0, 4.0
"""Metres from the track within which they stand, a little more than the laser sees, and which are free."""

Feature = tuple[float, float, float, float]
"""Where it begins and ends along the wall, by how much it stands back, and how long its ends are; metres."""


def tunnel(way: Way, length: float, rng: np.random.Generator) -> Walls:
    """Two smooth walls, as far apart as two lanes need, with something on either every 25 to 60 metres."""
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
    """Two flat walls with a closed door in its frame every 5 to 15 metres on either side."""
    half = rng.uniform(*CORRIDOR_WIDTH) / 2
    sides = []
    for aside in (half, -half):
        features: list[Feature] = []
        along = rng.uniform(0, DOORS[1])
        # One carpenter made them all.
        frame, out, back = rng.uniform(*FRAME), rng.uniform(*FRAME_DEPTH), rng.uniform(*LEAF_DEPTH)
        while along < length - DOORS[0]:
            first, last = along + frame, along + frame + rng.uniform(*DOOR)
            features += [(along, first, out, 0.0), (first, last, back, 0.0), (last, last + frame, out, 0.0)]
            along = last + frame + rng.uniform(*DOORS)
        sides.append(_wall(way, length, aside, features, PLASTER, HEIGHTS))
    return join(sides)


def open_ground(way: Way, length: float, rng: np.random.Generator) -> Walls:
    """Snow poles along a track, some of them gone, and a bush or a post here and there."""
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
    """A wall beside a way, negative to the right of it, drawn in short pieces from corner to corner."""
    out = np.sign(aside)
    corners: list[tuple[float, float]] = [(0.0, aside)]
    for start, end, depth, taper in features:
        back = aside + out * depth
        corners += [(start, aside), (start + taper, back), (end - taper, back), (end, aside)]
    corners.append((length, aside))
    line = _in_pieces(np.array(corners))
    placed = way.place(line[:, 0], line[:, 1])
    count = len(line) - 1
    return Walls(
        np.concatenate([placed[:-1], placed[1:]], axis=1),
        np.tile(heights, (count, 1)),
        np.full(count, material.returned),
        np.full(count, material.roughness),
    )


def _in_pieces(corners: FloatArray) -> FloatArray:
    """The corners (K, 2) of a line with points between them, none farther than ``PIECE`` from the next."""
    away = np.hypot(*np.diff(corners, axis=0).T)
    kept = np.concatenate([[True], away > 0])
    corners, away = corners[kept], away[kept[1:]]
    counts = np.ceil(away / PIECE).astype(np.int64)
    at = np.concatenate([[0.0], np.cumsum(counts)])
    fine = np.arange(counts.sum() + 1)
    return np.stack([np.interp(fine, at, values) for values in corners.T], axis=1)
