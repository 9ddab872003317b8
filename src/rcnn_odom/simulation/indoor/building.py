"""Generates a building: corridors, rooms and furniture.

Blocks of rooms lie between corridors that cross at right angles; some blocks are halls. Walls lie on whole
decimetres, so the floor map, whose cells are a decimetre wide, represents them exactly.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.drawing import GLASS, PLASTER, WOOD, Door, Drawing, Leaf, Room, as_walls
from rcnn_odom.simulation.indoor.floor import CELL, Floor, map_floor
from rcnn_odom.simulation.indoor.furniture import furnish_room
from rcnn_odom.simulation.scene import Walls

WALL_THICKNESS = 0.2
"""Metres."""


@dataclass(frozen=True)
class Building:
    """A building.

    Attributes:
        standing: walls, doors and furniture.
        floor: map of the free space.
    """

    standing: Walls
    floor: Floor


def plan_building(rng: np.random.Generator) -> Building:
    """A random floor of 3 to 6 by 2 to 3 blocks with furniture, some closed doors and some glass walls."""
    drawing = Drawing({PLASTER: [], WOOD: [], GLASS: []}, [], [], [])
    columns = _blocks_and_corridors(rng.uniform(8, 20, rng.integers(3, 7)), rng)
    depths = rng.uniform(4, 7, rng.integers(2, 4))
    depths[1:-1] += rng.uniform(1, 6)
    rows = _blocks_and_corridors(depths, rng)
    for i, (left, right) in enumerate(columns):
        for j, (bottom, top) in enumerate(rows):
            rim = (i == 0, i == len(columns) - 1, j == 0, j == len(rows) - 1)
            _draw_block(drawing, _shrink_block((left, right, bottom, top), rim, rng), rim, rng)
    _draw_corridors(drawing, columns, rows, rng)
    walls = as_walls(drawing)
    return Building(walls, map_floor(walls, (columns[-1][1], rows[-1][1])))


def _blocks_and_corridors(sizes: FloatArray, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Start and end in metres of each block, with corridors of 1.5 to 2.5 metres between them."""
    widths = rng.triangular(1.5, 1.8, 2.5, len(sizes))
    starts = 1 + np.concatenate([[0], np.cumsum(sizes + widths)[:-1]])
    return [
        (_decimetres(start), _decimetres(start + size)) for start, size in zip(starts, sizes, strict=True)
    ]


def _decimetres(metres: float) -> float:
    return round(float(metres), 1)


def _shrink_block(
    sides: tuple[float, ...], rim: tuple[bool, ...], rng: np.random.Generator
) -> tuple[float, float, float, float]:
    """Move some sides of a block away from their corridors, so that corridors have no constant width.

    Args:
        sides: left, right, bottom and top in metres.
        rim: whether each side is at the rim of the building, without a corridor.
        rng: source of all random choices.

    Returns:
        Left, right, bottom and top in metres.
    """
    back = rng.choice([0, 0, 0, 0.1, 0.2, 0.5], 4) * ~np.array(rim) * (1, -1, 1, -1)
    left, right, bottom, top = (_decimetres(side + by) for side, by in zip(sides, back, strict=True))
    return left, right, bottom, top


def _draw_block(
    drawing: Drawing,
    sides: tuple[float, float, float, float],
    rim: tuple[bool, ...],
    rng: np.random.Generator,
) -> None:
    """Draw a hall, or rooms in one row or in two rows back to back, each with a door to its corridor."""
    left, right, bottom, top = sides
    hall = rng.random() < 0.08
    rooms: list[Room] = []
    doors: list[Door] = []
    for low, high, to_corridor in _rows_of_rooms(bottom, top, rim[2], rim[3], hall, rng):
        row = [Room((x0, low), (x1, high)) for x0, x1 in _widths_of_rooms(left, right, hall, rng)]
        rooms += row
        doors += _doors_of_row(row, (bottom, top), to_corridor, hall, rng)
        doors += _doors_at_ends(row, (left, right), rim[:2], hall, rng)
    glass_front = not hall and rng.random() < 0.1
    outside = Room((left, bottom), (right, top))
    drawing.lines[GLASS if glass_front else PLASTER] += _outline(outside, doors)
    for room in rooms:
        drawing.lines[PLASTER] += _outline(room, doors)
        if (rim[2] or rim[3]) and rng.random() < 0.35:
            drawing.lines[GLASS] += _windows(room, room.low[1] if rim[2] else room.high[1], rng)
        furnish_room(drawing, room, hall, rng)
    for door in doors:
        _draw_door(drawing, door, rng)
    drawing.doors += doors


