"""A generated city, as seen at the height of a laser: houses, parked cars, trees and poles along streets.

The city is drawn on a straight grid, where a street is easy to describe, and then bent by a smooth
`Warp`, so that no street is straight. Everything ends up as line segments. A route is a drive through
the plan, still to be bent.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from rcnn_odom.motion import FloatArray

BLOCKS = 8
"""Blocks along each side of the city."""

LANE_OFFSET = 1.2
STOP_LINE_BEFORE_CROSSING = 14.0


@dataclass(frozen=True)
class Surface:
    """How a laser sees a material.

    Attributes:
        returned: chance that a beam comes back.
        roughness: standard deviation of the depth in metres, beyond the laser's own noise.
    """

    returned: float
    roughness: float


WALL = Surface(returned=1.0, roughness=0.0)
GLASS = Surface(returned=0.25, roughness=0.0)
PAINT = Surface(returned=0.97, roughness=0.01)
DARK_PAINT = Surface(returned=0.4, roughness=0.01)
HEDGE = Surface(returned=0.97, roughness=0.1)
TRUNK = Surface(returned=1.0, roughness=0.01)


@dataclass(frozen=True)
class Warp:
    """A sum of long waves that bends the plane a little.

    Attributes:
        waves: (K, 2) wave vectors in radians per metre.
        phases: (K,) radians.
        pushes: (K, 2) metres by which each wave moves a point at its crest.
    """

    waves: FloatArray
    phases: FloatArray
    pushes: FloatArray

    def __call__(self, points: FloatArray) -> FloatArray:
        """Where points (..., 2) of the straight plan lie in the city, metres."""
        return points + np.sin(points @ self.waves.T + self.phases) @ self.pushes


def random_warp(rng: np.random.Generator, count: int = 8) -> Warp:
    """A warp of several metres whose waves are 120 to 500 metres long."""
    length = rng.uniform(120, 500, (count, 1))
    waves = 2 * np.pi / length * _random_directions(rng, count)
    # As high as they are long, so that none squeezes a street by more than a twentieth.
    pushes = length * rng.uniform(0.005, 0.008, (count, 1)) * _random_directions(rng, count)
    return Warp(waves, rng.uniform(0, 2 * np.pi, count), pushes)


def _random_directions(rng: np.random.Generator, count: int) -> FloatArray:
    """Unit vectors (count, 2)."""
    angle = rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


@dataclass(frozen=True)
class Plan:
    """Where the streets of the straight city run; along its rim there is no street.

    Attributes:
        centres: (2, BLOCKS + 1) metres: x of the streets that run along y, and y of those along x.
        half_widths: (2, BLOCKS + 1) metres from the middle of a street to the front gardens.
    """

    centres: FloatArray
    half_widths: FloatArray

    def blocks(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        """Lower left and upper right corner, both (2,), of every block."""
        low, high = self.centres + self.half_widths, self.centres - self.half_widths
        for i in range(BLOCKS):
            for j in range(BLOCKS):
                yield np.array([low[0, i], low[1, j]]), np.array([high[0, i + 1], high[1, j + 1]])


def random_plan(rng: np.random.Generator) -> Plan:
    """Streets 12 to 18 metres wide between blocks of 50 to 120 metres."""
    half_widths = rng.uniform(6, 9, (2, BLOCKS + 1))
    pitch = rng.uniform(50, 120, (2, BLOCKS)) + half_widths[:, 1:] + half_widths[:, :-1]
    return Plan(np.concatenate([np.zeros((2, 1)), np.cumsum(pitch, axis=1)], axis=1), half_widths)


class _Side:
    """One side of a block, drawn in metres along the street and inwards (negative: into the street)."""

    def __init__(self, rng: np.random.Generator, length: float) -> None:
        self.rng = rng
        self.length = length
        self.segments: list[tuple[float, float, float, float]] = []
        self.surfaces: list[Surface] = []

    def line(self, points: list[tuple[float, float]], surface: Surface) -> None:
        """Draw straight lines from point to point."""
        for (along, inward), (next_along, next_inward) in pairwise(points):
            self.segments.append((along, inward, next_along, next_inward))
            self.surfaces.append(surface)

    def post(self, along: float, inward: float, radius: float, surface: Surface) -> None:
        """Draw a six-sided post."""
        corners = radius * np.exp(1j * (np.pi / 3 * np.arange(7) + self.rng.uniform(0, np.pi)))
        self.line([(along + corner.real, inward + corner.imag) for corner in corners.tolist()], surface)

    def houses(self) -> None:
        """Houses side by side from corner to corner, some with a driveway or a hedge in between."""
        usual_setback = self.rng.uniform(0, 4)
        along = self.rng.uniform(0, 2)
        while along < self.length - 8:
            end = min(along + self.rng.uniform(8, 25), self.length)
            setback = float(np.clip(usual_setback + self.rng.normal(0, 1), 0, 5))
            self.house(along, end, setback)
            if setback > 2 and self.rng.random() < 0.4:
                self.line([(along, 0.3), (end - self.rng.uniform(2, 4), 0.3)], HEDGE)
            along = end + (self.rng.uniform(2.5, 7) if self.rng.random() < 0.4 else 0.0)

    def house(self, start: float, end: float, front: float) -> None:
        """A house whose front is a row of walls, bays and windows."""
        back = front + self.rng.uniform(8, 13)
        self.line([(start, front), (start, back), (end, back), (end, front)], WALL)
        while start < end:
            piece_end = min(start + self.rng.uniform(1.2, 4), end)
            glazed = self.rng.random() < 0.12
            relief = front + self.rng.choice([0.0, 0.0, 0.15, 0.5])
            self.line([(start, front), (start, relief)], WALL)
            self.line([(start, relief), (piece_end, relief)], GLASS if glazed else WALL)
            self.line([(piece_end, relief), (piece_end, front)], WALL)
            start = piece_end

    def park(self) -> None:
        """A hedge with openings, and trees and bushes behind it."""
        along = 0.0
        while along < self.length:
            end = min(along + self.rng.uniform(5, 30), self.length)
            self.line([(along, 1.0), (end, 1.0)], HEDGE)
            along = end + self.rng.uniform(3, 12)
        for _ in range(int(self.length / 5)):
            where, depth = self.rng.uniform(0, self.length), self.rng.uniform(2, 25)
            if self.rng.random() < 0.4:
                self.post(where, depth, self.rng.uniform(0.5, 1.5), HEDGE)
            else:
                self.post(where, depth, self.rng.uniform(0.15, 0.35), TRUNK)

    def parked_cars(self) -> None:
        """Cars along the kerb; none so near a corner that a turning vehicle would need the place."""
        occupied = self.rng.uniform(0.1, 0.7)
        along = 6 + self.rng.uniform(0, 3)
        while along < self.length - 10.5:
            if self.rng.random() < occupied:
                kerb = -1.1 + self.rng.normal(0, 0.05)
                surface = DARK_PAINT if self.rng.random() < 0.15 else PAINT
                street, end = kerb - 1.8, along + 4.2
                self.line(
                    [(along, kerb), (end, kerb), (end, street), (along, street), (along, kerb)], surface
                )
            along += 4.2 + self.rng.uniform(0.5, 1.8)

    def trees_and_poles(self) -> None:
        """A row of trees in some streets, and lamp posts and signs in all of them."""
        spacing = self.rng.uniform(9, 18) if self.rng.random() < 0.4 else 30.0
        along = self.rng.uniform(4, 10)
        while along < self.length - 4:
            radius = self.rng.uniform(0.1, 0.15) if spacing == 30.0 else self.rng.uniform(0.15, 0.35)
            self.post(along, -0.6, radius, TRUNK)
            along += spacing * self.rng.uniform(0.7, 1.3)


@dataclass(frozen=True)
class City:
    """What a laser can see, and where one can drive.

    Attributes:
        plan: the streets before the warp.
        warp: from the plan to the world.
        segments: (S, 4) x, y of one end and x, y of the other, metres.
        returned: (S,) chance that a beam on a segment comes back.
        roughness: (S,) metres, standard deviation of the depth of a segment.
    """

    plan: Plan
    warp: Warp
    segments: FloatArray
    returned: FloatArray
    roughness: FloatArray


def build_city(rng: np.random.Generator) -> City:
    """A new city: every draw from ``rng`` gives another one."""
    plan, warp = random_plan(rng), random_warp(rng)
    segments: list[FloatArray] = []
    surfaces: list[Surface] = []
    for low, high in plan.blocks():
        is_park = rng.random() < 0.12
        for corner, along in _sides(low, high):
            side = _Side(rng, float(np.hypot(*along)))
            side.park() if is_park else side.houses()
            side.parked_cars()
            side.trees_and_poles()
            forward = along / side.length
            inward = np.array([-forward[1], forward[0]])
            drawn = np.array(side.segments).reshape(-1, 2, 2)
            segments.append(corner + drawn @ np.stack([forward, inward]))
            surfaces += side.surfaces
    bent = warp(np.concatenate(segments)).reshape(-1, 4)
    returned, roughness = np.array([(surface.returned, surface.roughness) for surface in surfaces]).T
    # A window flush with its neighbours draws posts of no width; they hide nothing.
    seen = np.hypot(bent[:, 2] - bent[:, 0], bent[:, 3] - bent[:, 1]) > 1e-6
    return City(plan, warp, bent[seen], returned[seen], roughness[seen])


def _sides(low: FloatArray, high: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """First corner and extent, both (2,), of the sides of a block, counter-clockwise."""
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]], low])
    return [(corner, following - corner) for corner, following in pairwise(corners)]


def random_route(plan: Plan, length: float, rng: np.random.Generator) -> tuple[FloatArray, list[int]]:
    """A random walk over the crossings on the right of the road, at least ``length`` metres long.

    Returns:
        Way points (W, 2) in the straight plan, and which of them are stop lines.
    """
    crossing = rng.integers(1, BLOCKS, 2)
    direction = np.array([1, 0]) if crossing[0] < BLOCKS // 2 else np.array([-1, 0])
    points = [_crossing_point(plan, crossing) + 15 * direction + LANE_OFFSET * _right_of(direction)]
    stop_lines: list[int] = []
    driven, straight_ahead = 0.0, 0
    # More than asked for: rounding, bending and averaging the route shorten it.
    while driven < 1.1 * length + 200:
        crossing = crossing + direction
        following = _next_direction(crossing, direction, straight_ahead < 2, rng)
        straight_ahead = straight_ahead + 1 if (following == direction).all() else 0
        vertex = _crossing_point(plan, crossing) + LANE_OFFSET * _right_of(direction)
        if (following != direction).any():
            vertex = vertex + LANE_OFFSET * _right_of(following)
        driven += float(np.abs(vertex - points[-1]).sum())
        stop_lines.append(len(points))
        points.append(vertex - STOP_LINE_BEFORE_CROSSING * direction)
        if (following != direction).any():
            points.extend(_corner(vertex, direction, following, rng.uniform(7.5, 12)))
        direction = following
    return np.array(points), stop_lines


def _crossing_point(plan: Plan, crossing: npt.NDArray[np.int64]) -> FloatArray:
    return np.array([plan.centres[0, crossing[0]], plan.centres[1, crossing[1]]])


def _right_of(direction: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    return np.array([direction[1], -direction[0]])


def _next_direction(
    crossing: npt.NDArray[np.int64],
    direction: npt.NDArray[np.int64],
    may_go_straight: bool,
    rng: np.random.Generator,
) -> npt.NDArray[np.int64]:
    """Straight on, right or left, whichever stays on streets that have houses on both sides."""
    ways = [direction, _right_of(direction), -_right_of(direction)]
    chances = np.array([0.8 * may_go_straight, 0.1, 0.1])
    for index, way in enumerate(ways):
        if not ((crossing + way >= 1) & (crossing + way < BLOCKS)).all():
            chances[index] = 0
    return ways[rng.choice(3, p=chances / chances.sum())]


def _corner(
    vertex: FloatArray, before: npt.NDArray[np.int64], after: npt.NDArray[np.int64], radius: float
) -> FloatArray:
    """Quarter circle (16, 2) that leads from one direction into the other."""
    angle = np.linspace(0, np.pi / 2, 16)[:, None]
    return vertex + radius * (after * (1 - np.cos(angle)) - before * (1 - np.sin(angle)))
