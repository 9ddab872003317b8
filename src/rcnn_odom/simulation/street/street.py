"""Generates the objects along the streets of a city: houses, walls, hedges, trees, parked cars, signs.

Each side of a block is drawn on the straight plan, in metres along the street and inwards, and then bent into
the city by the plan's warp. Only objects that a level laser on a car's roof can hit, about 1.9 m above the
road, are drawn: house fronts and their gaps, what is seen through a gap, and objects of about that height.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.scene import Material, Walls
from rcnn_odom.simulation.street.city import COUNTRY, MAIN, RESIDENTIAL, Plan, Roads, Warp
from rcnn_odom.simulation.terrain import Ground

SIGHT = 90.0
"""Metres from the driven line within which blocks are drawn, slightly more than the laser's range."""

WALL = Material(returned=0.996)
STONE = Material(returned=0.99, roughness=0.03)
GLASS = Material(returned=0.3)
PAINT = Material(returned=0.97, roughness=0.01)
DARK_PAINT = Material(returned=0.35, roughness=0.01)
HEDGE = Material(returned=0.98, roughness=0.08)
LEAVES = Material(returned=0.96, roughness=0.05)
TRUNK = Material(returned=0.98, roughness=0.01)
WIRE = Material(returned=0.15, roughness=0.01)

BELOW_GROUND = -3.0
"""Metres, bottom of objects on the ground, deep enough for any slope of the ground."""

PIECE = 6.0
"""Metres, longest straight wall; longer walls would cut across the bends of a winding road."""

Corner = tuple[float, float]
"""Metres along the street and inwards."""


