"""Moving objects in the streets: cars in both directions, a car ahead or behind, people on the pavements."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.scene import Walls
from rcnn_odom.simulation.street.city import LANE_OFFSET, Plan, Warp
from rcnn_odom.simulation.street.drive import Drive
from rcnn_odom.simulation.street.line import PATH_STEP
from rcnn_odom.simulation.street.polyline import resample
from rcnn_odom.simulation.street.speed import FRAME_TIME
from rcnn_odom.simulation.street.street import BELOW_GROUND, PAINT, car_outline, car_size, rectangle
from rcnn_odom.simulation.terrain import Ground

SEEN = 85.0
"""Metres from the laser within which moving objects are kept, slightly more than the laser's range."""
WARP_SLACK = 50.0
"""Metres, bound on the displacement of a point by the warp."""
CARS, WALKERS = 40, 20
"""Number of different shapes of cars and of people in a city."""
CAR_SPACING = (60.0, 400.0)
"""Metres, range of the mean distance between cars of one direction on a street."""
WALKER_SPACING = (40.0, 300.0)
"""Metres, the same for people."""
CAR_SPEED, WALKER_SPEED = (4.0, 14.0), (0.8, 1.8)
"""Metres per second."""
KEPT_CLEAR = 6.0
"""Metres around the laser without other objects, so that nothing drives through its car."""


@dataclass
class _Movers:
    """Moving objects, K in all frames together.

    Attributes:
        frame: (K,) frame in which an object is seen.
        pose: (K, 3) its x and y in metres and heading in radians.
        shape: (K,) index of its shape.
    """

    frame: npt.NDArray[np.int64]
    pose: FloatArray
    shape: npt.NDArray[np.int64]


def build_traffic(
    plan: Plan, warp: Warp, ground: Ground, drive: Drive, rng: np.random.Generator
) -> tuple[Walls, npt.NDArray[np.int64]]:
    """Generate the moving objects of a drive.

    Args:
        plan: the plan of the streets.
        warp: deformation from the plan to the world.
        ground: the ground.
        drive: the drive of the laser's car, N frames.
        rng: source of all random choices.

    Returns:
        The walls of the objects in all frames, frame by frame; and (N + 1,) the index of the first wall of
        each frame, and the number of all walls.
    """
    shapes = [_car(rng) for _ in range(CARS)] + [_walker(rng) for _ in range(WALKERS)]
    cars, walkers = np.arange(CARS), np.arange(CARS, CARS + WALKERS)
    movers = [
        *_street_users(plan, warp, drive, rng, CAR_SPACING, CAR_SPEED, cars, on_road=True),
        *_street_users(plan, warp, drive, rng, WALKER_SPACING, WALKER_SPEED, walkers, on_road=False),
        *_cars_in_same_lane(drive, rng, cars),
        _Movers(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros(0, dtype=np.int64)),
    ]
    frame = np.concatenate([m.frame for m in movers])
    pose = np.concatenate([m.pose for m in movers])
    shape = np.concatenate([m.shape for m in movers])
    distance = np.hypot(*(pose[:, :2] - drive.planar[frame, :2]).T)
    reach = np.array([np.hypot(*rows[:, :2].T).max() for rows in shapes])
    kept = np.flatnonzero((distance > KEPT_CLEAR + reach[shape]) & (distance < SEEN))
    kept = kept[np.argsort(frame[kept], kind="stable")]
    frame, pose, shape = frame[kept], pose[kept], shape[kept]
    counts = np.array([len(rows) for rows in shapes])[shape]
    owner = np.repeat(np.arange(len(frame)), counts)
    first = np.cumsum([0] + [len(rows) for rows in shapes])[shape]
    row = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts) + np.repeat(first, counts)
    rows = np.concatenate(shapes)[row]
    cos, sin = np.cos(pose[owner, 2]), np.sin(pose[owner, 2])
    turn = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], -2)
    ends = (rows[:, :4].reshape(-1, 2, 2) @ turn + pose[owner, None, :2]).reshape(-1, 4)
    heights = rows[:, 4:6] + ground.at(pose[owner, :2])[:, None]
    walls = Walls(ends, heights, np.full(len(rows), PAINT.returned), np.full(len(rows), PAINT.roughness))
    return walls, np.searchsorted(frame[owner], np.arange(len(drive.planar) + 1))


