"""What drivers change slowly: values averaged along the way, and waves."""

import numpy as np

from rcnn_odom.geometry import FloatArray


def average_twice(values: FloatArray, window: int) -> FloatArray:
    """Means over so many values, and again over the means; ``window - 1`` fewer at both ends."""
    box = np.ones(window) / window
    return np.convolve(values, np.convolve(box, box), mode="valid")


def random_waves(lengths: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    """Radians per metre and phases, (2, 3), of three waves that are so many metres long."""
    return np.stack([2 * np.pi / rng.uniform(*lengths, 3), rng.uniform(0, 2 * np.pi, 3)])


def meander(along: FloatArray, waves: FloatArray) -> FloatArray:
    """A slow up and down between -1 and 1, (M,)."""
    mean: FloatArray = np.sin(along[:, None] * waves[0] + waves[1]).mean(axis=1)
    return mean