def _rows_of_rooms(
    bottom: float,
    top: float,
    no_corridor_below: bool,
    no_corridor_above: bool,
    hall: bool,
    rng: np.random.Generator,
) -> list[tuple[float, float, bool]]:
    """For each row of rooms in a block: lower and upper wall, and whether the doors are in the upper wall."""
    low, high = _decimetres(bottom + WALL_THICKNESS), _decimetres(top - WALL_THICKNESS)
    if hall or no_corridor_below or no_corridor_above or high - low < 7:
        upper = no_corridor_below or (not no_corridor_above and rng.random() < 0.5)
        return [(low, high, upper)]
    middle = _decimetres((low + high) / 2 + rng.uniform(-0.5, 0.5))
    return [(low, middle, False), (_decimetres(middle + WALL_THICKNESS), high, True)]


def _widths_of_rooms(
    left: float, right: float, hall: bool, rng: np.random.Generator
) -> list[tuple[float, float]]:
    """Start and end in metres of each room of a row: offices are 2.8 to 4.2 metres wide, others 4.5 to 8."""
    low, end = _decimetres(left + WALL_THICKNESS), _decimetres(right - WALL_THICKNESS)
    rooms = []
    while not hall:
        width = rng.uniform(2.8, 4.2) if rng.random() < 0.6 else rng.uniform(4.5, 8)
        if low + width > end - 2.8:
            break
        rooms.append((low, _decimetres(low + width)))
        low = _decimetres(low + width + WALL_THICKNESS)
    return [*rooms, (low, end)]


def _doors_of_row(
    row: Sequence[Room], block: tuple[float, float], upper: bool, hall: bool, rng: np.random.Generator
) -> list[Door]:
    """A door from each room to the corridor, and some doors from room to room."""
    doors = []
    for room in row:
        faces = (block[1], room.high[1]) if upper else (block[0], room.low[1])
        doors.append(_random_door(1, faces, (room.low[0], room.high[0]), hall, rng))
    for one, other in pairwise(row):
        if rng.random() < 0.2:
            doors.append(_random_door(0, (one.high[0], other.low[0]), (one.low[1], one.high[1]), hall, rng))
    return doors


def _doors_at_ends(
    row: Sequence[Room],
    block: tuple[float, float],
    rim: tuple[bool, ...],
    hall: bool,
    rng: np.random.Generator,
) -> list[Door]:
    """Some doors from the first and the last room of a row to the crossing corridors."""
    ends = [(block[0], row[0].low[0], row[0], rim[0]), (block[1], row[-1].high[0], row[-1], rim[1])]
    return [
        _random_door(0, (outer, inner), (room.low[1], room.high[1]), hall, rng)
        for outer, inner, room, at_rim in ends
        if not at_rim and rng.random() < 0.3
    ]


def _random_door(
    axis: int, faces: tuple[float, float], wall: tuple[float, float], hall: bool, rng: np.random.Generator
) -> Door:
    if hall:
        width = 2 * _decimetres(rng.uniform(0.8, min(2.5, (wall[1] - wall[0]) / 2 - 0.5)))
    else:
        width = float(rng.choice([1.0, 1.0, 1.2, 1.6]))
    # The middle lies on the grid of the routes, because otherwise no route would fit through narrow doors.
    middle = 2 * CELL * round(rng.uniform(wall[0] + width / 2 + 0.2, wall[1] - width / 2 - 0.2) / (2 * CELL))
    leaves: tuple[Leaf, ...] = ("open", "closed", "none")
    leaf = "none" if hall else leaves[rng.choice(3, p=[0.55, 0.3, 0.15])]
    return Door(axis, faces, _decimetres(middle), width, wall, leaf)


