"""The steps of the shipped networks on a drive each, as they came out when they were shipped.

After other weights: ``python tests/deployment/test_golden_steps.py`` writes them anew.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from rcnn_odom.deployment.odometer import Odometer

GOLDEN = Path(__file__).with_name("golden_steps.json")
"""x, y in metres and heading in radians of each step, by network."""
ROUND = np.deg2rad(np.arange(0, 360, 0.2) - 180.0)
HALF = np.deg2rad(np.arange(181) - 90.0)
DRIVES = {"all_round": (ROUND, 1.0), "half_circle": (HALF, 0.1)}
"""By network its beams, and what a metre of the yard is in metres: 0.1 makes a room of it."""
FRAMES = 13
TURN = 0.02
"""Radians from one scan to the next."""
TOLERANCE = 1e-4
"""Metres and radians, between a processor with AVX-512 and others."""


def yard_scan(frame, bearings):
    """Ranges in a yard of 90 by 50 m with a round tower, driven through in a wide curve, 1 m a scan."""
    heading = frame * TURN
    x, y = -20 + frame * np.cos(heading / 2), -5 + frame * np.sin(heading / 2)
    directions = bearings + heading
    cos, sin = np.cos(directions), np.sin(directions)
    with np.errstate(divide="ignore"):
        walls = np.minimum((45 * np.sign(cos) - x) / cos, (25 * np.sign(sin) - y) / sin)
    ahead = (5 - x) * cos + (10 - y) * sin
    beside = (5 - x) ** 2 + (10 - y) ** 2 - ahead**2
    tower = ahead - np.sqrt(np.maximum(16 - beside, 0))
    return np.where((beside < 16) & (ahead > 0), np.minimum(tower, walls), walls)


def poses_of(name):
    """What a network makes of its drive."""
    (bearings, metre), odometer = DRIVES[name], Odometer.from_onnx(name)
    return [
        odometer.step(metre * yard_scan(frame, bearings), 0.1 * frame, bearings) for frame in range(FRAMES)
    ]


def steps_in(poses):
    return np.array([pose.step.array() for pose in poses[1:]])


@pytest.mark.parametrize("name", DRIVES)
def test_the_shipped_networks_say_what_they_said(name):
    golden, poses = np.array(json.loads(GOLDEN.read_text())[name]), poses_of(name)
    steps = steps_in(poses)
    print(np.abs(steps - golden).max(0))
    np.testing.assert_allclose(steps, golden, atol=TOLERANCE)
    assert not any(pose.degraded for pose in poses)


def write_golden_steps():
    """Takes what the networks say now for right; shows it, beside the true length and turn of a step."""
    golden = {name: steps_in(poses_of(name)).round(6).tolist() for name in DRIVES}
    for name, steps in golden.items():
        print(f"{name}, true steps of {DRIVES[name][1]:g} m and {TURN:g} rad:", *steps, sep="\n")
    lines = (f' "{name}": [\n  {rows}\n ]' for name, rows in _as_rows(golden).items())
    GOLDEN.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def _as_rows(golden):
    """A line a step, so that a difference can be read."""
    return {name: ",\n  ".join(map(json.dumps, steps)) for name, steps in golden.items()}


if __name__ == "__main__":
    write_golden_steps()
