"""People in a building, who walk to and fro and keep out of the robot's way."""

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.drawing import upright
from rcnn_odom.simulation.indoor.building import Building
from rcnn_odom.simulation.indoor.floor import Floor
from rcnn_odom.simulation.scene import NO_WALLS, Material, Scene
from rcnn_odom.simulation.street.polyline import unit

CLOTH = Material(0.99, 0.01)

ROOM_TO_WALK = 0.3
PERSONAL_SPACE = 0.95
"""Metres from the laser that the middle of a person keeps."""
SEEN_PEOPLE = 40.0
"""Metres within which people are part of a frame."""
USUAL_RATE = 4.0
"""Frames a second for which the paces of people are drawn."""


def populate(
    building: Building,
    planar: FloatArray,
    rng: np.random.Generator,
    people: bool = True,
    scan_rate_hz: float | None = None,
) -> Scene:
    """All that the laser meets on its way.

    Args:
        building: what stands.
        planar: (N, 3) the laser in every frame, as of ``random_walk``.
        rng: where all chance comes from.
        people: whether anyone is about.
        scan_rate_hz: frames a second; None: as the robot's of its own choice, ``USUAL_RATE`` or so.
    """
    frames = len(planar)
    count = rng.poisson(2 + np.hypot(*np.diff(planar[:, :2], axis=0).T).sum() / 6) if people else 0
    ways = _ways_of_people(building.floor, planar[rng.integers(frames, size=count), :2], rng)
    if not len(ways):
        return Scene(building.standing, NO_WALLS, np.zeros(frames + 1, dtype=np.int64))
    hurry = 1.0 if scan_rate_hz is None else USUAL_RATE / scan_rate_hz
    middles, walked = _walk_to_and_fro(ways, frames, hurry, rng)
    middles, there = _make_way(middles, planar[:, None, :2], building.floor)
    legs = _legs(middles, np.arctan2(*(ways[:, 1] - ways[:, 0]).T[::-1]), walked)
    starts = np.concatenate([[0], np.cumsum(there.sum(axis=1) * legs.shape[2])])
    return Scene(building.standing, upright(legs[there].reshape(-1, 4), CLOTH), starts)


def _ways_of_people(floor: Floor, near: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Both ends (P, 2, 2) of straight ways that begin near the given places, and are free."""
    begin = near + rng.normal(0, 2, near.shape)
    direction = rng.uniform(0, 2 * np.pi, len(near))
    end = begin + rng.uniform(0.5, 9, (len(near), 1)) * unit(direction)
    along = np.linspace(0, 1, 60)[:, None]
    # Whom the place sees is in the same room or corridor.
    lines = [a[:, None] + along * (b - a)[:, None] for a, b in ((near, begin), (begin, end))]
    free = [floor.room_at(line).min(axis=1, initial=np.inf) >= ROOM_TO_WALK for line in lines]
    return np.stack([begin, end], axis=1)[free[0] & free[1]]


def _walk_to_and_fro(
    ways: FloatArray, frames: int, hurry: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Where everybody is in every frame (N, P, 2), and how far they have walked (N, P) metres."""
    length = np.hypot(*(ways[:, 1] - ways[:, 0]).T)
    pace = np.exp(rng.uniform(np.log(0.03), np.log(0.3), len(ways))) * (rng.random(len(ways)) < 0.8)
    walked = rng.uniform(0, 2 * length) + hurry * pace * np.arange(frames)[:, None]
    share = np.abs((walked / length + 1) % 2 - 1)
    return ways[:, 0] + share[:, :, None] * (ways[:, 1] - ways[:, 0]), walked


def _make_way(
    middles: FloatArray, laser: FloatArray, floor: Floor
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Who is too near steps back from the laser, and leaves where no room is for that."""
    away = middles - laser
    apart = np.maximum(np.hypot(away[..., 0], away[..., 1]), 1e-6)[..., None]
    asked = apart[..., 0] < PERSONAL_SPACE
    middles = np.where(asked[..., None], laser + away / apart * PERSONAL_SPACE, middles)
    room = floor.room_at(middles) >= 0.1
    return middles, (~asked | room) & (apart[..., 0] < SEEN_PEOPLE)


def _legs(middles: FloatArray, direction: FloatArray, walked: FloatArray) -> FloatArray:
    """Two hexagons each, that swing with what is walked: lines (N, P, 12, 4)."""
    corner = np.arange(7) * np.pi / 3
    hexagon = 0.09 * unit(corner)
    ahead, left = unit(direction), unit(direction + np.pi / 2)
    swing = 0.22 * np.sin(walked / 1.4 * 2 * np.pi)[..., None]
    lines = []
    for side in (-1, 1):
        corners = (middles + side * (0.12 * left + swing * ahead))[:, :, None] + hexagon
        lines.append(np.concatenate([corners[:, :, :-1], corners[:, :, 1:]], axis=-1))
    return np.concatenate(lines, axis=2)
