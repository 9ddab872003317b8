"""Simulates a car's drive along a route: the line of its wheels, its speed, and its sway.

The constants and ranges here and in ``line.py``, ``speed.py`` and ``sway.py`` are fitted to the motion of
KITTI's sequences 00 02 03 04 06 08 09, never to 05, 07 or 10;
``python -m rcnn_odom.comparison.motion`` compares simulated and real motion.
"""

from dataclasses import dataclass, replace

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.street.city import Plan, Roads, Warp, random_route
from rcnn_odom.simulation.street.line import LEAD_IN, PATH_STEP, driven_line, headings
from rcnn_odom.simulation.street.polyline import resample, unit
from rcnn_odom.simulation.street.speed import FRAME_TIME, SPEED_VARIES, travel
from rcnn_odom.simulation.street.sway import sway

LEVER = (0.75, 1.0)
"""Metres from the rear axle forward to the laser. With the slip of the tyres and the distance driven during a
turn, the lateral step of the laser in turns is 0.78 to 0.95 metres per radian."""

SLIP = 0.008
"""Radians of slip angle per m/s^2 of lateral acceleration; the car's nose points into the bend."""

MOUNTING = (-0.002, 0.005)
"""Radians between the direction of the laser and the direction in which its car drives."""

SWAY_HEIGHT = 1.2
"""Metres from the axis about which a car pitches and rolls up to the laser, which is moved by both."""

PACE = (0.4, 1.6)
PACE_FRAMES = 100
"""Range of the speed factor of a drive at another pace, and number of frames after which it changes."""


@dataclass(frozen=True)
class Drive:
    """N frames of a drive.

    Attributes:
        planar: (N, 3) x and y in metres and heading in radians of the laser in the world.
        tilt: (N, 2) pitch (positive: nose down) and roll (positive: left side up) in radians of the car on
            its springs, relative to the road.
        path: (M, 2) metres, the line that the middle of the rear axle drives, with points `PATH_STEP` apart;
            it begins before the drive and ends after it.
        along: (N,) metres along the path.
    """

    planar: FloatArray
    tilt: FloatArray
    path: FloatArray
    along: FloatArray


def random_drive(plan: Plan, warp: Warp, frames: int, rng: np.random.Generator) -> Drive:
    """Simulate a random drive; with the same ``rng``, a longer drive begins like a shorter one.

    Args:
        plan: the streets; their kind sets how they are driven.
        warp: deformation from the plan to the world.
        frames: number of scans, `FRAME_TIME` apart.
        rng: source of all random choices.
    """
    route_rng, line_rng, speed_rng, body_rng = rng.spawn(4)
    roads = plan.roads
    fastest = roads.speed[1] * (1 + SPEED_VARIES)
    length = 2 * LEAD_IN + FRAME_TIME * (frames + 50) * fastest
    # The route is longer than needed, because rounding its corners and averaging shorten it.
    route = random_route(plan, 1.2 * length + 200, route_rng)
    path, crossings = driven_line(route, warp, roads, line_rng)
    heading = headings(path)
    # Two more frames at both ends, where second differences are one-sided.
    along = travel(heading, crossings, route.turn, roads, frames + 4, speed_rng)
    planar, tilt = _laser(path, heading, along, roads, body_rng)
    path = path[: int((along[-1] + LEAD_IN) / PATH_STEP) + 1]
    return Drive(planar[2:-2], tilt[2:-2], path, along[2:-2])


def _laser(
    path: FloatArray, heading: FloatArray, along: FloatArray, roads: Roads, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Compute the motion of the laser on a car.

    Args:
        path: (M, 2) metres, line of the rear axle.
        heading: (M,) radians, directions of the path.
        along: (N,) metres, position of the rear axle on the path in each frame.
        roads: kind of the roads.
        rng: source of all random choices.

    Returns:
        x, y and heading (N, 3) of the laser in metres and radians; and pitch and roll (N, 2) in radians.
    """
    lever, mounting = rng.uniform(*LEVER), rng.uniform(*MOUNTING)
    at = PATH_STEP * np.arange(len(path), dtype=np.float64)
    axle = resample(path, at, along)
    direction = np.interp(along, at, heading)
    speed = np.gradient(along, FRAME_TIME)
    aside = speed * np.gradient(direction, FRAME_TIME)
    pitch, roll, yaw = sway(speed, aside, rng.uniform(*roads.roughness), rng).T
    faces = direction + SLIP * aside + yaw
    forward = unit(faces)
    left = np.stack([-forward[:, 1], forward[:, 0]], axis=1)
    laser = axle + (lever + SWAY_HEIGHT * pitch)[:, None] * forward - (SWAY_HEIGHT * roll)[:, None] * left
    planar = np.concatenate([laser, faces[:, None] - mounting], axis=1)
    return planar, np.stack([pitch, roll], axis=1)


def at_other_paces(plan: Plan, warp: Warp, frames: int, rng: np.random.Generator) -> Drive:
    """Simulate a drive like `random_drive`, but with a speed that is 0.4 to 1.6 times the usual one.

    The factor changes every ten seconds. It prevents a network from guessing the speed from the look of a
    street, which works with KITTI's speeds alone, instead of measuring it. Arguments as for `random_drive`.
    """
    drive_rng, pace_rng = rng.spawn(2)
    paces = pace_rng.uniform(*PACE, frames // PACE_FRAMES + 2)
    pace = np.interp(np.arange(frames), PACE_FRAMES * np.arange(len(paces)), paces)
    at = np.cumsum(pace)
    usual = random_drive(plan, warp, int(at[-1]) + 2, drive_rng)
    time = np.arange(len(usual.planar), dtype=np.float64)
    planar, tilt = resample(usual.planar, time, at), resample(usual.tilt, time, at)
    return replace(usual, planar=planar, tilt=tilt, along=np.interp(at, time, usual.along))
