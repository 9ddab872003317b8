"""The steps of the shipped network on one drive, as they came out when it was shipped."""

import numpy as np

from rcnn_odom.deployment.odometer import Odometer

BEARINGS = np.deg2rad(np.arange(0, 360, 0.2) - 180.0)
TURN = 0.02
"""Radians from one scan to the next."""
GOLDEN = np.array(
    [
        [0.659406, 0.007959, 0.012070],
        [0.553102, 0.007171, 0.012964],
        [0.519930, 0.006187, 0.011899],
        [0.508756, 0.005847, 0.011493],
        [0.505561, 0.005278, 0.010440],
        [0.507594, 0.005152, 0.010149],
        [0.515566, 0.004955, 0.009610],
        [0.533793, 0.004981, 0.009331],
        [0.544798, 0.005149, 0.009451],
        [0.550674, 0.005276, 0.009580],
        [0.558204, 0.005453, 0.009769],
        [0.582077, 0.005511, 0.009467],
    ]
)
"""x, y in metres and heading in radians."""
TOLERANCE = 1e-4
"""Metres and radians, between a processor with AVX-512 and VNNI and others."""


def yard_scan(frame):
    """Ranges in a yard of 90 by 50 m with a round tower, driven through in a wide curve."""
    heading = frame * TURN
    x, y = -20 + frame * np.cos(heading / 2), -5 + frame * np.sin(heading / 2)
    directions = BEARINGS + heading
    cos, sin = np.cos(directions), np.sin(directions)
    with np.errstate(divide="ignore"):
        walls = np.minimum((45 * np.sign(cos) - x) / cos, (25 * np.sign(sin) - y) / sin)
    ahead = (5 - x) * cos + (10 - y) * sin
    beside = (5 - x) ** 2 + (10 - y) ** 2 - ahead**2
    tower = ahead - np.sqrt(np.maximum(16 - beside, 0))
    return np.where((beside < 16) & (ahead > 0), np.minimum(tower, walls), walls)


def test_the_shipped_network_says_what_it_said():
    odometer = Odometer.from_onnx("rcnn_small")
    poses = [odometer.step(yard_scan(frame), 0.1 * frame, BEARINGS) for frame in range(13)]
    steps = np.array([pose.step.array() for pose in poses[1:]])
    print(np.abs(steps - GOLDEN).max(0))
    np.testing.assert_allclose(steps, GOLDEN, atol=TOLERANCE)
    assert not any(pose.degraded for pose in poses)
