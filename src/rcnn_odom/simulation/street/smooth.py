"""Smooth functions of distance or time: moving averages and random waves."""

import numpy as np

from rcnn_odom.geometry import FloatArray


def average_twice(values: FloatArray, window: int) -> FloatArray:
    """Moving average over ``window`` values, applied twice; it removes ``window - 1`` values at both ends."""
    box = np.ones(window) / window
    return np.convolve(values, np.convolve(box, box), mode="valid")


def random_waves(lengths: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    """Three random waves: wave numbers in radians per metre and phases in radians, (2, 3).

    Args:
        lengths: metres, range of the wavelengths.
        rng: source of the wavelengths and phases.
    """
    return np.stack([2 * np.pi / rng.uniform(*lengths, 3), rng.uniform(0, 2 * np.pi, 3)])


def meander(along: FloatArray, waves: FloatArray) -> FloatArray:
    """Mean of some waves at distances ``along`` (M,): slow variations (M,) between -1 and 1."""
    mean: FloatArray = np.sin(along[:, None] * waves[0] + waves[1]).mean(axis=1)
    return mean
