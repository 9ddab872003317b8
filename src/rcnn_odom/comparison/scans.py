"""Real and simulated scans side by side: ``python -m rcnn_odom.comparison.scans DATA``.

The real scans are one ring of the frames that the simulator was fitted to: sequence 00 of KITTI and frames 0
to 19 of 90, a drive of KITTI's raw data whose frames 20 to 39 are kept for scoring. Both are streets of a
town, so they are compared with the simulator's towns as well as with all of its worlds. The robots' logs are
those whose buildings and ways the indoor world was made after.
"""

import argparse
import sys
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import relative_motions
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.recordings import carmen, kitti, simulated
from rcnn_odom.recordings.recording import Sequence
from rcnn_odom.simulation.street.city import RESIDENTIAL

SENSOR = Sensor()
ROBOT_SENSOR = Sensor(**simulated.SENSORS["indoor"])
ROBOT_LOGS = ("mit-killian", "intel", "mit-csail")
RUNS = (1, 2, 5, 20, 100, 3600)
"""Edges of the classes of run lengths, in bins of 0.1 degrees."""
REAL_FRAMES = {"00": range(6), "90": range(20)}
DRIVES, DRIVE_FRAMES = 40, 130
"""Simulated drives that are looked at, and how long they are."""


def scan_figures(scans: Iterable[np.ndarray]) -> dict[str, float]:
    """Figures of depth vectors (bins,), each the mean over the scans.

    Returns:
        ``filled``: share of bins with a return. ``range p10`` to ``p90``: percentiles in metres.
        ``empty in runs of ...``: share of all bins that lie in an empty run of that length.
        ``jumps``: share of neighbouring returns more than 0.5 m apart.
    """
    rows = []
    for scan in scans:
        circle = scan[:-1]
        row, depth = _depth_figures(circle)
        lengths = empty_runs(circle > 0)
        for low, high in pairwise(RUNS):
            inside = lengths[(lengths >= low) & (lengths < high)]
            row[f"empty in runs of {low}-{high - 1}"] = inside.sum() / len(circle)
        row["jumps > 0.5 m"] = (np.abs(np.diff(depth)) > 0.5).mean()
        row["jumps > 3 m"] = (np.abs(np.diff(depth)) > 3).mean()
        rows.append(row)
    return _mean(rows)


