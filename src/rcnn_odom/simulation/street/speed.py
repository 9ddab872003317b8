"""How fast a driver goes along a line: bends, crossings, and what a car and its driver can do."""

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.street.city import Roads
from rcnn_odom.simulation.street.line import LEAD_IN, PATH_STEP, Indices
from rcnn_odom.simulation.street.smooth import average_twice, meander, random_waves

FRAME_TIME = 0.1
"""Seconds from scan to scan."""

ACCELERATION = (2.1, 3.1)
BRAKING = (2.7, 4.2)
"""m/s^2 that drivers are capable of, before `PEDAL_TIME` takes the edge off."""

EFFORT = (0.25, 1.0)
"""Share of it that a driver makes use of, changing along the way."""

EFFORT_WAVES = (60.0, 300.0)
SPEED_WAVES = (80.0, 500.0)
"""Metres over which effort and the speed in mind rise and fall."""

LATERAL_ACCELERATION = (2.6, 4.0)
"""m/s^2 that a driver bears in bends: the 99th percentile of each sequence with bends is 2.2 to 4.0."""

YAW_RATE = (0.5, 0.7)
"""Radians per second at most in a turn at a crossing."""

PEDAL_TIME = 1.6
"""Seconds over which the speed is averaged twice: no pedal is pressed at once."""

SPEED_VARIES = 0.15
"""Share by which the speed in mind rises and falls."""

TURN_SPEED = (1.0, 7.0)
"""Metres per second in the middle of a turn at a crossing, where its bend does not ask for less."""

GIVE_WAY_SPEED = (1.0, 7.0)
GIVE_WAY_BEFORE = 10.0
"""Metres before the middle of a crossing where a car that gives way is slowest."""

STOP = (2.5, 6.5)
"""Seconds of standing, of which braking and starting smoothly take some."""

CRAWL = 0.1
"""Metres per second at a stop line: a speed of 0 would never leave it."""


def travel(
    heading: FloatArray,
    crossings: FloatArray,
    turn: Indices,
    roads: Roads,
    frames: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Metres along the path in every frame, (frames,).

    Args:
        heading: (M,) radians at every step of the path.
        crossings: (C,) metres along the path.
        turn: (C,) 0 where a crossing is passed straight on.
        roads: their kind.
        frames: how many.
        rng: of the driver.
    """
    along = PATH_STEP * np.arange(len(heading), dtype=np.float64)
    mood = 1 + SPEED_VARIES * meander(along, random_waves(SPEED_WAVES, rng))
    limit = np.minimum(_bend_limit(heading, rng), rng.uniform(*roads.speed) * mood)
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
    """Metres per second, (M,), that a driver likes in the bends of a path."""
    curvature = np.abs(np.gradient(heading, PATH_STEP)) + 1e-6
    lateral, yaw_rate = rng.uniform(*LATERAL_ACCELERATION), rng.uniform(*YAW_RATE)
    limit: FloatArray = np.minimum(np.sqrt(lateral / curvature), yaw_rate / curvature)
    return limit


def _slow_at_crossings(
    limit: FloatArray, crossings: FloatArray, turn: Indices, roads: Roads, rng: np.random.Generator
) -> FloatArray:
    """Lower the limit (M,) where one gives way; seconds of standing at every step, (M,)."""
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
    """The fastest speed (M,) below a limit with accelerations within two bounds, all (M,).

    In squared speed over the way an acceleration is a slope: the answer is the lower envelope.
    """
    rise, fall = 2 * PATH_STEP * np.cumsum(speeding_up), 2 * PATH_STEP * np.cumsum(braking)
    squared = np.minimum.accumulate(limit**2 - rise) + rise
    squared = np.minimum.accumulate((squared + fall)[::-1])[::-1] - fall
    return np.sqrt(np.maximum(squared, CRAWL**2))
