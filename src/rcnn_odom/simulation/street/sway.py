"""Sway of a car on its springs and tyres: pitch, roll and yaw."""

from dataclasses import dataclass

import numpy as np

from rcnn_odom.geometry import FloatArray
from rcnn_odom.simulation.street.speed import FRAME_TIME

BUMP_FRAMES = 50
"""Number of frames after which a bump has no more effect."""

PITCH_OF_ACCELERATION = -0.0015
"""Radians of pitch (nose down) per m/s^2 of forward acceleration."""

ROLL_OF_ACCELERATION = 0.0075
"""Radians of roll (left side up) per m/s^2 of acceleration to the left; the body leans outwards."""


@dataclass(frozen=True)
class _Sway:
    """Random rotation about one axis: road noise through a damped spring (bounce) and a slow filter (lean).

    Attributes:
        bounce_deg: degrees, standard deviation of the bounce on a usual road at 10 m/s.
        frequency: hertz, frequency of the bounce.
        damping: damping of the bounce, as a part of the critical damping.
        lean_deg: degrees, standard deviation of the slow part.
        lean_time: seconds, time constant of the slow part.
    """

    bounce_deg: float
    frequency: float
    damping: float
    lean_deg: float
    lean_time: float


PITCH_SWAY = _Sway(bounce_deg=0.215, frequency=1.25, damping=0.25, lean_deg=0.7, lean_time=0.8)
ROLL_SWAY = _Sway(bounce_deg=0.175, frequency=1.0, damping=0.5, lean_deg=0.95, lean_time=0.8)
YAW_SWAY = _Sway(bounce_deg=0.0, frequency=1.0, damping=0.5, lean_deg=0.12, lean_time=1.0)


def sway(speed: FloatArray, aside: FloatArray, rough: float, rng: np.random.Generator) -> FloatArray:
    """Simulate pitch, roll and yaw (N, 3) in radians of a car on its springs and tyres.

    Args:
        speed: (N,) metres per second.
        aside: (N,) m/s^2, acceleration to the left.
        rough: roughness of the road; 1 is usual in a town.
        rng: source of the road's bumps.
    """
    # Bumps have no effect on a car that stands.
    bumps = np.sqrt(np.clip(speed, 0, None) / 10)
    bumps = np.concatenate([np.full(BUMP_FRAMES - 1, bumps[0]), bumps])
    noise = rough * bumps[:, None] * rng.standard_normal((len(bumps), 6))
    pitch = PITCH_OF_ACCELERATION * np.gradient(speed, FRAME_TIME) + _filter_noise(PITCH_SWAY, noise[:, :2])
    roll = ROLL_OF_ACCELERATION * aside + _filter_noise(ROLL_SWAY, noise[:, 2:4])
    return np.stack([pitch, roll, _filter_noise(YAW_SWAY, noise[:, 4:])], axis=1)


def _filter_noise(kind: _Sway, noise: FloatArray) -> FloatArray:
    """Filter road noise (N + BUMP_FRAMES - 1, 2) by bounce and lean; returns rotations (N,) in radians."""
    time = FRAME_TIME * np.arange(BUMP_FRAMES)
    turned = 2 * np.pi * kind.frequency * time
    bounce = np.exp(-kind.damping * turned) * np.sin(turned)
    lean = time / kind.lean_time * np.exp(-time / kind.lean_time)
    total: FloatArray = sum(
        np.deg2rad(deviation_deg) * np.convolve(one, response / np.linalg.norm(response), mode="valid")
        for deviation_deg, response, one in (
            (kind.bounce_deg, bounce, noise[:, 0]),
            (kind.lean_deg, lean, noise[:, 1]),
        )
    )
    return total
