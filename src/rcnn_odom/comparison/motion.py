"""How the simulator's motion compares with KITTI's: a table in Markdown.

Run ``python -m rcnn_odom.comparison.motion POSES``, POSES being a folder with KITTI's ``00.txt`` and so
on and ``calib_00-02.txt``. Only the sequences that the simulator was made after are read.
"""

import argparse
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import drift
from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray, change_frame, compose, relative_motions
from rcnn_odom.recordings.kitti import read_calibration
from rcnn_odom.recordings.trajectory import read_kitti
from rcnn_odom.simulation.street.city import random_plan, random_warp
from rcnn_odom.simulation.street.drive import random_drive
from rcnn_odom.simulation.street.speed import FRAME_TIME
from rcnn_odom.simulation.street.terrain import flat_ground, stand

SEQUENCES = {"00": 4541, "02": 4661, "03": 801, "04": 271, "06": 1101, "08": 4071, "09": 1591}
"""Frames of KITTI's sequences from which the simulator's motion was learnt."""

STANDING = 0.05
"""Metres a frame below which a car counts as standing."""

TILT_WINDOW = 41
"""Frames: what is slower is the road's slope and not the car's springs."""

REVISIT_DISTANCE, REVISIT_FRAMES = 5.0, 200
SPEED_BINS = (0, 4, 6, 8, 10, 12, 17)


@dataclass(frozen=True)
class Recording:
    """A drive of N frames.

    Attributes:
        poses: (N, 4, 4) of the laser.
        camera_from_laser: (4, 4), for the drift's floor.
    """

    poses: FloatArray
    camera_from_laser: FloatArray


def real_recordings(folder: Path) -> dict[str, Recording]:
    """KITTI's sequences by name.

    Raises:
        InputError: a file is missing or broken.
    """
    camera_from_laser = read_calibration(folder / "calib_00-02.txt")
    laser_from_camera = np.linalg.inv(camera_from_laser)
    return {
        name: Recording(
            change_frame(read_kitti(folder / f"{name}.txt"), laser_from_camera), camera_from_laser
        )
        for name in SEQUENCES
    }


def simulated_recordings(seeds: int, first: int = 0) -> list[Recording]:
    """Drives on level ground of the same numbers of frames, so many for each."""
    recordings = []
    for seed in range(first, first + seeds):
        for frames in SEQUENCES.values():
            rng = np.random.default_rng([seed, frames])
            plan = random_plan(rng)
            drive = random_drive(plan, random_warp(plan, rng), frames, rng)
            level = flat_ground(drive.path.min(0), drive.path.max(0))
            recordings.append(Recording(stand(drive.planar, drive.tilt, 1.7, level), FORWARD_CAMERA))
    return recordings


def statistics(recordings: list[Recording]) -> dict[str, float]:
    """Figures of all frames together, by a name that says the unit."""
    motions = [relative_motions(recording.poses) for recording in recordings]
    distance, turn = np.concatenate(motions).T
    turn_deg = np.rad2deg(turn)
    figures = {
        "path, m": float(np.mean([np.abs(motion[:, 0]).sum() for motion in motions])),
        **_spread("distance, m", distance),
        "frames that stand, %": 100 * float(np.mean(distance < STANDING)),
        **_percentiles(
            "acceleration over 1 s, m/s^2",
            np.concatenate([*map(_acceleration, motions)]),
            (1, 10, 25, 75, 90, 99),
        ),
        **_spread("heading change, deg", turn_deg),
        "abs heading change, mean, deg": float(np.abs(turn_deg).mean()),
        **_percentiles("abs heading change, deg", np.abs(turn_deg), (25, 50, 75, 90)),
    }
    figures["abs heading change, max, deg"] = float(np.abs(turn_deg).max())
    speed = distance / FRAME_TIME
    for low, high in pairwise(SPEED_BINS):
        inside = (speed >= low) & (speed < high)
        figures[f"frames at {low}-{high} m/s, %"] = 100 * float(inside.mean())
        turns = np.abs(turn_deg[inside])
        figures[f"abs heading change at {low}-{high} m/s, 90 %, deg"] = (
            float(np.percentile(turns, 90)) if inside.sum() > 20 else np.nan
        )
    figures |= _sideways(recordings, np.abs(turn_deg) > 1, turn)
    figures |= _tilts(recordings)
    figures["frames near an earlier pass, %"] = 100 * float(
        np.concatenate([*map(_revisits, recordings)]).mean()
    )
    figures["floor of two-number motion, %"] = _floor(recordings, motions)
    return figures


