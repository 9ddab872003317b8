"""Whether points lie in the frame of the laser that saw them: its beams are cones about a place on its axis.

A cloud that was raised, to the ground or a robot's base, can still be read: only the cones' tops lie
elsewhere. In a tilted cloud, or in a camera's frame, the points of a ring lie on no such cone.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.recordings.velodyne import HIGHEST, HIGHEST_RISE, Points, elevations_from, fit_beam

STEEP = np.deg2rad(45.0)
MOST_STEEP = 0.3
"""Part of the points that may be steeper; in a camera's frame, z ahead, nearly half of them are."""
CLEARER = 2.0
"""A rise is believed that makes the rings so many times narrower."""
ONE_SIGMA = 68.0


def describe_steepness(clouds: Sequence[Points]) -> str:
    """Why clouds, each (P, 3 or more), are not in their laser's frame; empty where they may be."""
    points = np.concatenate(clouds)
    steep = float(np.mean(np.abs(elevations_from(points, 0.0)) > STEEP)) if len(points) else 0.0
    if steep <= MOST_STEEP:
        return ""
    return f"{100 * steep:.0f} % of the points are steeper than 45 degrees, as in a camera's frame"


def find_rise(rings: Iterable[Points]) -> float:
    """Metres by which points were raised above where their laser's beams meet; 0: not that one could tell.

    Args:
        rings: the points (P, 3 or more) of each laser.
    """
    centred = [_centre(ring) for ring in rings if len(ring)]
    if not centred:
        return 0.0
    closeness, slope = np.concatenate(centred, axis=1)
    square = float(closeness @ closeness)
    if square < 1e-9:
        return 0.0
    rise = float(np.clip(closeness @ slope / square, -HIGHEST_RISE, HIGHEST_RISE))
    usual = float(np.clip(rise, -HIGHEST, HIGHEST))
    width, width_without = (float(np.median(np.abs(slope - h * closeness))) for h in (rise, usual))
    return rise if CLEARER * width < width_without else 0.0


def _centre(ring: Points) -> FloatArray:
    """1 / distance and z / distance (2, P) of a ring's points, about their means."""
    x, y, z = ring[:, :3].astype(np.float64).T
    distance = np.maximum(np.hypot(x, y), 1.0)
    both = np.stack([1 / distance, z / distance])
    centred: FloatArray = both - both.mean(axis=1, keepdims=True)
    return centred


def lowered(points: Points, rise: float) -> Points:
    """The points (P, 3 or more) in the frame in which the beams meet at the height 0."""
    if rise == 0.0:
        return points
    points = points.copy()
    points[:, 2] -= rise
    return points


def cone_spread(rings: Iterable[Points]) -> float:
    """How far the points of one laser lie from their cone in radians, as a standard deviation but robust.

    Args:
        rings: its points (P, 3 or more) in each of some frames.
    """
    points = np.concatenate([ring[:, :3] for ring in rings])
    if not len(points):
        return 0.0
    beam = fit_beam(points)
    return float(np.percentile(np.abs(elevations_from(points, beam.height) - beam.elevation), ONE_SIGMA))
