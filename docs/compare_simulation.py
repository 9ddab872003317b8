"""How like the real recordings the simulated drives are, in tables and a picture: docs/simulation.md.

Run ``python docs/compare_simulation.py DATA``. Of KITTI's motion, only the sequences that the
simulator was made after are read. The real scans are one ring of the frames that it was fitted to: sequence
00 of KITTI and frames 0 to 19 of 90, a drive of KITTI's raw data whose frames 20 to 39 are kept for scoring.
Both are streets of a town, so they are compared with the simulator's towns as well as with all of its worlds.
The robots' logs are those whose buildings and ways the indoor world was made after.
"""

import argparse
import sys
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import drift
from rcnn_odom.geometry import FORWARD_CAMERA, FloatArray, change_frame, compose, motions_of, relative_steps
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.two_numbers import restate
from rcnn_odom.recordings import carmen, kitti, simulated
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.trajectory import read_kitti
from rcnn_odom.simulation.street.city import RESIDENTIAL, random_plan, random_warp
from rcnn_odom.simulation.street.drive import random_drive
from rcnn_odom.simulation.street.speed import FRAME_TIME
from rcnn_odom.simulation.terrain import flat_ground, place_on_ground

Figures = dict[str, float]
"""By a name that says the unit; nan where too little is known."""

SEQUENCES = {"00": 4541, "02": 4661, "03": 801, "04": 271, "06": 1101, "08": 4071, "09": 1591}
"""Frames of KITTI's sequences from which the simulator's motion was learnt."""
STANDING = 0.05
"""Metres a frame below which a car counts as standing."""
TILT_WINDOW = 41
"""Frames: what is slower is the road's slope and not the car's springs."""
REVISIT_DISTANCE, REVISIT_FRAMES = 5.0, 200
SPEED_BINS = (0, 4, 6, 8, 10, 12, 17)

SENSOR = Sensor()
ROBOT_SENSOR = Sensor(**simulated.SENSORS["indoor"])
ROBOT_LOGS = ("mit-killian", "intel", "mit-csail")
RUNS = (1, 2, 5, 20, 100, 3600)
"""Edges of the classes of run lengths, in bins of 0.1 degrees."""
REAL_FRAMES = {"00": range(6), "90": range(20)}
DRIVES, DRIVE_FRAMES = 40, 130
"""Simulated drives that are looked at, and how long they are."""


class Driven(NamedTuple):
    """Poses (N, 4, 4) of a car's laser, and camera from laser (4, 4), for the drift's floor."""

    poses: FloatArray
    camera_from_laser: FloatArray


def real_motion(folder: Path) -> dict[str, Driven]:
    """KITTI's sequences by name.

    Raises:
        InputError: a file is missing or broken.
    """
    tr = kitti.read_calibration(folder / "calib_00-02.txt")
    laser_from_camera = np.linalg.inv(tr)
    return {
        name: Driven(change_frame(read_kitti(folder / f"{name}.txt"), laser_from_camera), tr)
        for name in SEQUENCES
    }


def simulated_motion(seeds: int) -> list[Driven]:
    """Drives on level ground of the same numbers of frames, so many for each."""
    drives = []
    for seed in range(seeds):
        for frames in SEQUENCES.values():
            rng = np.random.default_rng([seed, frames])
            plan = random_plan(rng)
            drive = random_drive(plan, random_warp(plan, rng), frames, rng)
            level = flat_ground(drive.path.min(0), drive.path.max(0))
            drives.append(Driven(place_on_ground(drive.planar, drive.tilt, 1.7, level), FORWARD_CAMERA))
    return drives


