"""Tiny CARMEN logs: a robot with a planar laser in a room with posts, scans and poses that agree."""

import bz2
import gzip
import lzma
from pathlib import Path

import numpy as np
from backports import zstd

from data.make_kitti import cast, drive, world

MAX_READING = 81.91
LASER_AHEAD = 0.2
"""Metres from the robot to its laser, straight ahead, on ROBOTLASER1 lines."""

PACKINGS = {"gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress, "zst": zstd.compress}


def make_carmen(
    root: Path,
    name: str = "robot",
    frames: int = 60,
    beams: int = 180,
    fmt: str = "FLASER",
    compress: str | None = None,
    seed: int = 0,
) -> np.ndarray:
    """Write ``root/NAME.log``, with the ending of a packing; returns the laser's x, y, heading, (frames, 3).

    0.1 to 0.3 m a frame and turns of up to 4 degrees. The laser pose on a line is the truth; odometry
    runs 2 % long and turns a little. One beam in a hundred gives no return (the maximal reading).
    """
    rng = np.random.default_rng(seed)
    planar = drive(rng, frames, distance=(0.1, 0.3), turn_deg=4.0)
    circles, walls = world(rng, planar, clearance=0.6, margin=6.0, posts=25, radius=(0.1, 0.6))
    spacing = np.pi / (beams if beams % 2 == 0 else beams - 1)
    angles = -np.pi / 2 + spacing * np.arange(beams)
    robot = wheel_odometry(planar) if fmt == "FLASER" else behind(wheel_odometry(planar))
    lines = ["# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp"]
    lines.append("PARAM robot_frontlaser_offset 0.2 nohost 0")
    for frame, (pose, odometry) in enumerate(zip(planar, robot, strict=True)):
        ranges = cast(pose, angles, circles, walls) + rng.normal(0, 0.01, beams)
        ranges[rng.random(beams) < 0.01] = MAX_READING
        readings = " ".join(f"{value:.2f}" for value in ranges)
        time = f"{1000 + 0.2 * frame:.6f} nohost {0.2 * frame:.6f}"
        poses = " ".join(f"{value:.9f}" for value in (*pose, *odometry))
        lines.append(" ".join(f"{value:.6f}" for value in odometry) + f" 0.5 0 0 {time}")
        lines[-1] = "ODOM " + lines[-1]
        if fmt == "FLASER":
            lines.append(f"FLASER {beams} {readings} {poses} {time}")
        else:
            head = f"0 {-np.pi / 2:.9f} {np.pi:.9f} {spacing:.9f} {MAX_READING} 0.01 0"
            lines.append(f"ROBOTLASER1 {head} {beams} {readings} 0 {poses} 0.5 0 0.3 0.3 1e6 {time}")
    write_log(root / f"{name}.log", lines, compress)
    return planar


def write_log(path: Path, lines: list[str], compress: str | None = None) -> Path:
    """Write the lines, packed as asked for (None or one of ``PACKINGS``); returns where."""
    content = ("\n".join(lines) + "\n").encode()
    pack = PACKINGS[compress] if compress else bytes
    path = path if compress is None else path.with_name(f"{path.name}.{compress}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pack(content))
    return path


def wheel_odometry(planar: np.ndarray) -> np.ndarray:
    """The truth as slightly wrong wheels would tell it, from the same first pose; (N, 3)."""
    steps = np.diff(planar[:, :2], axis=0)
    length, direction = 1.02 * np.hypot(*steps.T), np.arctan2(steps[:, 1], steps[:, 0])
    error = 0.0005 * np.arange(1, len(planar))
    moves = np.stack([length * np.cos(direction + error), length * np.sin(direction + error)], axis=1)
    wrong = planar.copy()
    wrong[1:, :2] = planar[0, :2] + np.cumsum(moves, axis=0)
    wrong[1:, 2] += error
    return wrong


def behind(laser: np.ndarray) -> np.ndarray:
    """Where the robot is whose laser is at these poses; (N, 3)."""
    robot = laser.copy()
    robot[:, 0] -= LASER_AHEAD * np.cos(laser[:, 2])
    robot[:, 1] -= LASER_AHEAD * np.sin(laser[:, 2])
    return robot
