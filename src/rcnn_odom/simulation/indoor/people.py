"""People in a building, who walk back and forth and keep away from the robot."""

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.drawing import upright_walls
from rcnn_odom.simulation.indoor.building import Building
from rcnn_odom.simulation.indoor.floor import Floor
from rcnn_odom.simulation.scene import NO_WALLS, Material, Scene
from rcnn_odom.simulation.street.polyline import unit

CLOTH = Material(0.99, 0.01)

ROOM_TO_WALK = 0.3
"""Metres; least distance from a person's path to the nearest wall."""
PERSONAL_SPACE = 0.95
"""Metres; least distance from the laser to the middle of a person."""
SEEN_PEOPLE = 40.0
"""Metres from the laser; people farther away are left out of a frame."""
USUAL_RATE = 4.0
"""Scans per second for which the random speeds of people are drawn."""


def populate(
    building: Building,
    planar: FloatArray,
    rng: np.random.Generator,
    people: bool = True,
    scan_rate_hz: float | None = None,
) -> Scene:
    """Make the scene of a drive: the building and the people in it.

    Args:
        building: the building.
        planar: (N, 3) x, y and heading of the laser in each frame, as from ``random_walk``.
        rng: source of all random choices.
        people: whether there are people.
        scan_rate_hz: scans per second; None: a random rate of the robot, taken as ``USUAL_RATE``.
    """
    frames = len(planar)
    count = rng.poisson(2 + np.hypot(*np.diff(planar[:, :2], axis=0).T).sum() / 6) if people else 0
    ways = _ways_of_people(building.floor, planar[rng.integers(frames, size=count), :2], rng)
    if not len(ways):
        return Scene(building.standing, NO_WALLS, np.zeros(frames + 1, dtype=np.int64))
    time_scale = 1.0 if scan_rate_hz is None else USUAL_RATE / scan_rate_hz
    middles, walked = _walk_to_and_fro(ways, frames, time_scale, rng)
    middles, is_visible = _keep_away(middles, planar[:, None, :2], building.floor)
    legs = _legs(middles, np.arctan2(*(ways[:, 1] - ways[:, 0]).T[::-1]), walked)
    starts = np.concatenate([[0], np.cumsum(is_visible.sum(axis=1) * legs.shape[2])])
    return Scene(building.standing, upright_walls(legs[is_visible].reshape(-1, 4), CLOTH), starts)


def _ways_of_people(floor: Floor, near: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Ends (P, 2, 2) of free straight paths that begin near given positions (Q, 2), P <= Q."""
    begin = near + rng.normal(0, 2, near.shape)
    direction = rng.uniform(0, 2 * np.pi, len(near))
    end = begin + rng.uniform(0.5, 9, (len(near), 1)) * unit(direction)
    along = np.linspace(0, 1, 60)[:, None]
    # A free line from the position to the start ensures that the person is in the same room or corridor.
    lines = [a[:, None] + along * (b - a)[:, None] for a, b in ((near, begin), (begin, end))]
    free = [floor.room_at(line).min(axis=1, initial=np.inf) >= ROOM_TO_WALK for line in lines]
    return np.stack([begin, end], axis=1)[free[0] & free[1]]


def _walk_to_and_fro(
    ways: FloatArray, frames: int, time_scale: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Positions (N, P, 2) of all people in each frame, and the distances (N, P) that they have walked.

    Args:
        ways: (P, 2, 2) metres, ends of the paths.
        frames: number of frames N.
        time_scale: factor of the distance walked from frame to frame.
        rng: source of all random choices.
    """
    length = np.hypot(*(ways[:, 1] - ways[:, 0]).T)
    pace = np.exp(rng.uniform(np.log(0.03), np.log(0.3), len(ways))) * (rng.random(len(ways)) < 0.8)
    walked = rng.uniform(0, 2 * length) + time_scale * pace * np.arange(frames)[:, None]
    share = np.abs((walked / length + 1) % 2 - 1)
    return ways[:, 0] + share[:, :, None] * (ways[:, 1] - ways[:, 0]), walked


def _keep_away(
    middles: FloatArray, laser: FloatArray, floor: Floor
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Move people who are too near away from the laser; those without room for that are left out.

    Args:
        middles: (N, P, 2) metres, positions of the people.
        laser: (N, 1, 2) metres, positions of the laser.
        floor: map of the floor.

    Returns:
        Positions (N, P, 2), and whether each person is part of the frame, (N, P).
    """
    away = middles - laser
    apart = np.maximum(np.hypot(away[..., 0], away[..., 1]), 1e-6)[..., None]
    is_near = apart[..., 0] < PERSONAL_SPACE
    middles = np.where(is_near[..., None], laser + away / apart * PERSONAL_SPACE, middles)
    has_room = floor.room_at(middles) >= 0.1
    return middles, (~is_near | has_room) & (apart[..., 0] < SEEN_PEOPLE)


def _legs(middles: FloatArray, direction: FloatArray, walked: FloatArray) -> FloatArray:
    """Two legs of each person as hexagons that swing with the distance walked: lines (N, P, 12, 4).

    Args:
        middles: (N, P, 2) metres, positions of the people.
        direction: (P,) radians, directions of their paths.
        walked: (N, P) metres.
    """
    corner = np.arange(7) * np.pi / 3
    hexagon = 0.09 * unit(corner)
    ahead, left = unit(direction), unit(direction + np.pi / 2)
    swing = 0.22 * np.sin(walked / 1.4 * 2 * np.pi)[..., None]
    lines = []
    for side in (-1, 1):
        corners = (middles + side * (0.12 * left + swing * ahead))[:, :, None] + hexagon
        lines.append(np.concatenate([corners[:, :, :-1], corners[:, :, 1:]], axis=-1))
    return np.concatenate(lines, axis=2)
