"""Speed of a car along a line: limited by bends, crossings, and the accelerations of car and driver."""

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.street.city import Roads
from rcnn_odom.simulation.street.line import LEAD_IN, PATH_STEP, Indices
from rcnn_odom.simulation.street.smooth import average_twice, meander, random_waves

FRAME_TIME = 0.1
"""Seconds from scan to scan."""

ACCELERATION = (2.1, 3.1)
BRAKING = (2.7, 4.2)
"""m/s^2, largest accelerations of drivers, before the smoothing over `PEDAL_TIME`."""

EFFORT = (0.25, 1.0)
"""Part of these accelerations that a driver uses; it changes along the way."""

EFFORT_WAVES = (60.0, 300.0)
SPEED_WAVES = (80.0, 500.0)
"""Metres, wavelengths of the changes of effort and of wanted speed."""

LATERAL_ACCELERATION = (2.6, 4.0)
"""m/s^2, limit in bends; the 99th percentile of each KITTI sequence with bends is 2.2 to 4.0."""

YAW_RATE = (0.5, 0.7)
"""Radians per second, limit in bends and turns."""

PEDAL_TIME = 1.6
"""Seconds of the window over which the speed is averaged twice, to limit the jerk."""

SPEED_VARIES = 0.15
"""Relative amplitude of the changes of the wanted speed."""

TURN_SPEED = (1.0, 7.0)
"""Metres per second, limit in the middle of a turn at a crossing."""

GIVE_WAY_SPEED = (1.0, 7.0)
"""Metres per second of a car that gives way, at its slowest point."""
GIVE_WAY_BEFORE = 10.0
"""Metres before the middle of a crossing where a car that gives way is slowest."""

STOP = (2.5, 6.5)
"""Seconds of a stop; smoothing turns a part of it into braking and starting."""

CRAWL = 0.1
"""Metres per second at a stop line; at a speed of 0, the car would never leave it."""


def travel(
    heading: FloatArray,
    crossings: FloatArray,
    turn: Indices,
    roads: Roads,
    frames: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Simulate the position of a car on a path over time.

    Args:
        heading: (M,) radians, directions of the path, `PATH_STEP` apart.
        crossings: (C,) metres along the path.
        turn: (C,) 0 if a crossing is passed straight on.
        roads: kind of the roads.
        frames: number of frames, `FRAME_TIME` apart.
        rng: source of all random choices.

    Returns:
        Metres (frames,) along the path in each frame.
    """
    along = PATH_STEP * np.arange(len(heading), dtype=np.float64)
    variation = 1 + SPEED_VARIES * meander(along, random_waves(SPEED_WAVES, rng))
    limit = np.minimum(_bend_limit(heading, rng), rng.uniform(*roads.speed) * variation)
    effort = np.mean(EFFORT) + np.ptp(EFFORT) / 2 * meander(along, random_waves(EFFORT_WAVES, rng))
    speeding_up, braking = rng.uniform(*ACCELERATION) * effort, rng.uniform(*BRAKING) * effort
    wait = _slow_at_crossings(limit, crossings, turn, roads, rng)
    speed = _fastest(limit, speeding_up, braking)
    step_time = 2 * PATH_STEP / (speed[1:] + speed[:-1])
    leave = wait + np.concatenate([[0.0], np.cumsum(step_time + wait[:-1])])
    arrive = leave - wait
    window = round(PEDAL_TIME / FRAME_TIME)
    start = np.interp(LEAD_IN, along, leave)
    time = start + FRAME_TIME * np.arange(frames + 2 * (window - 1))
    where = np.interp(time, np.stack([arrive, leave], axis=1).ravel(), along.repeat(2))
    return average_twice(where, window)


def _bend_limit(heading: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Speed limits (M,) in metres per second because of the bends of a path with directions (M,)."""
    curvature = np.abs(np.gradient(heading, PATH_STEP)) + 1e-6
    lateral, yaw_rate = rng.uniform(*LATERAL_ACCELERATION), rng.uniform(*YAW_RATE)
    limit: FloatArray = np.minimum(np.sqrt(lateral / curvature), yaw_rate / curvature)
    return limit


def _slow_at_crossings(
    limit: FloatArray, crossings: FloatArray, turn: Indices, roads: Roads, rng: np.random.Generator
) -> FloatArray:
    """Lower the speed limit (M,) in place at crossings with a turn, a stop or other traffic.

    Returns:
        Seconds (M,) for which the car stands at each step of the path.
    """
    wait = np.zeros(len(limit))
    for at, straight, (yields, slowly, stops, duration) in zip(
        crossings, turn == 0, rng.random((len(crossings), 4)), strict=True
    ):
        middle, before = int(at / PATH_STEP), int((at - GIVE_WAY_BEFORE) / PATH_STEP)
        if before <= 0 or middle >= len(limit):
            continue
        if not straight:
            limit[middle] = min(limit[middle], TURN_SPEED[0] + slowly * np.ptp(TURN_SPEED))
        elif yields < roads.gives_way:
            limit[before] = min(limit[before], GIVE_WAY_SPEED[0] + slowly * np.ptp(GIVE_WAY_SPEED))
        if stops < roads.stops:
            limit[before] = CRAWL
            wait[before] = STOP[0] + duration * np.ptp(STOP)
    return wait


def _fastest(limit: FloatArray, speeding_up: FloatArray, braking: FloatArray) -> FloatArray:
    """The fastest speeds (M,) below a limit with bounded accelerations, all (M,).

    As a function of distance, half of the squared speed has the acceleration as its slope. So the squared
    speed is the lower envelope of the limit and of lines with the largest slopes.
    """
    rise, fall = 2 * PATH_STEP * np.cumsum(speeding_up), 2 * PATH_STEP * np.cumsum(braking)
    squared = np.minimum.accumulate(limit**2 - rise) + rise
    squared = np.minimum.accumulate((squared + fall)[::-1])[::-1] - fall
    return np.sqrt(np.maximum(squared, CRAWL**2))
