"""Generates the streets of a city, and routes through them.

The streets are planned on a straight grid, where blocks and their sides are easy to describe. Then a smooth
`Warp` bends them, slightly in a town and strongly in the country. A route is planned on the straight grid as
well; ``line.py`` bends it and rounds its corners.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray

BLOCKS = 8
"""Blocks along each side of the city."""

LANE_OFFSET = 1.2
"""Metres from the middle of a street to the line on which cars drive, on the right side."""

KERB = 3.2
"""Metres from the front gardens to the free part of the street, for the pavement and parked cars."""

TIGHTEST_TURN_SIDE = 3.9
"""Metres that a car needs between its line and the inner kerb for a turn at a crossing; if a street has less
room, the car swings out."""

SWING_LENGTH = 25.0
"""Metres before and after a crossing over which the car swings out."""

AGAIN = 0.5
"""Factor of the probability of a street for each time that it has been driven already."""

KERB_POINTS = np.arange(0.0, 48.0, 6.0)[:, None]
"""Metres from a corner to the points that represent its kerbs."""

BEND_VARIES = (0.4, 1.05)
"""Range of a city's bend as a factor of the usual bend of its kind of roads."""

Cell = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Roads:
    """A kind of roads: their geometry and how they are driven; pairs of numbers are ranges.

    The numbers are fitted to KITTI's sequences 00 02 03 04 06 08 09: to their curvature, the distance between
    turns, and their speeds.

    Attributes:
        block: metres, length of a block's side.
        half_width: metres from the middle of a street to the front gardens.
        wave: metres, wavelengths of the waves that bend the roads.
        bend: sum of the slopes of these waves, along the one and the other axis of the plan.
        turn: probability of turning at a crossing.
        right_radius: metres, wanted radius at the tightest point of a right turn.
        left_radius: metres, the same for a left turn, which is wider because it crosses the street.
        speed: metres per second, wanted speed on a free road.
        gives_way: probability of slowing down at a crossing that is passed straight on.
        stops: probability of a full stop at any crossing.
        straying: metres, amplitude of the deviation from the middle of the lane.
        roughness: roughness of the road; 1 is usual in a town.
    """

    block: tuple[float, float]
    half_width: tuple[float, float]
    wave: tuple[float, float]
    bend: tuple[float, float]
    turn: float
    right_radius: tuple[float, float]
    left_radius: tuple[float, float]
    speed: tuple[float, float]
    gives_way: float
    stops: float
    straying: tuple[float, float]
    roughness: tuple[float, float]


RESIDENTIAL = Roads(
    block=(45, 110),
    half_width=(7, 11),
    wave=(100, 350),
    bend=(0.3, 0.3),
    turn=0.6,
    right_radius=(6, 10),
    left_radius=(6, 13),
    speed=(8.5, 12.5),
    gives_way=0.5,
    stops=0.022,
    straying=(0.1, 0.3),
    roughness=(0.8, 1.2),
)
"""As in 00 and 08: a turn every 150 metres, and nearly always accelerating or braking."""

COUNTRY = Roads(
    block=(90, 220),
    half_width=(9, 14),
    wave=(100, 220),
    bend=(0.85, 0.15),
    turn=0.45,
    right_radius=(8, 30),
    left_radius=(8, 45),
    speed=(8.5, 14),
    gives_way=0.12,
    stops=0.016,
    straying=(0.05, 0.15),
    roughness=(0.7, 1.1),
)
"""As in 02, 03 and 09: winding roads."""

MAIN = Roads(
    block=(120, 260),
    half_width=(9, 14),
    wave=(400, 900),
    bend=(0.04, 0.04),
    turn=0.2,
    right_radius=(7, 9),
    left_radius=(7, 12),
    speed=(12, 14.5),
    gives_way=0.25,
    stops=0.015,
    straying=(0.05, 0.2),
    roughness=(0.3, 0.9),
)
"""As in 04 and 06: straight and fast roads with few turns."""

SHARES = {RESIDENTIAL: 0.5, COUNTRY: 0.4, MAIN: 0.1}
"""Probability of each kind: its share of the frames of those seven sequences."""


@dataclass(frozen=True)
class Warp:
    """A smooth deformation of the plane by a sum of long waves.

    Attributes:
        waves: (K, 2) wave vectors in radians per metre.
        phases: (K,) radians.
        pushes: (K, 2) metres, displacement of a point at the crest of each wave.
    """

    waves: FloatArray
    phases: FloatArray
    pushes: FloatArray

    def __call__(self, points: FloatArray) -> FloatArray:
        """Map points (..., 2) of the straight plan to points (..., 2) in the city, both in metres."""
        return points + np.sin(points @ self.waves.T + self.phases) @ self.pushes


