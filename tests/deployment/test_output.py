"""What outputs have in common: where they may write, times, remarks, local maps; and their place in a run."""

import json
import os
import subprocess
import sys
import tomllib
from dataclasses import replace
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from conftest import ROOT
from matching.rooms import BOX, cast, circle
from outputs import Ahead, breaks_off, room_scans, stream_of
from rcnn_odom.cli import main
from rcnn_odom.deployment import rerun_log
from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.deployment.output import LocalMaps, OutputFile, Remarks, Stamps, thin_points
from rcnn_odom.deployment.rerun_log import RerunFile
from rcnn_odom.deployment.run import run
from rcnn_odom.errors import InputError
from rcnn_odom.recordings.scan import Scan


@pytest.mark.parametrize(
    ("option", "name", "message"),
    [
        ("--mcap", "out.bag", "out.bag: does not end in .mcap; choose another --mcap"),
        ("--mcap", "out", "out: does not end in .mcap; choose another --mcap"),
        ("--mcap", "there.mcap", "there.mcap: exists already; choose another --mcap"),
        ("--mcap", "link.mcap", "link.mcap: exists already; choose another --mcap"),
        (
            "--mcap",
            "there.mcap/x.mcap",
            "there.mcap/x.mcap: cannot be written (Not a directory); choose another --mcap",
        ),
        (
            "--mcap",
            "there.mcap/new/x.mcap",
            "there.mcap/new/x.mcap: cannot be written (Not a directory); choose another --mcap",
        ),
        (
            "--mcap",
            "locked/new/x.mcap",
            "locked/new/x.mcap: cannot be written (Permission denied); choose another --mcap",
        ),
    ],
)
def test_what_cannot_be_written_is_one_line_before_anything_is_read(
    option, name, message, monkeypatch, tmp_path, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.mcap").write_text("mine")
    (tmp_path / "link.mcap").symlink_to("nowhere")
    (tmp_path / "locked").mkdir()
    # Whoever runs the tests may be allowed everything.
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: str(path) != "locked" and access(path, mode))
    before = sorted(tmp_path.rglob("*"))
    assert main(["run", "no such recording", option, name]) == 1
    assert capsys.readouterr().err == f"rcnn-odom: error: {message}\n"
    assert sorted(tmp_path.rglob("*")) == before
    assert (tmp_path / "there.mcap").read_text() == "mine"


def test_a_folder_that_cannot_be_made_after_all(tmp_path, monkeypatch):
    file = OutputFile(tmp_path / "new" / "out.mcap", "--mcap", ".mcap")
    (tmp_path / "new").write_text("meanwhile")
    with pytest.raises(InputError, match=r"out.mcap: cannot be written \(.*\); choose another --mcap"):
        file.make_folder()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rerun", "out.rrd"], "--rerun and --view need rerun, which is not installed"),
        (["--view"], "--rerun and --view need rerun, which is not installed"),
    ],
)
def test_without_rerun_it_says_how_to_get_it(arguments, message, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["run", "no such recording", *arguments]) == 1
    refusal = capsys.readouterr().err
    assert message in refusal
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    [requirement] = project["optional-dependencies"]["view"]
    assert refusal.endswith(f": pip install 'rcnn-odom[view]', or pip install '{requirement}'\n")
    assert refusal.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("installed", "named"),
    [
        (["rcnn-odom-robot"], "rcnn-odom-robot"),
        (["rcnn-odom", "rcnn-odom-robot"], "rcnn-odom"),
        ([], "rcnn-odom"),
    ],
)
def test_the_extra_is_that_of_the_installed_distribution(installed, named, monkeypatch):
    def distribution(name):
        if name not in installed:
            raise PackageNotFoundError(name)
        return SimpleNamespace(metadata={"Name": name})

    monkeypatch.setattr(rerun_log, "distribution", distribution)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=rf": pip install '{named}\[view\]', or pip install 'rerun-sdk"):
        RerunFile(Path("out.rrd"))
    folder = {"rcnn-odom": ".", "rcnn-odom-robot": "robot"}[named]
    project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["name"] == named
    assert project["optional-dependencies"]["view"] == [rerun_log.REQUIREMENT]


def test_something_must_take_the_poses(capsys):
    with pytest.raises(SystemExit):
        main(["run", "a"])
    assert "--out DIR is needed, or --mcap, --rerun or --view" in capsys.readouterr().err


def test_stamps_are_those_of_the_recording_or_a_period_apart():
    stamps = Stamps(float("nan"))
    given = [None, 5.0, None, float("nan"), 0.0, -3.0, 1e18, 4.0]
    expected = [0.1, 5.0, 5.1, 5.2, 5.3, 5.4, 5.5, 4.0]
    got = [(stamps.next(stamp), stamps.is_recorded) for stamp in given]
    np.testing.assert_allclose([seconds for seconds, _ in got], expected)
    assert [number for number, (_, is_recorded) in enumerate(got) if is_recorded] == [1, 7]
    assert Stamps(0.05).period == 0.05
    for given, expected in (([0.0, 0.104, 0.207], [0.0, 0.104, 0.207]), ([0.0, 0.0, 0.0], [0.0, 0.1, 0.2])):
        stamps = Stamps(float("nan"))
        np.testing.assert_allclose([stamps.next(stamp) for stamp in given], expected)


