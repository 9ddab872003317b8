"""Real and simulated scans side by side: ``python -m rcnn_odom.simulation.calibration KITTI_ROOT``.

The real scans are one ring of the frames that the simulator was fitted to: sequence 00 of KITTI and frames 0
to 19 of 90, a drive of KITTI's raw data whose frames 20 to 39 are kept for scoring. Both are streets of a
town, so they are compared with the simulator's towns as well as with all of its worlds.
"""

import argparse
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import numpy as np

from rcnn_odom.datasets import kitti, simulated
from rcnn_odom.datasets.sequence import Sequence
from rcnn_odom.scan import Sensor, encode
from rcnn_odom.simulation.city import RESIDENTIAL

SENSOR = Sensor()
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
        back = circle > 0
        depth = circle[back]
        row = {"filled": back.mean()}
        for percentile in (10, 25, 50, 75, 90):
            row[f"range p{percentile} (m)"] = np.percentile(depth, percentile)
        lengths = empty_runs(back)
        for low, high in pairwise(RUNS):
            inside = lengths[(lengths >= low) & (lengths < high)]
            row[f"empty in runs of {low}-{high - 1}"] = inside.sum() / len(circle)
        row["jumps > 0.5 m"] = (np.abs(np.diff(depth)) > 0.5).mean()
        row["jumps > 3 m"] = (np.abs(np.diff(depth)) > 3).mean()
        rows.append(row)
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


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


def main() -> None:
    """Prints the table, and saves the overlay of real and simulated scans if asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("root", type=Path, help="folder with KITTI's sequences/ and poses/ of 00 and 90")
    parser.add_argument("--overlay", type=Path, metavar="FILE.png", help="draw scans here")
    arguments = parser.parse_args()
    columns = list(real_figures(arguments.root).values()) + list(simulated_figures())
    print("| | real 00 | real 90 | simulated towns | all simulated |\n| --- | --- | --- | --- | --- |")
    for key in columns[0]:
        print(f"| {key} | " + " | ".join(f"{column[key]:.3f}" for column in columns) + " |")
    if arguments.overlay:
        _save_overlay(arguments.root, arguments.overlay)


if __name__ == "__main__":
    main()
