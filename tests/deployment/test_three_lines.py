"""The three lines of a run, of summaries that are written down here."""

import math
from pathlib import Path

import pytest

from rcnn_odom.deployment.three_lines import format_lines, three_lines


def summary_of(**changes):
    summary = {
        "laser_pose": None,
        "scans": 1000,
        "path_m": 128.06,
        "skipped": {},
        "latency": {"median_ms": 0.5512, "p99_ms": 1.0, "max_ms": 2.0},
        "end": {"x": -3.0, "y": 4.0, "heading": 2 * math.pi + math.pi / 2},
        "recording_s": 100.0,
        "speed": {"mean_m_s": 1.2806, "top_m_s": 2.5},
        "marked": {},
    }
    return summary | changes


def stretch(first, last, scans=1, rate=10):
    times = (None, None) if rate is None else (first / rate, last / rate)
    return {"from_s": times[0], "to_s": times[1], "first_scan": first, "last_scan": last, "scans": scans}


def test_a_run_without_trouble():
    assert format_lines(summary_of(), Path("my runs") / "report.html").splitlines() == [
        "path     1000 scans, 128.1 m driven; ended 5.0 m from the start (3.0 m behind, 4.0 m left), turned "
        "90 degrees left",
        "speed    0.55 ms a scan, 180 times as fast as the recording (without reading it); the robot drove "
        "1.28 m/s on average, 2.50 m/s at most",
        "trouble  none; look at 'my runs/report.html'",
    ]
    assert format_lines(summary_of()).endswith("trouble  none")


@pytest.mark.parametrize(
    ("heading", "words"),
    [
        (0.001, "not turned"),
        (-math.pi / 3, "turned 60 degrees right"),
        (math.radians(1.2), "turned 1 degree left"),
    ],
)
def test_which_way_it_has_turned(heading, words):
    path = three_lines(summary_of(end={"x": 1.0, "y": -0.5, "heading": heading}))["path"]
    assert path.endswith(f"ended 1.1 m from the start (1.0 m ahead, 0.5 m right), {words}")


def test_poses_of_the_robot_are_told_as_such():
    assert "128.1 m driven by the robot" in three_lines(summary_of(laser_pose=(1, 0, 0)))["path"]


def test_without_stamps_no_speed_is_told():
    marked = {"held": [stretch(3, 3, rate=None), stretch(20, 24, 5, rate=None)]}
    lines = three_lines(summary_of(recording_s=None, speed=None, marked=marked))
    assert lines["speed"] == "0.55 ms a scan; the scans have no time stamps, so the speed is unknown"
    assert lines["trouble"] == "held: 6 scans, scan 3, scans 20 to 24"


def test_trouble_is_told_by_cause_and_stays_short():
    causes = ("no returns", "held", "gap", "poor match", "ambiguous")
    marked = {
        cause: [stretch(312, 324, 12), stretch(400, 400), *[stretch(500, 501, 2)] * 20] for cause in causes
    }
    skipped = {"lines that are no scan": 6}
    trouble = three_lines(summary_of(marked=marked, skipped=skipped, stopped="it broke off"))["trouble"]
    one = "53 scans, from 31.2 s to 32.4 s, at 40.0 s, ..."
    assert trouble == (
        f"no returns: {one}; held: {one}; gap: {one}; 2 more causes; skipped: 6 lines that are no scan; "
        "stopped: it broke off"
    )


def test_one_scan_is_one_scan():
    assert three_lines(summary_of(marked={"gap": [stretch(5, 5)]}))["trouble"] == "gap: 1 scan, at 0.5 s"


def test_slow_computers_are_told_without_exponents():
    times = {"median_ms": 149.06, "p99_ms": 170.0, "max_ms": 200.0}
    assert "150 ms a scan, 0.67 times as fast" in three_lines(summary_of(latency=times))["speed"]