def _percentiles(name: str, values: FloatArray, which: tuple[int, ...]) -> dict[str, float]:
    return {f"{name}, {one} %": float(np.percentile(values, one)) for one in which}


def _spread(name: str, values: FloatArray) -> dict[str, float]:
    return {
        f"{name}, mean": float(values.mean()),
        f"{name}, deviation": float(values.std()),
        **_percentiles(name, values, (1, 50, 99)),
        f"{name}, max": float(values.max()),
    }


def _acceleration(motions: FloatArray) -> FloatArray:
    """Mean over a second, m/s^2."""
    frames = round(1 / FRAME_TIME)
    speed = motions[:, 0] / FRAME_TIME
    change: FloatArray = speed[frames:] - speed[:-frames]
    return change


def _sideways(recordings: list[Recording], turning: FloatArray, turn: FloatArray) -> dict[str, float]:
    """Metres that the laser steps to the left for every radian it turns."""
    left = np.concatenate([(np.linalg.inv(r.poses[:-1]) @ r.poses[1:])[:, 1, 3] for r in recordings])
    if turning.sum() < 20:
        return {"step aside for turn, m": np.nan, "its residual, m": np.nan}
    lever = float(turn[turning] @ left[turning] / (turn[turning] @ turn[turning]))
    return {"step aside for turn, m": lever, "its residual, m": float((left - lever * turn).std())}


def _tilts(recordings: list[Recording]) -> dict[str, float]:
    """Deviation of quick pitch and roll, and of their change a frame, degrees."""
    forward, left_up, up = ([r.poses[:, 2, axis] for r in recordings] for axis in range(3))
    figures = {}
    for name, tilts in (
        ("pitch", [-np.arcsin(one) for one in forward]),
        ("roll", [np.arctan2(a, b) for a, b in zip(left_up, up, strict=True)]),
    ):
        quick = np.concatenate([tilt - _average(tilt) for tilt in tilts])
        change = np.concatenate([np.diff(tilt) for tilt in tilts])
        figures[f"quick {name}, deg"] = float(np.rad2deg(quick.std()))
        figures[f"{name} change a frame, deg"] = float(np.rad2deg(change.std()))
    return figures


def _average(values: FloatArray) -> FloatArray:
    padded = np.pad(values, TILT_WINDOW // 2, mode="edge")
    return np.convolve(padded, np.ones(TILT_WINDOW) / TILT_WINDOW, mode="valid")


def _revisits(recording: Recording) -> FloatArray:
    """1 for each frame (N,) near a place that was passed long before, else 0."""
    places = recording.poses[:, :2, 3]
    earlier = cKDTree(places).query_ball_point(places, REVISIT_DISTANCE)
    first = np.array([min(frames) for frames in earlier])
    near: FloatArray = np.where(np.arange(len(places)) - first >= REVISIT_FRAMES, 1.0, 0.0)
    return near


def _floor(recordings: list[Recording], motions: list[FloatArray]) -> float:
    """Mean drift, in percent, of the exact distances and heading changes once composed."""
    floors = []
    for recording, motion in zip(recordings, motions, strict=True):
        truth, composed = (
            change_frame(poses, recording.camera_from_laser) for poses in (recording.poses, compose(motion))
        )
        floors.append(drift(truth, composed, planar=True).t_err)
    return 100 * float(np.mean([floor for floor in floors if floor is not None]))


def table(columns: dict[str, dict[str, float]]) -> str:
    """Figures by column and row, in Markdown."""
    rows = [["", *columns], ["---", *["---:"] * len(columns)]]
    for name in next(iter(columns.values())):
        values = [figures[name] for figures in columns.values()]
        rows.append(
            [name, *("-" if np.isnan(v) else f"{v:.0f}" if abs(v) >= 100 else f"{v:.2f}" for v in values)]
        )
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("poses", type=Path, help="folder with KITTI's poses and calib_00-02.txt")
    parser.add_argument("--seeds", type=int, default=3, help="simulated drives for each real one")
    arguments = parser.parse_args()
    try:
        real = real_recordings(arguments.poses)
    except InputError as error:
        sys.exit(f"error: {error}")
    columns = {name: statistics([recording]) for name, recording in real.items()}
    columns["KITTI"] = statistics(list(real.values()))
    columns["simulated"] = statistics(simulated_recordings(arguments.seeds))
    print(table(columns))


if __name__ == "__main__":
    main()
