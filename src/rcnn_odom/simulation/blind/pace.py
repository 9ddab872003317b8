"""Speed of a car or a robot over time: stretches at different speeds, and sometimes a stop."""

from dataclasses import dataclass

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.street.smooth import average_twice, meander, random_waves

TICK = 0.05
"""Seconds, time step of the computed speed."""
JERK_TIME = 0.5
"""Seconds of the window over which the speed is averaged twice, to limit the jerk."""
UNSTEADY, UNSTEADY_WAVES = 0.08, (4.0, 25.0)
"""Relative amplitude of slow variations of the speed, and range of their periods in seconds."""


@dataclass(frozen=True)
class Pace:
    """Ranges of the uniform draws for a drive and for each of its stretches.

    Attributes:
        fastest: metres per second, top speed of a drive.
        share: speed of a stretch as a part of the top speed.
        stretch: seconds, duration of a stretch, including the change to its speed.
        stop_chance: probability that a stretch is a stop.
        stop: seconds, duration of a stop, including braking.
        speeding_up, braking: m/s^2, accelerations in a stretch.
    """

    fastest: tuple[float, float]
    share: tuple[float, float]
    stretch: tuple[float, float]
    stop_chance: float
    stop: tuple[float, float]
    speeding_up: tuple[float, float]
    braking: tuple[float, float]


CAR = Pace((9.0, 19.0), (0.3, 1.0), (4.0, 15.0), 0.1, (6.0, 12.0), (0.6, 2.0), (0.8, 3.0))
"""A car in a city tunnel, at 30 to 70 km/h, behind other cars that slow down and sometimes stop."""
CAR_ON_A_TRACK = Pace((4.0, 9.0), (0.3, 1.0), (3.0, 12.0), 0.08, (4.0, 10.0), (0.5, 1.5), (0.8, 2.5))
"""A car on a gravel track, at 15 to 30 km/h."""
ROBOT = Pace((1.0, 1.6), (0.3, 1.0), (3.0, 12.0), 0.15, (3.0, 8.0), (0.3, 0.8), (0.4, 1.0))
"""A transport robot in a large building, which waits at doors and for people."""


def travel(pace: Pace, stamps: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Simulate the distance driven.

    Args:
        pace: ranges of the speeds.
        stamps: (N,) seconds, increasing.
        rng: source of all random choices.

    Returns:
        Metres (N,) driven since the first stamp.
    """
    window = round(JERK_TIME / TICK)
    count = int(np.ceil((stamps[-1] - stamps[0]) / TICK)) + 2 * window
    fastest = rng.uniform(*pace.fastest)
    speeds: list[float] = []
    speed = fastest * rng.uniform(*pace.share)
    while len(speeds) < count:
        wanted = 0.0 if rng.random() < pace.stop_chance else fastest * rng.uniform(*pace.share)
        seconds = rng.uniform(*(pace.stretch if wanted else pace.stop))
        rise, fall = TICK * rng.uniform(*pace.speeding_up), TICK * rng.uniform(*pace.braking)
        for _ in range(round(seconds / TICK)):
            speed += min(max(wanted - speed, -fall), rise)
            speeds.append(speed)
    smooth = average_twice(np.array(speeds), window)
    moments = TICK * np.arange(len(smooth) + 1, dtype=np.float64)
    smooth *= 1 + UNSTEADY * meander(moments[1:], random_waves(UNSTEADY_WAVES, rng))
    driven = np.concatenate([[0.0], np.cumsum(TICK * smooth)])
    return np.interp(stamps - stamps[0], moments, driven)