class Side:
    """One side of a block, on which objects are drawn.

    Coordinates are metres along the street and inwards (negative: into the street), heights are metres above
    the ground.

    Args:
        rng: source of all random choices.
        length: metres, length of the side.
        depth: metres, depth of the block.

    Attributes:
        rows: arrays (W, 8) of walls: both ends (4), bottom, top, returned, roughness.
    """

    def __init__(self, rng: np.random.Generator, length: float, depth: float) -> None:
        self.rng, self.length, self.depth = rng, length, depth
        self.rows: list[FloatArray] = []

    def line(
        self, points: list[Corner], material: Material, top: float, bottom: float = BELOW_GROUND
    ) -> None:
        """Draw a wall along a line through points."""
        surface = (bottom, top, material.returned, material.roughness)
        self.rows.append(np.array([(*start, *end, *surface) for start, end in pairwise(points)]))

    def box(
        self, start: Corner, end: Corner, material: Material, top: float, bottom: float = BELOW_GROUND
    ) -> None:
        """Draw the four walls of a rectangle, given by two opposite corners."""
        self.line(rectangle(start, end), material, top, bottom)

    def post(self, along: float, inward: float, radius: float, material: Material, top: float) -> None:
        """Draw a five-sided post."""
        corners = radius * np.exp(1j * (0.4 * np.pi * np.arange(6) + self.rng.uniform(0, np.pi)))
        points = [(along + corner.real, inward + corner.imag) for corner in corners.tolist()]
        self.line(points, material, top)

    def leaves(
        self, along: float, inward: float, radius: float, top: float, bottom: float = BELOW_GROUND
    ) -> None:
        """Draw a bush or the crown of a tree: scattered pieces of leaves with gaps for beams."""
        count = int(6 + 10 * radius)
        where = radius * np.sqrt(self.rng.random(count)) * np.exp(2j * np.pi * self.rng.random(count))
        self._pieces(along + where.real, inward + where.imag, (0.05, 0.3), top, bottom)

    def thicket(self, start: float, end: float, inward: float, top: float) -> None:
        """Draw the edge of a wood or an overgrown fence, which beams enter to different depths."""
        count = int((end - start) * self.rng.uniform(1.5, 3.0))
        deep = inward + self.rng.exponential(self.rng.uniform(0.2, 1.5), count)
        self._pieces(self.rng.uniform(start, end, count), deep, (0.3, 1.0), top, BELOW_GROUND)

    def _pieces(
        self, along: FloatArray, inward: FloatArray, sizes: tuple[float, float], top: float, bottom: float
    ) -> None:
        """Draw pieces of leaves at points (P,), in random directions, each about as high as the whole."""
        count = len(along)
        half = self.rng.uniform(*sizes, count) * np.exp(1j * np.pi * self.rng.random(count))
        reach = np.clip(self.rng.normal(0.95, 0.25, count), 0.3, 1.0)
        rows = [along - half.real, inward - half.imag, along + half.real, inward + half.imag]
        foot = max(bottom, 0.0)
        rows += [np.full(count, bottom), foot + (top - foot) * reach]
        rows += [np.full(count, LEAVES.returned), np.full(count, LEAVES.roughness)]
        self.rows.append(np.stack(rows, axis=1))

    def tree(self, along: float, inward: float) -> None:
        """Draw a trunk, and sometimes a crown that reaches down to the laser's height."""
        self.post(along, inward, self.rng.uniform(0.08, 0.3), TRUNK, top=6.0)
        if self.rng.random() < 0.35:
            self.leaves(along, inward, self.rng.uniform(0.8, 2.2), 6.0, bottom=self.rng.uniform(1.3, 2.4))

    # --- kinds of sides --------------------------------------------------------------------------

    def town(self) -> None:
        """Draw adjacent house fronts, with a few gaps."""
        setback = self.rng.uniform(0, 4)
        along = self.rng.uniform(0, 4)
        while along < self.length - 6:
            end = min(along + self.rng.uniform(8, 30), self.length)
            self.house(along, end, max(0.0, setback + self.rng.normal(0, 0.8)), self.rng.uniform(8, 13))
            along = end + (self.rng.uniform(2.5, 8) if self.rng.random() < 0.25 else 0.0)
        self.backyards(setback + 14)

    def suburb(self) -> None:
        """Draw houses in gardens, with fences, hedges and garages."""
        setback = self.rng.uniform(3, 9)
        along = self.rng.uniform(0, 8)
        while along < self.length - 8:
            end = min(along + self.rng.uniform(8, 16), self.length)
            front = max(1.0, setback + self.rng.normal(0, 1.5))
            self.house(along, end, front, self.rng.uniform(8, 11))
            next_house = end + self.rng.uniform(3, 14)
            self.front_garden(along, min(next_house, self.length), front)
            room = min(next_house, self.length) - end
            if self.rng.random() < 0.4 and room > 4:
                self.box((end + 0.5, front + 2), (end + 3.7, front + 8), WALL, top=2.6)  # a garage
            if self.rng.random() < 0.3 and next_house < self.length:
                self.line([(next_house - 1, front), (next_house - 1, self.depth / 2)], HEDGE, top=2.0)
            along = next_house
        self.backyards(10)

    def estate(self) -> None:
        """Draw long blocks of flats or halls far from the road, behind lawns, trees or a fence."""
        setback = min(self.rng.uniform(5, 16), self.depth / 3)
        along = self.rng.uniform(0, 20)
        while along < self.length - 15:
            end = min(along + self.rng.uniform(20, 70), self.length)
            self.house(along, end, setback + self.rng.normal(0, 2), self.rng.uniform(10, 14))
            along = end + self.rng.uniform(4, 25)
        if self.rng.random() < 0.4:
            self.line([(0, 1.0), (self.length, 1.0)], WIRE, top=2.0)
        for where in np.arange(self.rng.uniform(3, 12), self.length, self.rng.uniform(8, 20)):
            self.tree(float(where), self.rng.uniform(1, setback - 2))
        self.bushes(0.03, 1, setback)
        self.backyards(setback + 16)

    def wood(self) -> None:
        """Draw trees and bushes, or a park behind a hedge."""
        if self.rng.random() < 0.4:
            self.broken_line(1.0, HEDGE, self.rng.uniform(1.5, 2.5), (5, 40), (2, 12))
        if self.rng.random() < 0.7:
            self.broken_thicket(self.rng.uniform(0.5, 8))
        for _ in range(int(self.length * self.rng.uniform(0.1, 0.5))):
            self.tree(self.rng.uniform(0, self.length), self.rng.uniform(1.5, min(25, self.depth / 2)))
        self.bushes(self.rng.uniform(0.05, 0.25), 1, min(20, self.depth / 2))
        self.backyards(min(25, self.depth / 3))

    def field(self) -> None:
        """Draw open land with few objects: fences, hedges, bushes or single trees."""
        if self.rng.random() < 0.4:
            self.broken_line(self.rng.uniform(0.5, 3), WIRE, self.rng.uniform(1.0, 1.6), (20, 80), (5, 30))
        if self.rng.random() < 0.5:
            self.broken_line(self.rng.uniform(4, 25), HEDGE, self.rng.uniform(1, 3), (10, 40), (20, 100))
        self.bushes(0.02, 2, min(40, self.depth / 2))
        if self.rng.random() < 0.6:
            self.broken_thicket(min(self.rng.uniform(20, 70), self.depth / 2))
        for _ in range(self.rng.poisson(self.length / 40)):
            self.tree(self.rng.uniform(0, self.length), self.rng.uniform(2, min(40, self.depth / 2)))

    # --- parts of a side -------------------------------------------------------------------------

    def house(self, start: float, end: float, front: float, depth: float) -> None:
        """Draw a house whose front is a row of walls, recesses and windows at the laser's height."""
        top = self.rng.uniform(4, 15)
        back = min(front + depth, self.depth / 2)
        self.line([(start, front), (start, back), (end, back), (end, front)], WALL, top)
        relief = self.rng.choice([0.1, 0.3, 0.7, 1.5])
        glazing = self.rng.choice([0.0, 0.03, 0.1])
        while start < end:
            piece_end = min(start + self.rng.uniform(1.0, 4.5), end)
            inset = front + (relief if self.rng.random() < 0.35 else 0.0)
            if inset > front:
                self.line([(start, front), (start, inset)], WALL, top)
                self.line([(piece_end, inset), (piece_end, front)], WALL, top)
            glazed = self.rng.random() < glazing
            self.line([(start, inset), (piece_end, inset)], GLASS if glazed else WALL, top)
            start = piece_end

    def front_garden(self, start: float, end: float, depth: float) -> None:
        """Draw a hedge, wall or fence between garden and street, with an opening, and a few bushes."""
        material, top = [
            (HEDGE, self.rng.uniform(1.2, 2.4)),
            (STONE, self.rng.uniform(0.5, 2.1)),
            (WIRE, self.rng.uniform(1.2, 2.0)),
        ][self.rng.choice(3, p=[0.5, 0.3, 0.2])]
        if self.rng.random() < 0.6:
            opening = end - self.rng.uniform(2.5, 4.5)
            self.line([(start, 0.3), (max(start, opening), 0.3)], material, top)
        for _ in range(self.rng.poisson(1.0)):
            top = self.rng.uniform(1.2, 3.0)
            self.leaves(self.rng.uniform(start, end), 0.5 + 0.7 * depth * self.rng.random(), 0.9, top)

    def broken_line(
        self,
        inward: float,
        material: Material,
        top: float,
        pieces: tuple[float, float],
        gaps: tuple[float, float],
    ) -> None:
        """Draw a hedge or fence with openings.

        Args:
            inward: metres inwards.
            material: its material.
            top: metres, its height.
            pieces: metres, range of the lengths of its pieces.
            gaps: metres, range of the lengths of its openings.
        """
        along = self.rng.uniform(0, gaps[1])
        while along < self.length:
            end = min(along + self.rng.uniform(*pieces), self.length)
            self.line([(along, inward), (end, inward + self.rng.normal(0, 0.3))], material, top)
            along = end + self.rng.uniform(*gaps)

    def broken_thicket(self, inward: float) -> None:
        """Draw overgrown land with openings."""
        along = self.rng.uniform(0, 10)
        while along < self.length:
            end = min(along + self.rng.uniform(10, 60), self.length)
            self.thicket(along, end, inward, self.rng.uniform(2, 7))
            along = end + self.rng.exponential(5)

    def backyards(self, nearest: float) -> None:
        """Draw what is seen through the gaps between houses: sheds, bushes and overgrown land."""
        farthest = self.depth / 2
        if nearest + 2 > farthest:
            return
        self.bushes(0.12, nearest, farthest)
        for _ in range(self.rng.poisson(self.length / 40)):
            along, inward = self.rng.uniform(0, self.length - 4), self.rng.uniform(nearest, farthest)
            self.box(
                (along, inward), (along + 3, min(inward + 3, farthest)), WALL, top=self.rng.uniform(2, 3)
            )
        self.broken_thicket(self.rng.uniform((nearest + farthest) / 2, farthest))

    def bushes(self, for_each_metre: float, nearest: float, farthest: float) -> None:
        """Draw bushes, on average ``for_each_metre`` per metre of street."""
        for _ in range(self.rng.poisson(self.length * for_each_metre)):
            radius, top = self.rng.uniform(0.5, 2.0), self.rng.uniform(1.0, 4.0)
            inward = self.rng.uniform(min(nearest + radius, farthest), farthest)
            self.leaves(self.rng.uniform(0, self.length), inward, radius, top)

    def parked_cars(self) -> None:
        """Draw cars along the kerb, except near the corners, where vehicles need the room to turn."""
        occupied = self.rng.choice([0.0, 0.1, 0.3, 0.7])
        along = 8 + self.rng.uniform(0, 3)
        while along < self.length - 14:
            length, height = car_size(self.rng)
            if self.rng.random() < occupied:
                self.car(along, -0.9 + self.rng.normal(0, 0.05), length, height)
            along += length + self.rng.uniform(0.5, 1.8)

    def car(self, along: float, kerb: float, length: float, height: float) -> None:
        """Draw a car as a body and a cabin; a van or a higher vehicle is a single box."""
        paint = DARK_PAINT if self.rng.random() < 0.2 else PAINT
        for (a, b, c, d), top in car_outline(length, height):
            self.box((along + a, kerb - 0.95 + b), (along + c, kerb - 0.95 + d), paint, top)

    def posts(self) -> None:
        """Draw a row of trees along some streets, and of lamp posts along the others; some traffic signs."""
        trees = self.rng.random() < 0.35
        spacing = self.rng.uniform(8, 16) if trees else self.rng.uniform(20, 40)
        along = self.rng.uniform(4, 20)
        while along < self.length - 4:
            if trees:
                self.tree(along, -0.1)
            else:
                self.post(along, -0.1, self.rng.uniform(0.05, 0.12), TRUNK, top=6.0)
            if self.rng.random() < 0.2:  # a traffic sign
                half = self.rng.uniform(0.2, 0.5)
                self.line([(along + 2, -half), (along + 2, half)], PAINT, top=2.9, bottom=1.6)
            along += spacing * self.rng.uniform(0.7, 1.3)


