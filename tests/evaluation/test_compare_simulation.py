"""The simulated scans stay as like the real ones as they were made."""

import numpy as np
import pytest
from compare_simulation import (
    change_figures,
    empty_runs,
    real_figures,
    scan_figures,
    simulated_figures,
)

from conftest import SHARED
from rcnn_odom.geometry import planar_to_poses
from rcnn_odom.recordings.recording import Recording
from rcnn_odom.recordings.scan import Scan

KITTI = SHARED / "data" / "kitti"

TOLERANCES = {
    "filled": 1.1,
    "range p10 (m)": 1.2,
    "range p25 (m)": 1.2,
    "range p50 (m)": 1.2,
    "range p75 (m)": 1.2,
    "range p90 (m)": 1.2,
    "empty in runs of 1-1": 1.1,
    "empty in runs of 2-4": 1.5,
    "empty in runs of 5-19": 1.7,
    "empty in runs of 20-99": 1.7,
    "jumps > 0.5 m": 1.4,
    "jumps > 3 m": 1.5,
}
"""By what factor the simulated towns may leave the span of the two real recordings. Runs of 100 bins or more
have no factor, since one recording has none of them: the towns lie between the two."""


def test_runs_go_round_the_circle() -> None:
    back = np.array([False, True, False, False, True, True, False, False, False])
    assert sorted(empty_runs(back)) == [2, 4]
    assert empty_runs(np.ones(9, dtype=bool)).size == 0


def test_figures_of_a_scan_made_by_hand() -> None:
    scan = np.zeros(3601, dtype=np.float32)
    scan[0:1800:2] = 10.0
    scan[1800:3600] = np.where(np.arange(1800) % 3 == 0, 20.0, 24.0)
    found = scan_figures([scan])
    assert found["filled"] == pytest.approx(0.75)
    assert found["empty in runs of 1-1"] == pytest.approx(0.25)
    assert found["range p25 (m)"] == 10.0
    # 1,800 returns alternate 20 24 24, so that 1,199 of their 1,799 steps jump; one step leads there.
    assert found["jumps > 3 m"] == pytest.approx(1200 / 2699)


def test_undone_motion_leaves_nothing_of_a_still_world() -> None:
    """A laser that turns by whole bins in the middle of a round room, then one that says it did not move."""
    turn = np.deg2rad(10.0)
    angles = np.deg2rad(np.arange(-1800, 1800) * 0.1)
    ranges = 20 + 5 * np.sin(3 * angles)

    def read_scan(frame: int) -> Scan:
        return Scan(ranges, angles - frame * turn)

    def sequence(turns: list[float]) -> Recording:
        poses = planar_to_poses([(0, 0, heading) for heading in turns])
        return Recording("round", poses, np.arange(2.0), read_scan, "")

    right = change_figures(sequence([0, turn]), [0])
    wrong = change_figures(sequence([0, 0]), [0])
    assert right["change p90 (m)"] < 0.03
    assert right["vanished"] == 0
    assert wrong["change p50 (m)"] > 1


@pytest.mark.slow
def test_simulated_towns_look_like_the_real_ones() -> None:
    if not KITTI.is_dir():
        pytest.skip(f"no real recordings in {KITTI}")
    real = real_figures(KITTI).values()
    towns, _ = simulated_figures(drives=24, every=26)
    for key, factor in TOLERANCES.items():
        low, high = min(r[key] for r in real), max(r[key] for r in real)
        assert low / factor < towns[key] < high * factor, (key, low, towns[key], high)
    long_runs = max(r["empty in runs of 100-3599"] for r in real)
    assert 0.2 * long_runs < towns["empty in runs of 100-3599"] < long_runs


@pytest.mark.slow
def test_simulated_scans_change_like_the_real_ones() -> None:
    """Only 90's truth can be trusted; it jitters by some centimetres, which the changes contain."""
    if not KITTI.is_dir():
        pytest.skip(f"no real recordings in {KITTI}")
    real = real_figures(KITTI)["90"]
    towns, _ = simulated_figures(drives=24, every=26)
    for key in ("change p25 (m)", "change p50 (m)", "change p75 (m)", "changed > 0.5 m"):
        assert real[key] / 2 < towns[key] < 1.5 * real[key], (key, towns[key], real[key])
    assert towns["change p90 (m)"] < 2 * real["change p90 (m)"]
    # One scan in a hundred more: the simulated laser loses single shots where 90's seems not to (00's does).
    assert towns["vanished"] < real["vanished"] + 0.015