def motion_figures(drives: list[Driven]) -> Figures:
    """Figures of the motion in all frames together."""
    steps = [relative_steps(drive.poses) for drive in drives]
    motions = [motions_of(some) for some in steps]
    distance, turn = np.concatenate(motions).T
    turned, speed, second = np.abs(np.rad2deg(turn)), distance / FRAME_TIME, round(1 / FRAME_TIME)
    gains = [(some[second:, 0] - some[:-second, 0]) / FRAME_TIME for some in motions]
    figures = {
        "path, m": float(np.mean([np.abs(some[:, 0]).sum() for some in motions])),
        **_spread("distance, m", distance),
        "frames that stand, %": 100 * float(np.mean(distance < STANDING)),
        **_percentiles("acceleration over 1 s, m/s^2", np.concatenate(gains), (1, 10, 25, 75, 90, 99)),
        **_spread("heading change, deg", np.rad2deg(turn)),
        "abs heading change, mean, deg": float(turned.mean()),
        **_percentiles("abs heading change, deg", turned, (25, 50, 75, 90)),
        "abs heading change, max, deg": float(turned.max()),
    }
    for low, high in pairwise(SPEED_BINS):
        inside = (speed >= low) & (speed < high)
        figures[f"frames at {low}-{high} m/s, %"] = 100 * float(inside.mean())
        name = f"abs heading change at {low}-{high} m/s, 90 %, deg"
        figures[name] = float(np.percentile(turned[inside], 90)) if inside.sum() > 20 else np.nan
    figures |= _sideways(np.concatenate(steps)[:, 1], turn) | _tilts(drives)
    revisits = np.concatenate([_revisits(drive.poses[:, :2, 3]) for drive in drives])
    figures["frames near an earlier pass, %"] = 100 * float(revisits.mean())
    floors = []
    for drive, some in zip(drives, steps, strict=True):
        restated = compose(restate(some, "end"))
        paths = (change_frame(poses, drive.camera_from_laser) for poses in (drive.poses, restated))
        floors.append(drift(*paths, planar=True).t_err)
    figures["floor of two-number motion, %"] = 100 * float(
        np.mean([one for one in floors if one is not None])
    )
    return figures


def _percentiles(name: str, values: FloatArray, which: tuple[int, ...]) -> Figures:
    return {f"{name}, {one} %": float(np.percentile(values, one)) for one in which}


def _spread(name: str, values: FloatArray) -> Figures:
    ends = {f"{name}, mean": float(values.mean()), f"{name}, deviation": float(values.std())}
    return ends | _percentiles(name, values, (1, 50, 99)) | {f"{name}, max": float(values.max())}


def _sideways(left: FloatArray, turn: FloatArray) -> Figures:
    """Metres that the laser steps to the left for every radian it turns."""
    turning = np.abs(turn) > np.deg2rad(1)
    lever = np.nan
    if turning.sum() >= 20:
        lever = float(turn[turning] @ left[turning] / (turn[turning] @ turn[turning]))
    return {"step aside for turn, m": lever, "its residual, m": float((left - lever * turn).std())}


def _tilts(drives: list[Driven]) -> Figures:
    """Deviation of quick pitch and roll, and of their change a frame, degrees."""
    figures = {}
    for name, tilts in (
        ("pitch", [-np.arcsin(drive.poses[:, 2, 0]) for drive in drives]),
        ("roll", [np.arctan2(drive.poses[:, 2, 1], drive.poses[:, 2, 2]) for drive in drives]),
    ):
        quick = np.concatenate([tilt - _average(tilt) for tilt in tilts])
        figures[f"quick {name}, deg"] = float(np.rad2deg(quick.std()))
        change = np.concatenate([np.diff(tilt) for tilt in tilts])
        figures[f"{name} change a frame, deg"] = float(np.rad2deg(change.std()))
    return figures