def _depth_figures(scan: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
    """What any laser's depth vector (bins,) has, and the depths of its returns."""
    depth = scan[scan > 0]
    row = {"filled": len(depth) / len(scan)}
    for percentile in (10, 25, 50, 75, 90):
        row[f"range p{percentile} (m)"] = float(np.percentile(depth, percentile))
    return row, depth


def empty_runs(back: np.ndarray) -> np.ndarray:
    """Lengths of the runs of bins (bins,) without a return, round the circle."""
    if back.all():
        return np.zeros(0, dtype=np.int64)
    first = int(np.argmax(back))
    edges = np.flatnonzero(np.diff(np.concatenate([[1], np.roll(back, -first).astype(np.int8), [1]])))
    return np.diff(edges)[::2]


def change_figures(sequence: Sequence, frames: Iterable[int]) -> dict[str, float]:
    """How scans differ from the one before, once the true motion between them is undone.

    Args:
        sequence: with its truth.
        frames: of the earlier scans.

    Returns:
        Percentiles of the absolute difference of bins filled in both, and the share of the earlier
        scan's bins that are empty in the later one although motion should have filled them.
    """
    differences, vanished = [], []
    for frame in frames:
        step = np.linalg.inv(sequence.poses[frame + 1]) @ sequence.poses[frame]
        angles, ranges = sequence.read_scan(frame)
        x, y = (
            step[:2, :2] @ np.stack([ranges * np.cos(angles), ranges * np.sin(angles)]) + step[:2, 3][:, None]
        )
        moved = encode(np.arctan2(y, x), np.hypot(x, y), SENSOR)[:-1]
        after = encode(*sequence.read_scan(frame + 1), SENSOR)[:-1]
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


def figures(sequence: Sequence, frames: Iterable[int]) -> dict[str, float]:
    """Both kinds of figures, for scans of one sequence and the changes between them and their next ones."""
    frames = list(frames)
    scans = [encode(*sequence.read_scan(frame), SENSOR) for frame in frames]
    return {**scan_figures(scans), **change_figures(sequence, [f for f in frames if f + 1 < len(sequence)])}


def real_figures(root: Path) -> dict[str, dict[str, float]]:
    """Figures of the real scans by the name of their sequence; the last frame only ends a change."""
    return {name: figures(kitti.load(name, root=root), frames[:-1]) for name, frames in REAL_FRAMES.items()}


def simulated_figures(drives: int = DRIVES, every: int = 13) -> tuple[dict, dict]:
    """Mean figures of some simulated drives: of those in towns, and of all."""
    towns, all_of_them = [], []
    for number in range(drives):
        drive = simulated.load(f"calibration {number}", frames=DRIVE_FRAMES)
        all_of_them.append(figures(drive, range(0, DRIVE_FRAMES - 1, every)))
        if simulated.roads_of(drive) == RESIDENTIAL:
            towns.append(all_of_them[-1])
    return _mean(towns), _mean(all_of_them)


def _mean(rows: list[dict[str, float]]) -> dict[str, float]:
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def _save_overlay(root: Path, path: Path) -> None:
    """Scans on top of the ones before, moved by the true motion: three real ones, three simulated ones."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(18, 10), layout="constrained")
    real = [(kitti.load(name, root=root), frame) for name, frame in (("00", 2), ("90", 4), ("90", 16))]
    made = [(simulated.load(f"calibration {number}", frames=DRIVE_FRAMES), 60) for number in (0, 3, 5)]
    for row, kind, shown in zip(axes, ("KITTI", "simulated"), (real, made), strict=True):
        for axis, (sequence, frame) in zip(row, shown, strict=True):
            step = np.linalg.inv(sequence.poses[frame]) @ sequence.poses[frame - 1]
            before, after = (
                np.stack([ranges * np.cos(angles), ranges * np.sin(angles)])
                for angles, ranges in (sequence.read_scan(frame - 1), sequence.read_scan(frame))
            )
            before = step[:2, :2] @ before + step[:2, 3][:, None]
            axis.plot(*before, ".", ms=3, color="tab:orange", label="the scan before, moved")
            axis.plot(*after, ".", ms=1.5, color="black", label="a scan")
            axis.set(title=f"{kind}: {sequence.name}, frame {frame}", xlabel="m", ylabel="m")
            axis.set(xlim=(-60, 60), ylim=(-40, 40), aspect="equal")
    axes[0, 0].legend(loc="lower right")
    figure.savefig(path, dpi=60)


def indoor_figures(sequence: Sequence, every: int) -> dict[str, float]:
    """Figures of a robot's drive in a building: of its motion, and of every so many scans."""
    distance, turn = _known_motions(sequence)
    rows = []
    for frame in range(0, len(sequence), every):
        row, depth = _depth_figures(encode(*sequence.read_scan(frame), ROBOT_SENSOR))
        jumps = np.abs(np.diff(depth))
        rows.append(row | {f"jumps > {step} m": float((jumps > step).mean()) for step in (0.1, 0.5, 3)})
    return {
        "distance a scan, mean (m)": float(np.abs(distance).mean()),
        "heading change a scan, mean (deg)": float(np.rad2deg(turn).mean()),
        "heading change a scan, p99 (deg)": float(np.rad2deg(np.percentile(turn, 99))),
        "standing": float(((np.abs(distance) < 0.01) & (turn < np.deg2rad(0.2))).mean()),
        **_mean(rows),
    }


def _known_motions(sequence: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Distances in metres and absolute heading changes in radians where the truth is known."""
    distance, turn = relative_motions(sequence.poses).T
    known = np.isfinite(distance)
    return distance[known], np.abs(turn[known])


def _indoor_columns(root: Path) -> dict[str, dict[str, float]]:
    """Figures of the logs that the buildings were made after, and of simulated drives."""
    columns = {}
    for name in ROBOT_LOGS:
        log = carmen.load(name, root=root, reference=root / "reference", max_range=ROBOT_SENSOR.max_range)
        columns[name] = indoor_figures(log, every=50)
    made = [simulated.load(f"calibration {n}", world="indoor", frames=400) for n in range(DRIVES)]
    return columns | {"simulated": _mean([indoor_figures(drive, every=40) for drive in made])}


def _print_table(columns: dict[str, dict[str, float]]) -> None:
    print(f"| | {' | '.join(columns)} |\n| --- |{' ---: |' * len(columns)}")
    for key in next(iter(columns.values())):
        print(f"| {key} | {' | '.join(f'{column[key]:.3f}' for column in columns.values())} |")


def main() -> None:
    """Prints tables of real and simulated figures; draws the scans if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with kitti/ (sequences 00 and 90) and carmen/ (logs)")
    parser.add_argument("--overlay", type=Path, metavar="FILE.png", help="draw scans here")
    arguments = parser.parse_args()
    try:
        real = real_figures(arguments.data / "kitti")
        towns, everything = simulated_figures()
        columns = {f"real {name}": figures for name, figures in real.items()}
        _print_table(columns | {"simulated towns": towns, "all simulated": everything})
        print()
        _print_table(_indoor_columns(arguments.data / "carmen"))
        if arguments.overlay:
            _save_overlay(arguments.data / "kitti", arguments.overlay)
    except InputError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