def rectangle(start: Corner, end: Corner) -> list[Corner]:
    """Corners of a rectangle with two given opposite corners; the first corner is repeated as the last.

    >>> rectangle((0, 0), (2, 1))
    [(0, 0), (2, 0), (2, 1), (0, 1), (0, 0)]
    """
    (a, b), (c, d) = start, end
    return [(a, b), (c, b), (c, d), (a, d), (a, b)]


def car_size(rng: np.random.Generator) -> tuple[float, float]:
    """Random length and height of a car in metres: mostly lower than the laser, sometimes a van or lorry."""
    kind = rng.random()
    if kind < 0.72:
        return rng.uniform(3.7, 4.8), rng.uniform(1.4, 1.55)
    if kind < 0.85:
        return rng.uniform(4.3, 4.9), rng.uniform(1.6, 1.85)
    if kind < 0.97:
        return rng.uniform(4.7, 6.0), rng.uniform(1.9, 2.7)
    return rng.uniform(7, 12), rng.uniform(2.8, 3.6)


def car_outline(length: float, height: float) -> list[tuple[tuple[float, float, float, float], float]]:
    """Boxes of a car, as ((rear, right, front, left), top), in metres from the middle of the rear bumper."""
    if height > 1.9:
        return [((0.0, -1.0, length, 1.0), height)]
    cabin = (0.08 * length, -0.75, 0.68 * length, 0.75)
    return [((0.0, -0.9, length, 0.9), 0.62 * height), (cabin, height)]