@dataclass(frozen=True)
class Plan:
    """The straight plan of the streets of a city; there is no street along its rim.

    Attributes:
        centres: (2, BLOCKS + 1) metres: x of the streets that run along y, and y of those along x.
        half_widths: (2, BLOCKS + 1) metres from the middle of a street to the front gardens.
        roads: kind of the streets.
    """

    centres: FloatArray
    half_widths: FloatArray
    roads: Roads = RESIDENTIAL

    def blocks(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Yield the lower left and the upper right corner, both (2,), of each block."""
        low, high = self.centres + self.half_widths, self.centres - self.half_widths
        for i in range(BLOCKS):
            for j in range(BLOCKS):
                yield np.array([low[0, i], low[1, j]]), np.array([high[0, i + 1], high[1, j + 1]])

    def crossing(self, cell: Cell) -> FloatArray:
        """Middle (2,) of a crossing in metres; ``cell`` (2,) are the indices of its streets."""
        return self.centres[[0, 1], cell]

    def room(self, cell: Cell) -> FloatArray:
        """Metres (2,) in x and in y from the middle of a crossing to the parked cars."""
        return self.half_widths[[0, 1], cell] - KERB


def random_plan(rng: np.random.Generator) -> Plan:
    """A random plan with a random kind of roads."""
    roads = list(SHARES)[rng.choice(len(SHARES), p=list(SHARES.values()))]
    half_widths = rng.uniform(*roads.half_width, (2, BLOCKS + 1))
    pitch = rng.uniform(*roads.block, (2, BLOCKS)) + half_widths[:, 1:] + half_widths[:, :-1]
    centres = np.concatenate([np.zeros((2, 1)), np.cumsum(pitch, axis=1)], axis=1)
    return Plan(centres, half_widths, roads)


def random_warp(plan: Plan, rng: np.random.Generator, count: int = 3) -> Warp:
    """Random waves that bend the streets of a plan as its kind of roads requires.

    The waves are transversal and run nearly along the axes of the plan, so they bend streets but hardly
    compress them.

    Args:
        plan: the plan.
        rng: source of all random choices.
        count: number of waves along each axis.
    """
    axis = np.arange(2).repeat(count)
    if rng.random() < 0.5:
        axis = 1 - axis
    length = rng.uniform(*plan.roads.wave, 2 * count)
    share = rng.uniform(0.5, 1.5, (2, count))
    bend = rng.uniform(*BEND_VARIES) * np.array(plan.roads.bend)
    slope = (share / share.sum(axis=1, keepdims=True) * bend[:, None]).ravel()
    direction = axis * np.pi / 2 + rng.normal(0, 0.1, 2 * count)
    along = np.stack([np.cos(direction), np.sin(direction)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    waves = 2 * np.pi / length[:, None] * along
    pushes = (slope * length / (2 * np.pi))[:, None] * across
    return Warp(waves, rng.uniform(0, 2 * np.pi, 2 * count), pushes)


@dataclass(frozen=True)
class Route:
    """A route through the straight plan: W way points, C of which are crossings.

    Attributes:
        points: (W, 2) metres.
        crossings: (C,) indices of the way points that are crossings.
        turn: (C,) 1 for a left turn there, -1 for a right turn, 0 for straight on.
        inner: (C, K, 2) metres, points on the inner kerbs of a turn, before and after its corner.
    """

    points: FloatArray
    crossings: Cell
    turn: Cell
    inner: FloatArray


def random_route(plan: Plan, length: float, rng: np.random.Generator) -> Route:
    """A random walk over the crossings on the right side of the road, longer than ``length`` metres.

    New streets are preferred, but some are driven again, in either direction. With the same ``rng``, a longer
    route begins like a shorter one.
    """
    cell = rng.integers(2, BLOCKS - 1, 2)
    way = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])[rng.integers(4)]
    points = [plan.crossing(cell) + 15 * way + LANE_OFFSET * _right_of(way)]
    crossings, turns, inner = [], [], []
    driven, visits = 0.0, dict[tuple[int, ...], int]()
    while driven < length:
        street = (*(cell + cell + way).tolist(),)
        visits[street] = visits.get(street, 0) + 1
        cell = cell + way
        following = _next_way(cell, way, plan.roads.turn, visits, rng)
        turn = int(way[0] * following[1] - way[1] * following[0])
        vertex = _vertex(plan, cell, way, following, turn)
        driven += float(np.hypot(*(vertex - points[-1])))
        if turn:
            lane = plan.crossing(cell) + LANE_OFFSET * (_right_of(way) + _right_of(following))
            points += [lane - SWING_LENGTH * way, vertex, lane + SWING_LENGTH * following]
            driven += SWING_LENGTH
            crossings.append(len(points) - 2)
        else:
            points.append(vertex)
            crossings.append(len(points) - 1)
        turns.append(turn)
        corner = plan.crossing(cell) + plan.room(cell) * (following - way)
        inner.append(corner + np.concatenate([-KERB_POINTS * way, KERB_POINTS * following]))
        way = following
    return Route(np.array(points), np.array(crossings), np.array(turns), np.array(inner))


def _vertex(plan: Plan, cell: Cell, way: Cell, following: Cell, turn: int) -> FloatArray:
    """The point (2,) in metres where the lines before and after a crossing meet."""
    # The offset of a street shifts the line along one axis only, so one pair holds both offsets.
    offset = np.full(2, LANE_OFFSET)
    if turn < 0:
        offset = np.minimum(offset, plan.room(cell) - TIGHTEST_TURN_SIDE)
    sides = _right_of(way) + (_right_of(following) if turn else 0)
    vertex: FloatArray = plan.crossing(cell) + offset * sides
    return vertex


def _right_of(way: Cell) -> Cell:
    """The direction to the right of a direction, both (2,)."""
    return np.array([way[1], -way[0]])


def _next_way(
    cell: Cell, way: Cell, turn: float, visits: dict[tuple[int, ...], int], rng: np.random.Generator
) -> Cell:
    """Choose straight on, right or left at random, among streets that have blocks on both sides."""
    ways = [way, _right_of(way), -_right_of(way)]
    chances = np.array([1 - turn, turn / 2, turn / 2])
    for index, one in enumerate(ways):
        inside = ((cell + one >= 1) & (cell + one < BLOCKS)).all()
        chances[index] *= inside * AGAIN ** visits.get((*(cell + cell + one).tolist(),), 0)
    return ways[rng.choice(3, p=chances / chances.sum())]