def test_a_stretch_is_told_at_its_beginning_and_at_its_end():
    remarks, told = Remarks(), []
    degraded = ["", *["held: the motion at 5 degrees"] * 3, "", "held: again; gap: 3 periods", *[""] * 11]
    for number, words in enumerate(degraded, start=1):
        told += [(number, each.text, each.is_warning) for each in remarks.add(words)]
    assert told == [
        (2, "held: the motion at 5 degrees", True),
        (6, "gap: 3 periods", True),
        (17, "held: over, 4 scans marked from scan 2 to scan 6", False),
        (17, "gap: over, 1 scan marked from scan 6 to scan 6", False),
    ]


def distance_to_walls(points, walls):
    """Metres (P,) from points to the nearest of walls (W, 4), by projecting on each."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    share = ((points[:, None] - start) * along).sum(2) / (along**2).sum(1)
    nearest = start + np.clip(share, 0, 1)[..., None] * along
    return np.linalg.norm(points[:, None] - nearest, axis=2).min(1)


@pytest.mark.parametrize("laser_pose", [None, (0.3, -0.2, np.pi / 2)])
def test_the_matchers_map_lies_on_the_walls_as_the_first_pose_sees_them(laser_pose):
    odometer, bearings = Odometer(laser_pose=laser_pose), circle()
    for number in range(15):
        odometer.step(Scan(cast((0.1 * number, 0.0, 0.02 * number), bearings), bearings, stamp=0.1 * number))
    points = odometer.local_map()
    assert len(points) > 50
    if laser_pose:  # into the frame of the first scan: a quarter turn back
        moved = points - np.array(laser_pose[:2])
        points = np.stack([moved[:, 1], -moved[:, 0]], axis=1)
    away = distance_to_walls(points, BOX)
    assert np.percentile(away, 90) < 0.01
    assert away.max() < 0.1, "in a corner a cell has the mean of two walls"


def test_a_model_without_a_map_has_the_returns_of_recent_scans():
    odometer = Odometer(Ahead())
    maps, found = LocalMaps(odometer), []
    for scan in room_scans(151, spacing_deg=0.25):
        odometer.step(scan)
        found.append(maps.add())
    assert [number for number, points in enumerate(found) if points is not None] == [0, 50, 100, 150]
    assert len(found[0]) == 480, "every third of 1440"
    assert [len(found[number]) for number in (50, 100, 150)] == [11 * 480, 20 * 480, 20 * 480]
    np.testing.assert_allclose(found[150][-480:], odometer.returns()[::3])
    assert odometer.local_map() is None


class Listener:
    """An output of somebody else."""

    def __init__(self):
        self.heard = []

    def open(self, stream, odometer):
        self.heard.append(("open", stream.name, odometer.has_seen))

    def add(self, pose, scan):
        self.heard.append((pose.x, scan.stamp))

    def finish(self, keep):
        self.heard.append(("finish", keep))


def test_another_output_is_one_more_class(tmp_path):
    scans, first, second = room_scans(4), Listener(), Listener()
    run(Odometer(Ahead()), stream_of(scans), "ahead", tmp_path / "out", outputs=[first, second])
    steps = [json.loads(line) for line in (tmp_path / "out" / "steps.jsonl").read_text().splitlines()]
    expected = [(step["x"], step["stamp"]) for step in steps]
    assert first.heard == second.heard == [("open", "room.bag", False), *expected, ("finish", True)]


@pytest.mark.parametrize("error", [InputError("breaks off; mend it"), KeyboardInterrupt()])
def test_outputs_are_finished_where_a_stream_breaks_off(error):
    listeners = [Listener(), Listener()]
    listeners[1].finish = lambda keep: 1 / 0  # it keeps no other from its end
    stream = stream_of(breaks_off(room_scans(3), error))
    with pytest.raises(ZeroDivisionError) as stopped:
        run(Odometer(Ahead()), stream, "ahead", outputs=listeners)
    assert stopped.value.__context__ is error
    assert listeners[0].heard[-1] == ("finish", True)


def test_outputs_hear_that_no_scan_could_be_used():
    listener = Listener()
    blind = [replace(scan, ranges=np.zeros(len(scan.ranges))) for scan in room_scans(3)]
    with pytest.raises(InputError, match="none of its 3 scans has a return"):
        run(Odometer(Ahead()), stream_of(blind), "ahead", outputs=[listener])
    assert listener.heard[-1] == ("finish", False)


def test_neither_rosbags_nor_rerun_is_loaded_unless_it_is_asked_for(tmp_path):
    rows = [{"ranges": [5.0] * 90, "angle_min": 0.0, "angle_increment": 0.07} for _ in range(3)]
    (tmp_path / "scans.jsonl").write_text("\n".join(map(json.dumps, rows)))
    command = ["run", str(tmp_path / "scans.jsonl"), "--out", str(tmp_path / "out")]
    code = f"""import sys; from rcnn_odom.cli import main; main({command!r})
assert not {{"rosbags", "rerun"}} & sys.modules.keys()"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


@pytest.mark.parametrize(("count", "left"), [(0, 0), (1, 1), (500, 500), (501, 251), (999, 500), (1001, 334)])
def test_thinned_points_are_never_more_than_asked_for(count, left):
    points = np.arange(2.0 * count, dtype=np.float32).reshape(-1, 2)
    kept = thin_points(points, 500)
    assert len(kept) == left
    assert np.array_equal(kept, points[:: max(1, round(count / max(left, 1)))])