Filling = Callable[[Side], None]
"""Draws one kind of side."""
LINED_WITH: dict[Roads, dict[Filling, float]] = {
    RESIDENTIAL: {Side.suburb: 0.45, Side.town: 0.3, Side.estate: 0.15, Side.wood: 0.1},
    COUNTRY: {Side.wood: 0.45, Side.suburb: 0.3, Side.field: 0.15, Side.estate: 0.1},
    MAIN: {Side.wood: 0.35, Side.estate: 0.3, Side.field: 0.15, Side.town: 0.2},
}
"""Kinds of sides along each kind of roads, with their probabilities."""


def build_streets(
    plan: Plan, warp: Warp, ground: Ground, driven: FloatArray, rng: np.random.Generator
) -> Walls:
    """Generate all standing objects within `SIGHT` of a driven line.

    Args:
        plan: the plan of the streets.
        warp: deformation from the plan to the world.
        ground: the ground.
        driven: (M, 2) metres, line that is driven.
        rng: source of all random choices.

    Returns:
        The walls, in world coordinates.
    """
    fillings, shares = zip(*LINED_WITH[plan.roads].items(), strict=True)
    line = cKDTree(driven[::20])
    ends, surfaces = [], []
    for low, high in plan.blocks():
        rim = warp(np.stack([low, [high[0], low[1]], high, [low[0], high[1]], (low + high) / 2]))
        reach = SIGHT + np.hypot(*(rim[:4] - rim[4]).T).max()
        if line.query(rim[4])[0] > reach:
            continue
        for corner, along, inward in _sides(low, high):
            length, depth = float(np.hypot(*along)), float(np.hypot(*inward))
            side = Side(rng, length, depth)
            fillings[rng.choice(len(fillings), p=shares)](side)
            side.parked_cars()
            side.posts()
            rows = _cut_walls(np.concatenate(side.rows))
            ends.append(corner + rows[:, :4].reshape(-1, 2, 2) @ np.stack([along / length, inward / depth]))
            surfaces.append(rows[:, 4:])
    bent = warp(np.concatenate(ends)).reshape(-1, 4)
    bottom_top_returned_roughness = np.concatenate(surfaces)
    middle = (bent[:, :2] + bent[:, 2:]) / 2
    heights = bottom_top_returned_roughness[:, :2] + ground.at(middle)[:, None]
    walls = Walls(bent, heights, *bottom_top_returned_roughness[:, 2:].T.copy())
    size = np.abs(bent[:, 2:] - bent[:, :2]).max(1)
    return walls[(size > 1e-6) & (line.query(middle)[0] < SIGHT + size)]


def _cut_walls(rows: FloatArray) -> FloatArray:
    """Cut rows (W, 8) of walls into pieces of at most `PIECE`, so that they follow bends and slopes."""
    extent = rows[:, 2:4] - rows[:, :2]
    count = np.maximum(1, np.ceil(np.hypot(*extent.T) / PIECE)).astype(np.int64)
    whole = np.repeat(np.arange(len(rows)), count)
    number = np.arange(len(whole)) - np.repeat(np.cumsum(count) - count, count)
    pieces = rows[whole]
    for column, end in ((0, number), (2, number + 1)):
        pieces[:, column : column + 2] = rows[whole, :2] + (end / count[whole])[:, None] * extent[whole]
    return pieces


def _sides(low: FloatArray, high: FloatArray) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """For each side of a block, counter-clockwise: first corner, extent and vector inwards, each (2,)."""
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]], low])
    extents = np.diff(corners, axis=0)
    return [(corners[i], extents[i], extents[(i + 1) % 4]) for i in range(4)]
