"""How fast a car or a robot goes: stretches at other speeds, and now and then a stop."""

from dataclasses import dataclass

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.street.smooth import average_twice, meander, random_waves

TICK = 0.05
"""Seconds between two looks at the speed."""
JERK_TIME = 0.5
"""Seconds over which the speed is averaged twice: no pedal is pressed at once."""
UNSTEADY, UNSTEADY_WAVES = 0.08, (4.0, 25.0)
"""Share by which no speed is ever kept exactly, and seconds over which it strays."""


@dataclass(frozen=True)
class Pace:
    """What a drive and each of its stretches draw from, all evenly.

    Attributes:
        fastest: metres a second that a drive has in mind.
        share: of it in a stretch.
        stretch: seconds for which a speed is kept, the change to it included.
        stop_chance: that a stretch is a stop.
        stop: seconds of it, braking included.
        speeding_up, braking: m/s^2 of a stretch.
    """

    fastest: tuple[float, float]
    share: tuple[float, float]
    stretch: tuple[float, float]
    stop_chance: float
    stop: tuple[float, float]
    speeding_up: tuple[float, float]
    braking: tuple[float, float]


CAR = Pace((9.0, 19.0), (0.3, 1.0), (4.0, 15.0), 0.1, (6.0, 12.0), (0.6, 2.0), (0.8, 3.0))
"""In a tunnel of a city, at 30 to 70 km/h, behind others who slow down and at times stand."""
CAR_ON_A_TRACK = Pace((4.0, 9.0), (0.3, 1.0), (3.0, 12.0), 0.08, (4.0, 10.0), (0.5, 1.5), (0.8, 2.5))
"""On a gravel track, at 15 to 30 km/h."""
ROBOT = Pace((1.0, 1.6), (0.3, 1.0), (3.0, 12.0), 0.15, (3.0, 8.0), (0.3, 0.8), (0.4, 1.0))
"""One that carries things through a large building; it waits at doors and for people."""


def travel(pace: Pace, stamps: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Metres driven since the first of some moments (N,), rising from 0; seconds in, (N,) metres out."""
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
