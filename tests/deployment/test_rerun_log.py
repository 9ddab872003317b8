"""``rcnn-odom run --rerun`` and ``--view``: what rerun's own reader finds in the recordings."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from outputs import START, Ahead, breaks_off, room_scans, stream_of
from rcnn_odom.cli import main
from rcnn_odom.deployment.mcap_log import McapLog
from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.deployment.run import run
from rcnn_odom.errors import InputError
from rcnn_odom.recordings.scan import Scan

rerun = pytest.importorskip(
    "rerun", reason="rerun is not installed, 170 MB, for --rerun and --view: pip install -e .[view]"
)

pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")  # of one that is still written

from rerun.chunk import McapReader, RrdReader  # noqa: E402 - only where there is one

from rcnn_odom.deployment import rerun_log  # noqa: E402
from rcnn_odom.deployment.rerun_log import RerunFile, RerunViewer  # noqa: E402


def read(path):
    """By place: rows of component -> value, with scan and seconds; those of no time under None."""
    found = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for row in range(batch.num_rows):
            values = {name: batch.column(name)[row] for name in batch.schema.names}
            plain = {name.partition(":")[2]: each.as_py() for name, each in values.items() if ":" in name}
            plain = {name: each for name, each in plain.items() if each is not None}
            if "scan" in values:
                plain["scan"] = values["scan"].as_py()
            if "stamp" in values:
                plain |= {"seconds": values["stamp"].value * 1e-9, "time": str(values["stamp"].type)}
            found.setdefault(chunk.entity_path, []).append(plain)
    return {place: sorted(rows, key=lambda row: row.get("scan", -1)) for place, rows in found.items()}


def timed(rows):
    return [row for row in rows if "scan" in row]


def angle(xyzw):
    return 2 * np.arctan2(xyzw[2], xyzw[3])


def test_a_recording_holds_what_the_run_itself_wrote(tmp_path):
    scans, out, path = room_scans(60), tmp_path / "out", tmp_path / "new" / "out.rrd"
    scans[7] = replace(scans[7], ranges=np.where(np.arange(180) % 3, scans[7].ranges, np.inf))
    tracker = Ahead(notes={3: ("poor match: it does not fit",), 4: ("poor match: again",)})
    run(Odometer(tracker), stream_of(scans), "ahead", out, outputs=[RerunFile(path)])
    steps = [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]
    found = read(path)
    poses, seen = timed(found["/odom/laser"]), timed(found["/odom/laser/scan"])
    strips, ellipses = timed(found["/odom/path"]), timed(found["/odom/covariance"])
    assert [row["scan"] for row in poses] == [row["scan"] for row in seen] == list(range(1, 61))
    np.testing.assert_allclose([row["seconds"] for row in poses], [s["stamp"] for s in steps], atol=1e-6)
    places = np.array([[step["x"], step["y"]] for step in steps])
    np.testing.assert_allclose([row["translation"][0][:2] for row in poses], places, atol=1e-4)
    turns = [angle(row["quaternion"][0]) - step["heading"] for row, step in zip(poses, steps, strict=True)]
    np.testing.assert_allclose(np.cos(turns), 1.0, atol=1e-6)
    for row, scan in zip(seen, scans, strict=True):
        positions = np.array(row["positions"])
        np.testing.assert_allclose(
            positions, np.column_stack([scan.points(), 0 * positions[:, 0]]), atol=1e-5
        )
    assert len(seen[7]["positions"]) == 120
    ways = np.array([row["strips"][0] for row in strips])[..., :2]
    np.testing.assert_allclose(ways[1:, 0], places[:-1], atol=1e-4)
    np.testing.assert_allclose(ways[:, 1], places, atol=1e-4)
    for row, step, place in zip(ellipses, steps, places, strict=True):
        way = angle(row["quaternions"][0])
        turned = np.array([[np.cos(way), -np.sin(way)], [np.sin(way), np.cos(way)]])
        spread = turned @ np.diag(np.square(row["half_sizes"][0][:2])) @ turned.T / 9
        np.testing.assert_allclose(spread, np.array(step["pose_covariance"])[:2, :2], atol=1e-6, rtol=1e-4)
        np.testing.assert_allclose(row["centers"][0][:2], place, atol=1e-4)
    assert [(row["scan"], len(row["positions"])) for row in timed(found["/odom/local_map"])] == [
        (1, 180),
        (51, 11 * 180),
    ]
    assert [(row["scan"], row["text"], row["level"]) for row in found["/marks"]] == [
        (4, ["poor match: it does not fit"], ["WARN"]),
        (16, ["poor match: over, 2 scans marked from scan 4 to scan 5"], ["INFO"]),
    ]


def test_an_unknown_covariance_takes_the_ellipse_away(tmp_path):
    path = tmp_path / "out.rrd"
    run(Odometer(Ahead(unknown_at=2)), stream_of(room_scans(6)), "ahead", outputs=[RerunFile(path)])
    rows = timed(read(path)["/odom/covariance"])
    assert [row["scan"] for row in rows if "half_sizes" in row] == [1, 2]
    assert [row["scan"] for row in rows if "is_recursive" in row] == [3], "cleared, once"


def test_of_a_robot_the_laser_sits_on_it(tmp_path):
    path, laser_pose = tmp_path / "out.rrd", (0.3, -0.2, np.pi / 2)
    run(Odometer(Ahead(), laser_pose), stream_of(room_scans(3)), "ahead", outputs=[RerunFile(path)])
    found = read(path)
    [on_robot] = found["/odom/base_link/laser"]
    np.testing.assert_allclose(on_robot["translation"][0], [0.3, -0.2, 0.0], atol=1e-6)
    assert angle(on_robot["quaternion"][0]) == pytest.approx(np.pi / 2)
    assert len(timed(found["/odom/base_link"])) == len(timed(found["/odom/base_link/laser/scan"])) == 3
    assert "/odom/laser" not in found


def test_seconds_from_some_start_and_scans_that_are_passed_over(tmp_path):
    path = tmp_path / "out.rrd"
    times = [5.0, 5.1, 5.2, 5.15, 5.3]
    scans = [replace(scan, stamp=time) for scan, time in zip(room_scans(5), times, strict=True)]
    run(Odometer(Ahead()), stream_of(scans), "ahead", outputs=[RerunFile(path)])
    found = read(path)
    poses = timed(found["/odom/laser"])
    assert [row["scan"] for row in poses] == [1, 2, 3, 5]
    np.testing.assert_allclose([row["seconds"] for row in poses], np.delete(times, 3))
    assert found["/marks"][0]["text"][0].startswith("late scan")


@pytest.mark.parametrize(("start", "kind"), [(START, "timestamp[ns]"), (5.0, "duration[ns]")])
def test_the_first_scan_with_a_stamp_decides_whether_stamps_are_dates(tmp_path, start, kind):
    """Scans before it are on the time line of their numbers alone."""
    path, scans = tmp_path / "out.rrd", room_scans(6)
    stamps = [None, None, *(start + 0.1 * np.arange(4))]
    scans = [replace(scan, stamp=stamp) for scan, stamp in zip(scans, stamps, strict=True)]
    run(Odometer(Ahead()), stream_of(scans), "ahead", outputs=[RerunFile(path)])
    poses = timed(read(path)["/odom/laser"])
    assert [row["scan"] for row in poses] == [1, 2, 3, 4, 5, 6]
    assert [row.get("time") for row in poses] == [None, None, *[kind] * 4]
    np.testing.assert_allclose([row["seconds"] for row in poses[2:]], stamps[2:], atol=1e-6)


def test_without_stamps_there_is_only_the_time_line_of_the_scans(tmp_path):
    path = tmp_path / "out.rrd"
    scans = [replace(scan, stamp=None) for scan in room_scans(3)]
    run(Odometer(Ahead()), stream_of(scans), "ahead", outputs=[RerunFile(path)])
    poses = timed(read(path)["/odom/laser"])
    assert [(row["scan"], row.get("time")) for row in poses] == [(1, None), (2, None), (3, None)]


def test_the_viewer_shows_the_whole_path_and_the_marks(tmp_path):
    path = tmp_path / "out.rrd"
    run(Odometer(Ahead()), stream_of(room_scans(3)), "ahead", outputs=[RerunFile(path)])
    reader = RrdReader(path)
    assert [each.application_id for each in reader.recordings()] == ["rcnn-odom"]
    [blueprint] = reader.blueprints()
    places = {chunk.entity_path for chunk in reader.stream(store=blueprint)}
    assert any("VisibleTimeRanges" in each or "overrides/odom/path" in each for each in places)
    assert any(each.endswith("EyeControls3D") for each in places)


@pytest.mark.parametrize("error", [InputError("breaks off; mend it"), KeyboardInterrupt()])
def test_a_stream_that_breaks_off_leaves_a_whole_file(tmp_path, error):
    path, scans = tmp_path / "out.rrd", breaks_off(room_scans(7), error)
    with pytest.raises(type(error)):
        run(Odometer(Ahead()), stream_of(scans), "ahead", outputs=[RerunFile(path)])
    assert len(timed(read(path)["/odom/laser"])) == 7
    RrdReader(path).store()  # which needs the file's end


def test_nothing_is_left_where_no_scan_can_be_used(tmp_path):
    blind = [replace(scan, ranges=np.zeros(len(scan.ranges))) for scan in room_scans(9)]
    path = tmp_path / "a" / "out.rrd"
    with pytest.raises(InputError, match="has a return"):
        run(Odometer(Ahead()), stream_of(blind), "ahead", outputs=[RerunFile(path)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("out.rec", "out.rec: does not end in .rrd; choose another --rerun"),
        ("there.rrd", "there.rrd: exists already; choose another --rerun"),
        ("there.rrd/x.rrd", "there.rrd/x.rrd: cannot be written (Not a directory); choose another --rerun"),
    ],
)
def test_what_cannot_be_written_is_one_line_before_anything_is_read(
    name, message, monkeypatch, tmp_path, capsys
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.rrd").write_text("mine")
    assert main(["run", "no such recording", "--rerun", name]) == 1
    assert capsys.readouterr().err == f"rcnn-odom: error: {message}\n"
    assert [each.name for each in tmp_path.iterdir()] == ["there.rrd"]


def test_a_file_that_cannot_be_completed_is_told_of(tmp_path, monkeypatch):
    """A disk that is full at the end, as rerun tells it."""

    def full(self, **options):
        raise RuntimeError("no space left")

    output = RerunFile(tmp_path / "out.rrd")
    monkeypatch.setattr("rerun.RecordingStream.flush", full)
    with pytest.raises(OSError, match=r"out\.rrd: no space left"):
        run(Odometer(Ahead()), stream_of(room_scans(5)), "ahead", outputs=[output])


def test_what_rerun_itself_cannot_write_is_one_line(tmp_path):
    path = tmp_path / ("x" * 300 + ".rrd")
    with pytest.raises(InputError, match=r"cannot be written \(.*\); choose another --rerun") as refused:
        run(Odometer(Ahead()), stream_of(room_scans(2)), "ahead", outputs=[RerunFile(path)])
    assert "\n" not in str(refused.value)


def test_without_a_display_it_says_what_else_there_is(monkeypatch, capsys):
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert main(["run", "no such recording", "--view"]) == 1
    assert capsys.readouterr().err == (
        "rcnn-odom: error: --view: no display (neither DISPLAY nor WAYLAND_DISPLAY is set); write a file "
        "instead, --rerun out.rrd, and open it where there is one\n"
    )


def test_a_viewer_that_does_not_start_is_one_line(monkeypatch):
    def spawn(**options):
        raise RuntimeError("Failed to find the viewer.\nInstall it.")

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(rerun, "spawn", spawn)
    with pytest.raises(
        InputError, match=r"--view: rerun's viewer did not start \(Failed to find the viewer.\);"
    ):
        run(Odometer(Ahead()), stream_of(room_scans(2)), "ahead", outputs=[RerunViewer()])


@pytest.fixture
def viewer(monkeypatch, tmp_path):
    """In place of a window: the same program listening, which keeps what it gets in a file."""
    port, path = 9953, tmp_path / "got.rrd"
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(rerun_log, "PORT", port)
    monkeypatch.setattr(rerun_log, "PATIENCE", 5.0)
    command = [rerun_log._find_viewer(), "--port", str(port), "--save", str(path)]
    with (tmp_path / "viewer.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
        for _ in range(200):
            if "Listening" in (tmp_path / "viewer.log").read_text():
                break
            time.sleep(0.1)
        yield SimpleNamespace(process=process, path=path)
        process.kill()
        process.wait(timeout=30)


def test_the_viewer_gets_each_pose_while_the_run_goes(viewer):
    sizes = []

    def scans():
        for scan in room_scans(40):
            yield scan
            if scan.stamp > START + 1.95 and not sizes:  # half of it is sent
                for _ in range(100):
                    if viewer.path.exists() and viewer.path.stat().st_size > 5000:
                        break
                    time.sleep(0.1)
                sizes.append(viewer.path.stat().st_size)

    run(Odometer(Ahead()), stream_of(scans()), "ahead", outputs=[RerunViewer()])
    assert sizes[0] > 5000
    for _ in range(100):
        found = read(viewer.path)
        if len(timed(found.get("/odom/laser/scan", []))) == 40:
            break
        time.sleep(0.1)
    assert [row["scan"] for row in timed(found["/odom/laser"])] == list(range(1, 41))


def test_a_viewer_that_is_closed_ends_no_run(viewer, tmp_path):
    def scans():
        for number, scan in enumerate(room_scans(60)):
            if number == 20:
                viewer.process.kill()
                viewer.process.wait(timeout=30)
            yield scan

    path, start = tmp_path / "out.rrd", time.perf_counter()
    summary = run(Odometer(Ahead()), stream_of(scans()), "ahead", outputs=[RerunViewer(), RerunFile(path)])
    assert summary["scans"] == 60
    assert time.perf_counter() - start < 60
    assert len(timed(read(path)["/odom/laser"])) == 60


def test_by_the_command_and_live(tmp_path):
    """The matcher's own map, by the command; and a run whose scans come one by one."""
    rows = [
        {"stamp": 0.1 * n, "ranges": [5.0 - 0.01 * n, 4.0] * 90, "angle_min": -1.5, "angle_increment": 0.015}
        for n in range(5)
    ]
    (tmp_path / "scans.jsonl").write_text("\n".join(map(json.dumps, rows)))
    made = [tmp_path / "a.rrd", tmp_path / "b.rrd"]
    assert main(["run", str(tmp_path / "scans.jsonl"), "--rerun", str(made[0])]) == 0
    command = [sys.executable, "-m", "rcnn_odom.cli", "run", "--live", "--rerun", str(made[1])]
    done = subprocess.run(
        command, input=(tmp_path / "scans.jsonl").read_text(), capture_output=True, text=True, check=True
    )
    assert len(done.stdout.splitlines()) == 5, "poses alone"
    for path in made:
        found = read(path)
        assert len(timed(found["/odom/laser"])) == 5
        [first] = timed(found["/odom/local_map"])
        assert len(first["positions"]) > 50


