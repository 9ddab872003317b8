"""A generator of drives that costs nothing; workers import it, and with it little else.

It is a recording format by the entry point in the folder ``stub_drives-1.0.dist-info``.
"""

import time
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import planar_to_poses
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.scan import Scan

FRAMES = {"00": 150, "02": 70, "10": 40, "05": 40}


@dataclass(frozen=True)
class Scans:
    """Random scans of a drive; a broken one has none, and a slow one takes its time."""

    name: str
    seed: int
    broken: str = ""
    seconds: float = 0.0

    def __call__(self, frame):
        if self.name == self.broken and frame == 20:
            raise InputError(f"{self.name}: frame 20 is damaged; copy it again")
        time.sleep(self.seconds)
        rng = np.random.default_rng([self.seed, crc32(self.name.encode()), frame])
        bearings = rng.uniform(-np.pi, np.pi, 100)
        return Scan(rng.uniform(0, 50, 100), bearings, has_all_beams=False)


def load(name, seed=0, broken="", seconds=0.0, frames=None, **options):
    """A drive for any name, as ``rcnn_odom.recordings.simulated.load``; ``NAME~K`` is as long as NAME."""
    frames = frames or FRAMES[name.split("~")[0]]
    steps = np.random.default_rng([seed, crc32(name.encode())]).uniform(
        [0.5, -0.05], [1.5, 0.05], (frames, 2)
    )
    heading = np.cumsum(steps[:, 1])
    planar = np.stack(
        [np.cumsum(steps[:, 0] * np.cos(heading)), np.cumsum(steps[:, 0] * np.sin(heading)), heading], axis=1
    )
    stamps = np.arange(frames, dtype=np.float64)
    scans = Scans(name, seed, broken, seconds)
    return Recording(name, planar_to_poses(planar), stamps, scans, fingerprint=f"{name} {seed} {frames}")