def _street_users(
    plan: Plan,
    warp: Warp,
    drive: Drive,
    rng: np.random.Generator,
    spacing: tuple[float, float],
    speed: tuple[float, float],
    shapes: npt.NDArray[np.int64],
    on_road: bool,
) -> Iterator[_Movers]:
    """Cars or people on all streets in both directions, at constant speeds from end to end, again and again.

    They ignore crossings and each other, which cannot be seen in the scans.
    """
    frames = len(drive.planar)
    extent = plan.centres[:, -1]
    for axis in range(2):  # streets along y, then along x
        for centre, half_width in zip(plan.centres[axis, 1:-1], plan.half_widths[axis, 1:-1], strict=True):
            length = extent[1 - axis]
            for direction in (1, -1):
                count = max(1, int(length / np.exp(rng.uniform(*np.log(spacing)))))
                aside = LANE_OFFSET if on_road else half_width - rng.uniform(0.25, 0.6, (1, count))
                start = rng.uniform(0, length, count)
                pace = rng.uniform(*speed, count)
                along = (start + FRAME_TIME * np.arange(frames)[:, None] * pace) % length
                along = along if direction > 0 else length - along
                # They are on the right side: at +x if they move along +y, at -y if they move along +x.
                side = direction * (1 if axis == 0 else -1)
                points = np.empty((frames, count, 2))
                points[..., axis], points[..., 1 - axis] = centre + side * aside, along
                yield _warp_movers(points, axis, direction, rng.choice(shapes, count), warp, drive)


def _warp_movers(
    points: FloatArray, axis: int, direction: int, shape: npt.NDArray[np.int64], warp: Warp, drive: Drive
) -> _Movers:
    """Select the objects of a straight street that may be in sight, and bend their positions into the city.

    Args:
        points: (N, count, 2) metres, positions on the plan.
        axis: 0 for a street along y, 1 for a street along x.
        direction: 1 or -1, direction of motion along the street.
        shape: (count,) indices of the shapes.
        warp: deformation from the plan to the world.
        drive: the drive of the laser's car.
    """
    # The warp moves points by a few metres only, so they can be selected on the plan.
    frame, one = np.nonzero(np.abs(points - drive.planar[:, None, :2]).max(2) < SEEN + WARP_SLACK)
    ahead = np.zeros(2)
    ahead[1 - axis] = direction
    here, there = warp(points[frame, one]), warp(points[frame, one] + ahead)
    return _Movers(frame, np.column_stack([here, np.arctan2(*(there - here).T[::-1])]), shape[one])


def _cars_in_same_lane(
    drive: Drive, rng: np.random.Generator, shapes: npt.NDArray[np.int64]
) -> Iterator[_Movers]:
    """Cars ahead and behind in the same lane, each for some time and at a nearly constant distance."""
    frames = len(drive.planar)
    time = np.arange(frames)
    for side in (1, -1):
        start = rng.integers(-200, 200)
        while start < frames:
            stop = start + int(rng.uniform(50, 500))
            during = time[max(start, 0) : max(stop, 0)]
            gap = rng.uniform(20, 60) + rng.uniform(2, 8) * np.sin(during / rng.uniform(20, 80))
            position = (drive.along[during] + side * gap) / PATH_STEP
            on_path = (position > 0) & (position < len(drive.path) - 2)
            numbers = np.arange(len(drive.path), dtype=np.float64)
            middle = resample(drive.path, numbers, position[on_path])
            step = np.diff(drive.path, axis=0)[position[on_path].astype(int)]
            pose = np.column_stack([middle, np.arctan2(step[:, 1], step[:, 0])])
            yield _Movers(during[on_path], pose, np.full(len(pose), rng.choice(shapes)))
            start = stop + int(rng.exponential(200))


def _car(rng: np.random.Generator) -> FloatArray:
    """Rows (W, 6) of a random car's walls about its middle: both ends, bottom and top in metres."""
    length, height = car_size(rng)
    return np.concatenate(
        [_box(a - length / 2, b, c - length / 2, d, top) for (a, b, c, d), top in car_outline(length, height)]
    )


def _walker(rng: np.random.Generator) -> FloatArray:
    """Rows (4, 6) of the walls of a random person on foot or on a bicycle."""
    half = rng.choice([0.2, 0.2, 0.35])
    return _box(-half, -0.22, half, 0.22, rng.uniform(1.55, 1.95))


def _box(a: float, b: float, c: float, d: float, top: float) -> FloatArray:
    """Rows (4, 6) of the walls of a box with opposite corners (a, b) and (c, d)."""
    corners = np.array(rectangle((a, b), (c, d)))
    rest = np.tile([BELOW_GROUND, top], (4, 1))
    return np.concatenate([corners[:-1], corners[1:], rest], axis=1)