def _average(values: FloatArray) -> FloatArray:
    padded = np.pad(values, TILT_WINDOW // 2, mode="edge")
    return np.convolve(padded, np.ones(TILT_WINDOW) / TILT_WINDOW, mode="valid")


def _revisits(places: FloatArray) -> npt.NDArray[np.bool_]:
    """Which of the frames (N,) are near a place (N, 2) that was passed long before."""
    earlier = cKDTree(places).query_ball_point(places, REVISIT_DISTANCE)
    return np.arange(len(places)) - np.array([min(frames) for frames in earlier]) >= REVISIT_FRAMES


def scan_figures(scans: Iterable[npt.NDArray[np.float32]]) -> Figures:
    """Figures of depth vectors (bins,), each the mean over the scans.

    Returns:
        ``filled``: share of bins with a return. ``range p10`` to ``p90``: percentiles in metres.
        ``empty in runs of ...``: share of all bins that lie in an empty run of that length.
        ``jumps``: share of neighbouring returns more than 0.5 m apart.
    """
    rows = []
    for scan in scans:
        circle = scan[:-1]
        lengths = empty_runs(circle > 0)
        runs = {
            f"empty in runs of {low}-{high - 1}": float(
                lengths[(lengths >= low) & (lengths < high)].sum() / len(circle)
            )
            for low, high in pairwise(RUNS)
        }
        rows.append(_depth_figures(circle) | runs | _jumps(circle, (0.5, 3)))
    return _mean(rows)


def _depth_figures(scan: npt.NDArray[np.float32]) -> Figures:
    """What any laser's depth vector (bins,) has."""
    depth, percentiles = scan[scan > 0], (10, 25, 50, 75, 90)
    ranges = {f"range p{one} (m)": float(np.percentile(depth, one)) for one in percentiles}
    return {"filled": len(depth) / len(scan)} | ranges


def _jumps(scan: npt.NDArray[np.float32], metres: tuple[float, ...]) -> Figures:
    apart = np.abs(np.diff(scan[scan > 0]))
    return {f"jumps > {one} m": float((apart > one).mean()) for one in metres}


def empty_runs(back: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """Lengths of the runs of bins (bins,) without a return, round the circle."""
    if back.all():
        return np.zeros(0, dtype=np.int64)
    first = int(np.argmax(back))
    edges = np.flatnonzero(np.diff(np.concatenate([[1], np.roll(back, -first).astype(np.int8), [1]])))
    return np.diff(edges)[::2]


def change_figures(recording: Recording, frames: Iterable[int]) -> Figures:
    """How scans differ from the one before, once the true motion between them is undone.

    Args:
        recording: with its truth.
        frames: of the earlier scans.

    Returns:
        Percentiles of the absolute difference of bins filled in both, and the share of the earlier
        scan's bins that are empty in the later one although motion should have filled them.
    """
    differences, vanished = [], []
    for frame in frames:
        moved = SENSOR.encode(Scan.from_points(_seen_from_next(recording, frame)))[:-1]
        after = SENSOR.encode(recording.read_scan(frame + 1))[:-1]
        both = (moved > 0) & (after > 0)
        differences.append(np.abs(moved - after)[both])
        wide = np.convolve(np.concatenate([after[-2:], after, after[:2]]) > 0, np.ones(5), "valid") > 0
        vanished.append(1 - wide[moved > 0].mean())
    apart = np.concatenate(differences)
    return {
        **{f"change p{p} (m)": float(np.percentile(apart, p)) for p in (25, 50, 75, 90)},
        "changed > 0.5 m": float((apart > 0.5).mean()),
        "vanished": float(np.mean(vanished)),
    }


def _points(scan: Scan) -> FloatArray:
    """x and y in metres, (P, 2)."""
    assert scan.bearings is not None
    return scan.ranges[:, None] * np.column_stack([np.cos(scan.bearings), np.sin(scan.bearings)])


def _seen_from_next(recording: Recording, frame: int) -> FloatArray:
    """A scan's points (P, 2) in the frame of the next scan."""
    step = np.linalg.inv(recording.poses[frame + 1]) @ recording.poses[frame]
    return _points(recording.read_scan(frame)) @ step[:2, :2].T + step[:2, 3]


def _all_figures(recording: Recording, frames: Iterable[int]) -> Figures:
    """Of scans of one recording and the changes between them and their next ones."""
    scans = [SENSOR.encode(recording.read_scan(frame)) for frame in frames]
    return scan_figures(scans) | change_figures(recording, frames)


def real_figures(root: Path) -> dict[str, Figures]:
    """Figures of the real scans by the name of their sequence; the last frame only ends a change."""
    return {
        name: _all_figures(kitti.load(name, root=root), frames[:-1]) for name, frames in REAL_FRAMES.items()
    }


def simulated_figures(drives: int = DRIVES, every: int = 13) -> tuple[Figures, Figures]:
    """Mean figures of some simulated drives: of those in towns, and of all."""
    made = [_calibration_drive(number) for number in range(drives)]
    rows = [_all_figures(drive, range(0, DRIVE_FRAMES - 1, every)) for drive in made]
    in_town = [simulated.roads_of(drive) == RESIDENTIAL for drive in made]
    return _mean([row for row, town in zip(rows, in_town, strict=True) if town]), _mean(rows)


def _calibration_drive(number: int) -> Recording:
    return simulated.load(f"calibration {number}", frames=DRIVE_FRAMES)


def _mean(rows: list[Figures]) -> Figures:
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def robot_figures(recording: Recording, every: int) -> Figures:
    """Figures of a robot's drive in a building: of its motion, and of every so many scans."""
    motions = np.abs(motions_of(relative_steps(recording.poses)))
    distance, turn = motions[np.isfinite(motions[:, 0])].T  # elsewhere the truth is unknown
    scans = [ROBOT_SENSOR.encode(recording.read_scan(frame)) for frame in range(0, len(recording), every)]
    return {
        "distance a scan, mean (m)": float(distance.mean()),
        "heading change a scan, mean (deg)": float(np.rad2deg(turn).mean()),
        "heading change a scan, p99 (deg)": float(np.rad2deg(np.percentile(turn, 99))),
        "standing": float(((distance < 0.01) & (turn < np.deg2rad(0.2))).mean()),
        **_mean([_depth_figures(scan) | _jumps(scan, (0.1, 0.5, 3)) for scan in scans]),
    }


def _robot_columns(root: Path) -> dict[str, Figures]:
    """Figures of the logs that the buildings were made after, and of simulated drives."""
    columns = {}
    for name in ROBOT_LOGS:
        log = carmen.load(name, root=root, reference=root / "reference", max_range=ROBOT_SENSOR.max_range)
        columns[name] = robot_figures(log, every=50)
    made = [simulated.load(f"calibration {n}", world="indoor", frames=400) for n in range(DRIVES)]
    return columns | {"simulated": _mean([robot_figures(drive, every=40) for drive in made])}


def table(columns: Mapping[str, Figures], digits: int) -> str:
    """Figures by column and row, in Markdown."""
    rows = [["", *columns], ["---", *["---:"] * len(columns)]]
    for name in next(iter(columns.values())):
        values = [figures[name] for figures in columns.values()]
        texts = ("-" if np.isnan(v) else f"{v:.0f}" if abs(v) >= 100 else f"{v:.{digits}f}" for v in values)
        rows.append([name, *texts])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def _save_overlay(root: Path, path: Path) -> None:
    """Scans on top of the ones before, moved by the true motion: three real ones, three simulated ones."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(18, 10), layout="constrained")
    real = [(kitti.load(name, root=root), frame) for name, frame in (("00", 2), ("90", 4), ("90", 16))]
    made = [(_calibration_drive(number), 60) for number in (0, 3, 5)]
    kinds = ["KITTI"] * 3 + ["simulated"] * 3
    for axis, kind, (recording, frame) in zip(axes.flat, kinds, real + made, strict=True):
        before, after = _seen_from_next(recording, frame - 1), _points(recording.read_scan(frame))
        axis.plot(*before.T, ".", ms=3, color="tab:orange", label="the scan before, moved")
        axis.plot(*after.T, ".", ms=1.5, color="black", label="a scan")
        axis.set(title=f"{kind}: {recording.name}, frame {frame}", xlabel="m", ylabel="m")
        axis.set(xlim=(-60, 60), ylim=(-40, 40), aspect="equal")
    axes[0, 0].legend(loc="lower right")
    figure.savefig(path, dpi=60)


def main() -> None:
    """Prints the tables of motion, of scans in streets and of robots; draws scans if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with kitti_gt_poses/, kitti/ (00 and 90) and carmen/")
    parser.add_argument("--seeds", type=int, default=3, help="simulated drives for each real one's motion")
    parser.add_argument("--overlay", type=Path, metavar="FILE.png", help="draw scans here")
    arguments = parser.parse_args()
    data = arguments.data
    try:
        real = real_motion(data / "kitti_gt_poses")
        motion = {name: motion_figures([drive]) for name, drive in real.items()}
        motion["KITTI"] = motion_figures(list(real.values()))
        motion["simulated"] = motion_figures(simulated_motion(arguments.seeds))
        print(table(motion, digits=2), end="\n\n")
        scans = {f"real {name}": figures for name, figures in real_figures(data / "kitti").items()}
        scans["simulated towns"], scans["all simulated"] = simulated_figures()
        print(table(scans, digits=3), end="\n\n")
        print(table(_robot_columns(data / "carmen"), digits=3))
        if arguments.overlay:
            _save_overlay(data / "kitti", arguments.overlay)
    except InputError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