def test_a_killed_run_leaves_what_was_written(tmp_path):
    """Whole batches, without the file's end."""
    path = tmp_path / "out.rrd"
    command = [sys.executable, "-m", "rcnn_odom.cli", "run", "--live", "--rerun", str(path)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    line = {"ranges": [5.0, 4.0] * 90, "angle_min": -1.0, "angle_increment": 0.01}
    for number in range(1000):
        process.stdin.write(json.dumps({"stamp": START + 0.1 * number, **line}) + "\n")
        process.stdin.flush()
        process.stdout.readline()
    process.kill()
    process.communicate(timeout=60)
    assert len(timed(read(path)["/odom/laser"])) > 300


def test_rerun_reads_an_mcap_as_well(tmp_path):
    path = tmp_path / "out.mcap"
    tracker = Ahead(notes={2: ("poor match: it does not fit",)})
    run(Odometer(tracker), stream_of(room_scans(5)), "ahead", outputs=[McapLog(path)])
    found = {}
    for chunk in McapReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            found.setdefault((chunk.entity_path, name), []).extend(batch.column(name).to_pylist())
    frames = [found["/tf", f"Transform3D:{name}_frame"] for name in ("parent", "child")]
    assert frames == [[["odom"]] * 5, [["laser"]] * 5]
    assert [len(points) for points in found["/local_map", "Points3D:positions"]] == [180]
    assert found["/rosout", "TextLog:text"] == [["[rcnn_odom] poor match: it does not fit"]]
    assert len(found["/odometry", "nav_msgs.msg.Odometry:message"]) == 5


@pytest.mark.slow
def test_memory_is_constant_over_a_long_stream(tmp_path, monkeypatch):
    """Of the whole process, since rerun's own is not Python's."""
    monkeypatch.setattr("rcnn_odom.deployment.run.MAP_SCANS", 100)
    monkeypatch.setattr("rcnn_odom.deployment.run.LATENCIES", 100)
    bearings = np.linspace(-1, 1, 720)
    rng, megabytes, sizes, path = np.random.default_rng(0), [], [], tmp_path / "out.rrd"

    def scans():
        for number in range(9001):
            if number % 3000 == 0:
                pages = int(Path("/proc/self/statm").read_text().split()[1])
                megabytes.append(pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
                sizes.append(path.stat().st_size / 1e6 if number else 0.0)
            yield Scan(rng.uniform(1, 9, 720), bearings, stamp=START + 0.1 * number)

    run(Odometer(Ahead()), stream_of(scans()), "ahead", outputs=[RerunFile(path)])
    assert sizes[3] - sizes[1] > 45, sizes
    assert megabytes[3] - megabytes[1] < 0.4 * (sizes[3] - sizes[1]), (megabytes, sizes)
    assert sizes[3] - sizes[2] < 1.3 * (sizes[2] - sizes[1]), "its size grows evenly"