def _outline(room: Room, doors: Sequence[Door]) -> list[tuple[float, ...]]:
    """The four walls of a room as lines, with gaps for its doors."""
    lines = []
    for axis in (0, 1):
        begin, end = room.low[1 - axis], room.high[1 - axis]
        for face in (room.low[axis], room.high[axis]):
            mine = [d for d in doors if d.axis == axis and face in d.faces and begin < d.middle < end]
            edges = sorted(d.middle + side * d.width / 2 for d in mine for side in (-1, 1))
            corners = [begin, *edges, end]
            lines += [_line(axis, face, *piece) for piece in zip(corners[::2], corners[1::2], strict=True)]
    return lines


def _line(axis: int, face: float, begin: float, end: float) -> tuple[float, ...]:
    """A line (x, y, x, y) perpendicular to ``axis``, at the coordinate ``face`` on it."""
    return (face, begin, face, end) if axis == 0 else (begin, face, end, face)


def _windows(room: Room, face: float, rng: np.random.Generator) -> list[tuple[float, ...]]:
    """Panes of glass one cell (a decimetre) inside the outer wall."""
    inside = face + np.sign((room.low[1] + room.high[1]) / 2 - face) * CELL
    middles = np.arange(room.low[0] + 1, room.high[0] - 0.6, 1.8)
    half = rng.uniform(0.4, 0.8)
    return [(x - half, inside, min(x + half, room.high[0]), inside) for x in middles]


def _draw_door(drawing: Drawing, door: Door, rng: np.random.Generator) -> None:
    low, high = door.middle - door.width / 2, door.middle + door.width / 2
    outer, inner = door.faces
    drawing.lines[PLASTER] += [_line(1 - door.axis, edge, outer, inner) for edge in (low, high)]
    material = GLASS if rng.random() < 0.08 else WOOD
    if door.leaf == "closed":
        drawing.lines[material].append(
            _line(door.axis, rng.uniform(min(door.faces), max(door.faces)), low, high)
        )
    elif door.leaf == "open":
        # The door is open by at least a right angle, so that it blocks no route, and at most up to a wall.
        side = int(rng.integers(2))
        hinge = (low, high)[side]
        aside = min(door.width * np.sin(rng.uniform(0, 1.2)), abs(door.wall[side] - hinge))
        tip = hinge + (-1, 1)[side] * aside
        depth = inner + np.sign(inner - outer) * np.sqrt(door.width**2 - aside**2)
        line = (inner, hinge, depth, tip) if door.axis == 0 else (hinge, inner, tip, depth)
        drawing.lines[material].append(line)


def _draw_corridors(
    drawing: Drawing,
    columns: Sequence[tuple[float, float]],
    rows: Sequence[tuple[float, float]],
    rng: np.random.Generator,
) -> None:
    """Draw the ends of the corridors, some of them windows, and the objects along their sides."""
    spans = (columns[0][0], columns[-1][1]), (rows[0][0], rows[-1][1])
    for along, blocks in ((1, columns), (0, rows)):
        for (_, low), (high, _) in pairwise(blocks):
            for end in spans[along]:
                material = GLASS if rng.random() < 0.3 else PLASTER
                # The end is wider than the corridor, because _shrink_block may have widened the corridor.
                drawing.lines[material].append(_line(along, end, low - 1, high + 1))
            for place in np.arange(spans[along][0] + 1, spans[along][1] - 3, 2.5):
                _draw_at_side(drawing, along, place + rng.uniform(0, 2), low, high, rng)


def _draw_at_side(
    drawing: Drawing, along: int, place: float, low: float, high: float, rng: np.random.Generator
) -> None:
    """Draw nothing, a pillar, a cupboard, a bin or a radiator at one side of a corridor."""
    half_length, half_depth = [(0, 0), (0.2, 0.12), (0.6, 0.2), (0.15, 0.15), (0.5, 0.06)][rng.integers(5)]
    if not half_length or min(high - low, 2.2) - 2 * half_depth < 1.4:
        return
    side = low + half_depth if rng.random() < 0.5 else high - half_depth
    x, y = (place, side) if along == 0 else (side, place)
    scale = rng.uniform(0.7, 1.3)
    drawing.boxes.append((x, y, half_length * scale, half_depth, along * np.pi / 2))
