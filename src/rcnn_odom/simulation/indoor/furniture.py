"""Places furniture in the rooms of a building."""

import numpy as np

from rcnn_odom.simulation.drawing import Drawing, Room


def furnish_room(drawing: Drawing, room: Room, hall: bool, rng: np.random.Generator) -> None:
    """Place random furniture in a room; larger rooms get more, halls get pillars and less furniture."""
    area = room.size[0] * room.size[1]
    if hall:
        half = rng.uniform(0.15, 0.35)
        for x in np.arange(room.low[0] + 3, room.high[0] - 2, rng.uniform(4, 7)):
            drawing.boxes.append((x, room.low[1] + room.size[1] * 0.35, half, half, 0.0))
            drawing.boxes.append((x, room.low[1] + room.size[1] * 0.7, half, half, 0.0))
        area *= 0.4
    crowded = rng.uniform(0.5, 1.3)
    for _ in range(rng.poisson(crowded * (1 + area / 12))):
        drawing.boxes.append(_place_at_wall(room, rng.uniform(0.3, 1.0), rng.uniform(0.15, 0.3), rng))
    for _ in range(rng.poisson(crowded * area / 60)):
        drawing.boxes.append(_place_at_wall(room, rng.uniform(0.7, 1.1), 0.42, rng))
    for _ in range(rng.poisson(crowded * (0.5 + area / 14))):
        _place_table(drawing, room, rng)
    for _ in range(rng.poisson(crowded * (0.5 + area / 20))):
        x, y = _random_position(room, 0.4, rng)
        drawing.boxes.append((x, y, rng.uniform(0.1, 0.3), rng.uniform(0.1, 0.3), rng.uniform(0, np.pi)))


def _place_at_wall(
    room: Room, half_length: float, half_depth: float, rng: np.random.Generator
) -> tuple[float, float, float, float, float]:
    """A box at one of the four walls: x, y, half length, half depth and direction."""
    along = int(rng.integers(2))
    half_length = min(half_length, room.size[along] / 2 - 0.1)
    place = [0.0, 0.0]
    place[along] = rng.uniform(room.low[along] + half_length, room.high[along] - half_length)
    gap = half_depth + rng.uniform(0, 0.05)
    place[1 - along] = room.low[1 - along] + gap if rng.random() < 0.5 else room.high[1 - along] - gap
    return place[0], place[1], half_length, half_depth, along * np.pi / 2


def _random_position(room: Room, gap: float, rng: np.random.Generator) -> tuple[float, float]:
    """x and y of a position in a room, at least ``gap`` metres from its walls."""
    return rng.uniform(room.low[0] + gap, room.high[0] - gap), rng.uniform(
        room.low[1] + gap, room.high[1] - gap
    )


def _place_table(drawing: Drawing, room: Room, rng: np.random.Generator) -> None:
    """Place a table with four legs or two side panels, at a wall or not, and up to two chairs."""
    half_length, half_depth = rng.uniform(0.5, 0.9), rng.uniform(0.3, 0.42)
    if rng.random() < 0.6:
        x, y, _, _, direction = _place_at_wall(room, half_length, half_depth, rng)
    else:
        x, y = _random_position(room, 1.0, rng)
        direction = rng.choice([0, np.pi / 2]) + rng.normal(0, 0.1)
    if rng.random() < 0.5:
        drawing.legs += _legs_at_corners(x, y, half_length, half_depth, direction, 0.025)
    else:
        for side in (-half_length, half_length):
            x_side, y_side = x + side * np.cos(direction), y + side * np.sin(direction)
            drawing.boxes.append((x_side, y_side, 0.015, half_depth, direction))
    for _ in range(rng.integers(3)):
        turn = rng.uniform(0, 2 * np.pi)
        x_chair, y_chair = x + 0.7 * np.cos(turn), y + 0.7 * np.sin(turn)
        if (
            room.low[0] + 0.3 < x_chair < room.high[0] - 0.3
            and room.low[1] + 0.3 < y_chair < room.high[1] - 0.3
        ):
            drawing.legs += _legs_at_corners(x_chair, y_chair, 0.2, 0.2, turn, 0.015)


def _legs_at_corners(
    x: float, y: float, half_length: float, half_width: float, direction: float, half_leg: float
) -> list[tuple[float, float, float, float, float]]:
    """The legs at the four corners of a table or chair, in the form of ``Drawing.legs``."""
    cos, sin = np.cos(direction), np.sin(direction)
    return [
        (x + u * cos - v * sin, y + u * sin + v * cos, half_leg, half_leg, direction)
        for u in (-half_length, half_length)
        for v in (-half_width, half_width)
    ]
