"""``rcnn-odom run``: recordings and live scans through an exported network."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from conftest import ROOT, SHARED
from data.make_bag import FORMATS, make_bag
from data.make_carmen import make_carmen
from data.make_kitti import TR, make_kitti
from odometry import SENSOR, build, random_scans
from rcnn_odom.cli import main
from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.deployment.run import run
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, Step, change_frame, planar_to_poses, relative_steps
from rcnn_odom.models.contract import Description
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.models.icp import ICP
from rcnn_odom.recordings import carmen
from rcnn_odom.recordings.formats import open_stream
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.recordings.trajectory import read_kitti, read_tum
from rcnn_odom.training.onnx_graph import to_onnx, write

FILES = {"trajectory.txt", "trajectory.tum", "steps.jsonl", "map.png", "summary.json"}


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """A tiny network for a SICK laser, as a file."""
    path = tmp_path_factory.mktemp("model") / "tiny.onnx"
    write(to_onnx(build(), "fp32"), path)
    return str(path)


@pytest.fixture(scope="module")
def velodyne(tmp_path_factory):
    """One for a ring of 0.5 degrees."""
    path = tmp_path_factory.mktemp("model") / "ring.onnx"
    write(to_onnx(build(sensor=Sensor(0.5, 360.0, 80.0)), "fp32"), path)
    return str(path)


def numbers(pose):
    """Those of a line of JSON, None as nan."""
    covariance = np.array(pose["covariance"], dtype=float)
    return [pose["stamp"], pose["x"], pose["y"], pose["heading"], *pose["step"], *covariance.flat]


def steps_in(out):
    return [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]


def test_a_carmen_log_gives_the_poses_of_the_odometer(model, tmp_path, capsys):
    make_carmen(tmp_path, "robot", frames=30)
    out = tmp_path / "out"
    assert main(["run", model, str(tmp_path / "robot.log"), "--out", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == FILES
    sequence, odometer = carmen.load("robot", root=tmp_path), Odometer.from_onnx(model)
    expected = []
    for frame in range(30):
        expected.append(odometer.step(replace(sequence.read_scan(frame), stamp=None)).matrix())
    camera = change_frame(np.array(expected), FORWARD_CAMERA)
    np.testing.assert_allclose(read_kitti(out / "trajectory.txt"), camera, atol=1e-9)
    stamps, poses = read_tum(out / "trajectory.tum")
    np.testing.assert_allclose(poses, camera, atol=1e-7)
    np.testing.assert_allclose(stamps, sequence.stamps)
    assert [step["stamp"] for step in steps_in(out)] == sequence.stamps.tolist()
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["scans"], summary["degraded"], summary["skipped"]) == (30, {}, {})
    assert 0 < summary["latency"]["median_ms"] <= summary["latency"]["p99_ms"] <= summary["latency"]["max_ms"]
    printed = capsys.readouterr().out
    assert "robot.log: 30 scans" in printed
    assert "99th percentile" in printed


def test_a_checkpoint_is_exported_and_run(tmp_path):
    network = build()
    weights = {f"model.{name}": value for name, value in network.state_dict().items()}
    settings = {"variant": "rcnn_reg", "model": network.options, "sensor": SENSOR.as_dict(), "lengths": [5.0]}
    saved = {"state_dict": {**weights, "mean_step": torch.zeros(3)}, "hyper_parameters": settings}
    torch.save(saved, tmp_path / "best.ckpt")
    scans = random_scans(6)
    bag, out = make_bag(tmp_path, "mcap", scans), tmp_path / "out"
    assert main(["run", str(tmp_path / "best.ckpt"), str(bag), "--out", str(out)]) == 0
    odometer = Odometer(network.stepper())
    expected = [odometer.step(scan).x for scan in scans.astype(np.float64)]
    np.testing.assert_allclose([step["x"] for step in steps_in(out)], expected, atol=1e-4)


@pytest.mark.parametrize("kind", FORMATS)
def test_bags_of_all_kinds(model, tmp_path, kind):
    scans = random_scans(15)
    out = tmp_path / "out"
    assert main(["run", model, str(make_bag(tmp_path, kind, scans)), "--out", str(out)]) == 0
    odometer = Odometer.from_onnx(model)
    # The angles of a LaserScan are in single precision.
    expected = [odometer.step(scan) for scan in scans.astype(np.float64)]
    got = steps_in(out)
    np.testing.assert_allclose([step["x"] for step in got], [pose.x for pose in expected], atol=1e-4)
    assert not any(step["degraded"] for step in got)


def test_a_kitti_folder_is_written_in_its_camera_frame(velodyne, tmp_path):
    make_kitti(tmp_path, ["05"], frames=12)
    out = tmp_path / "out"
    assert main(["run", velodyne, str(tmp_path / "sequences" / "05"), "--out", str(out)]) == 0
    steps = steps_in(out)
    expected = planar_to_poses([[step["x"], step["y"], step["heading"]] for step in steps])
    np.testing.assert_allclose(read_kitti(out / "trajectory.txt"), change_frame(expected, TR), atol=1e-9)
    assert steps[-1]["x"] != 0


def test_two_topics_and_the_wrong_laser(model, velodyne, tmp_path, capsys):
    bag = str(make_bag(tmp_path, "mcap", random_scans(5), ("/a", "/b")))
    out = tmp_path / "out"
    assert main(["run", model, bag, "--out", str(out)]) == 1
    assert "choose one with --topic: /a, /b" in capsys.readouterr().err
    assert main(["run", velodyne, bag, "--out", str(out), "--topic", "/a"]) == 1
    assert "the sensor's all round, one every 0.5 (frame laser); train a model on" in capsys.readouterr().err
    assert not out.exists()
    assert main(["run", model, bag, "--out", str(out), "--topic", "/a"]) == 0


def test_what_is_there_is_not_overwritten(model, tmp_path, capsys):
    make_carmen(tmp_path, "robot", frames=5)
    command = ["run", model, str(tmp_path / "robot.log"), "--out", str(tmp_path / "out")]
    assert main(command) == 0
    before = (tmp_path / "out" / "trajectory.txt").read_bytes()
    assert main(command) == 1
    assert "holds a trajectory already; choose another --out" in capsys.readouterr().err
    assert (tmp_path / "out" / "trajectory.txt").read_bytes() == before
    command[-1] = str(tmp_path / "robot.log" / "out")
    assert main(command) == 1
    assert "cannot be written" in capsys.readouterr().err


def test_a_log_that_breaks_off_leaves_valid_files(model, tmp_path, capsys):
    make_carmen(tmp_path, "robot", frames=80, compress="gz")
    log = tmp_path / "robot.log.gz"
    log.write_bytes(log.read_bytes()[:-2000])
    out = tmp_path / "out"
    assert main(["run", model, str(log), "--out", str(out)]) == 1
    assert "cannot be read to its end" in capsys.readouterr().err
    summary = json.loads((out / "summary.json").read_text())
    assert "cannot be read to its end" in summary["stopped"]
    count = len(read_kitti(out / "trajectory.txt"))
    assert 0 < count < 80
    assert count == len(read_tum(out / "trajectory.tum")[0]) == len(steps_in(out)) == summary["scans"]
    assert (out / "map.png").exists()


def start(*arguments, **options):
    command = [sys.executable, "-m", "rcnn_odom.cli", *map(str, arguments)]
    return subprocess.Popen(command, text=True, stderr=subprocess.PIPE, **options)


def test_live_answers_each_line_at_once(model, tmp_path):
    scans = random_scans(6).astype(np.float64)
    process = start(
        "run", model, "--live", "--out", tmp_path / "out", stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    odometer = Odometer.from_onnx(model)
    for number, scan in enumerate(scans):
        line = {"stamp": 0.1 * number, "ranges": [None if value == 0 else value for value in scan]}
        process.stdin.write(json.dumps(line) + "\n")
        process.stdin.flush()
        answer = json.loads(process.stdout.readline())  # it comes before the next scan is sent
        expected = odometer.step(scan, 0.1 * number).as_dict()
        assert (list(answer), answer["degraded"]) == (list(expected), expected["degraded"])
        np.testing.assert_allclose(numbers(answer), numbers(expected), atol=1e-9)
        process.stdin.write("this is no scan\n")
    rest, errors = process.communicate(timeout=60)
    assert (process.returncode, rest) == (0, "")
    assert "standard input:2: no scan" in errors
    assert "skipped: 6 lines that are no scan" in errors
    assert len(steps_in(tmp_path / "out")) == 6


def test_a_killed_run_leaves_whole_lines(model, tmp_path):
    process = start(
        "run", model, "--live", "--out", tmp_path / "out", stdin=subprocess.PIPE, stdout=subprocess.DEVNULL
    )
    line = json.dumps({"ranges": random_scans(1)[0].tolist()}) + "\n"
    for _ in range(20):
        process.stdin.write(line)
    process.stdin.flush()
    steps = tmp_path / "out" / "steps.jsonl"
    for _ in range(600):
        if steps.exists() and len(steps.read_text().splitlines()) >= 10:
            break
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGKILL)
    process.communicate(timeout=60)
    count = len(steps_in(tmp_path / "out"))
    assert count >= 10
    assert abs(len(read_kitti(tmp_path / "out" / "trajectory.txt")) - count) <= 1


def test_bytes_that_are_no_text_are_a_line_that_is_no_scan(model):
    good = json.dumps({"ranges": random_scans(1)[0].tolist()}).encode()
    done = subprocess.run(
        [sys.executable, "-m", "rcnn_odom.cli", "run", model, "--live"],
        input=b"\n".join([good, b"\xff\xfe{", good]),
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": "utf-8:strict"},
        check=True,
    )
    assert len(done.stdout.splitlines()) == 2
    assert b"skipped: 1 lines that are no scan" in done.stderr


def test_an_empty_first_scan_says_nothing_of_the_laser(model, monkeypatch, capsys):
    good = json.dumps(
        {"ranges": random_scans(1)[0].tolist(), "angle_min": -1.5708, "angle_increment": 0.0174533}
    )
    empty = json.dumps({"ranges": [], "angle_min": -1.5708, "angle_increment": 0.0174533})
    monkeypatch.setattr(sys, "stdin", iter([empty, good]))
    assert main(["run", model, "--live"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_live_without_a_scan(model, capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdin", iter(()))
    assert main(["run", model, "--live"]) == 1
    assert "standard input: no scan in it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give MODEL and either INPUT or --live"),
        (["a", "--live"], "either INPUT or --live"),
        (["a", "--model", "b"], "either INPUT or --live"),
        (["a"], "--out DIR is needed"),
    ],
)
def test_wrong_usage(model, arguments, message, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["run", model, *arguments])
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err


def test_the_model_may_be_named_by_an_option(model, tmp_path, capsys):
    assert main(["run", str(tmp_path / "none"), "--model", model, "--out", str(tmp_path / "out")]) == 1
    assert "no such file or folder" in capsys.readouterr().err


def test_models_that_are_none(tmp_path, capsys):
    for model in ("rcnn_huge", str(tmp_path / "none.ckpt")):
        assert main(["run", model, str(tmp_path), "--out", str(tmp_path / "out")]) == 1
        assert "no such" in capsys.readouterr().err


def test_trouble_is_counted_by_kind(model, tmp_path):
    scans = random_scans(10).astype(np.float64)
    stamps = [0.0, 0.1, 0.2, 0.3, 0.4, 0.2, 0.5, 0.9, 1.0, 1.1]
    angles = np.deg2rad(np.arange(181) - 90.0)
    scans[8] = 0
    rows = [Scan(scan, angles, stamp=stamp) for scan, stamp in zip(scans, stamps, strict=True)]
    summary = run(Odometer.from_onnx(model), ScanStream("log", iter(rows)), "tiny", tmp_path / "out")
    assert summary["degraded"] == {"late scan": 1, "gap": 2, "no returns": 1}
    steps = steps_in(tmp_path / "out")
    driven = sum(np.hypot(b["x"] - a["x"], b["y"] - a["y"]) for a, b in pairwise(steps))
    assert summary["path_m"] == pytest.approx(driven)
    # A late scan has a line of its own, but no place in time.
    assert len(read_kitti(tmp_path / "out" / "trajectory.txt")) == 10
    assert np.all(np.diff(read_tum(tmp_path / "out" / "trajectory.tum")[0]) > 0)


def start_of(stream, model, out):
    """A run that is refused: the reason; how many poses were written."""
    with pytest.raises(InputError) as refused:
        run(Odometer.from_onnx(model), stream, "tiny", out)
    assert ";" in str(refused.value)
    return str(refused.value), len(steps_in(out)) if (out / "steps.jsonl").exists() else 0


def scans_of(*bearings_of_scans, distance=5.0):
    """A stream of even walls, one scan for each of these bearings in degrees."""
    rows = [
        Scan(np.full(len(degrees), distance), np.deg2rad(degrees), stamp=0.1 * n)
        for n, degrees in enumerate(bearings_of_scans)
    ]
    return ScanStream("robot.bag", iter(rows))


FULL, HALF_OF_IT = np.arange(-90.0, 91.0), np.arange(-90.0, 1.0)


def test_a_laser_that_starts_slowly_is_judged_by_several_scans(model, tmp_path):
    stream = scans_of([], [], HALF_OF_IT, HALF_OF_IT, *[FULL] * 10, HALF_OF_IT, *[FULL] * 5)
    summary = run(Odometer.from_onnx(model), stream, "tiny", tmp_path / "out")
    assert summary["scans"] == len(steps_in(tmp_path / "out")) == 20
    assert summary["degraded"] == {"no returns": 2, "other laser": 3, "gap": 1}


def test_a_laser_that_is_another_one_from_the_start_leaves_nothing(model, tmp_path):
    message, written = start_of(scans_of(*[np.arange(0.0, 180.0)] * 40), model, tmp_path / "out")
    assert message == (
        "robot.bag: scan 5: its beams lie from 0 to 179 degrees, one every 1, the sensor's from -90 to 90 "
        "degrees, one every 1; train a model on recordings of such a laser "
        "(python train.py data=... data.sensor.field_of_view_deg=180 data.sensor.resolution_deg=1 "
        "data.sensor.facing_deg=90), or give another recording"
    )
    assert written == 0
    assert not (tmp_path / "out").exists()
    message, _ = start_of(scans_of(*[np.arange(0.0, 180.0)] * 3), model, tmp_path / "out")
    assert "its beams lie from 0 to 179 degrees" in message, "a recording of three scans"
    assert not (tmp_path / "out").exists()


def test_a_laser_that_becomes_another_one_keeps_what_came_before(model, tmp_path):
    message, written = start_of(scans_of(*[FULL] * 10, *[HALF_OF_IT] * 20), model, tmp_path / "out")
    assert "scan 15: its beams lie from -90 to 0 degrees" in message
    assert written == 14
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["degraded"] == {"other laser": 4}
    assert "scan 15" in summary["stopped"]


@pytest.mark.parametrize(
    ("ranges", "says"),
    [
        (np.zeros(181), "3620 are 0, negative, nan, or below their laser's minimum"),
        (np.full(181, np.nan), "3620 are 0, negative, nan"),
        (np.full(181, np.inf), "3620 are infinite, or at their laser's maximum or beyond it"),
        (np.full(181, 81.91), "3620 are at the sensor's 40 m or beyond it"),
        (np.where(np.arange(181) < 81, 0.0, np.inf), "2000 are infinite, .*, 1620 are 0"),
    ],
)
def test_a_run_without_one_usable_scan_says_why(model, tmp_path, ranges, says):
    rows = [Scan(ranges, np.deg2rad(FULL), stamp=0.1 * n) for n in range(20)]
    message, written = start_of(ScanStream("robot.bag", iter(rows)), model, tmp_path / "out")
    assert re.search(rf"robot.bag: none of its 20 scans has a return: of their readings {says}", message)
    assert written == 0
    assert not (tmp_path / "out").exists()


def test_a_folder_that_was_there_stays(model, tmp_path):
    (tmp_path / "out").mkdir()
    rows = (Scan(np.zeros(181), np.deg2rad(FULL)) for _ in range(3000))
    start_of(ScanStream("robot.bag", rows), model, tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []
    start_of(ScanStream("robot.bag", iter([Scan(np.zeros(181))])), model, tmp_path / "a" / "b")
    assert not (tmp_path / "a").exists()


def test_a_run_in_which_no_two_scans_can_be_compared(model, tmp_path):
    stream = scans_of(*[FULL, HALF_OF_IT] * 20)
    message, _ = start_of(stream, model, tmp_path / "out")
    assert "no two of its 40 scans can be compared (20 other laser, 19 gap)" in message
    assert (tmp_path / "out" / "summary.json").exists(), "what it was is written"


def case(name):
    """A recording of ``../shared/cases``."""
    path = SHARED / "cases" / name
    if not path.exists():
        pytest.skip(f"no such case at {path}")
    return path


@pytest.mark.parametrize(
    ("name", "scans", "metres", "degraded"),
    [
        # The same scans as the next one's, but the first three are none: three steps less.
        ("slow_start.bag", 40, 35.8, {"no returns": 2, "other laser": 1}),
        ("range_max_0.bag", 40, 38.6, {}),
        ("foreign_topic.bag", 10, 8.7, {}),
    ],
)
def test_cases_that_are_read(tmp_path, name, scans, metres, degraded):
    assert main(["run", "rcnn_small", str(case(name)), "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["scans"], summary["degraded"]) == (scans, degraded)
    assert summary["path_m"] == pytest.approx(metres, rel=0.02)


def test_a_laser_that_sees_the_left_half_is_refused_or_read_whole(model, tmp_path, capsys):
    path, sensor = case("left_half.bag"), Sensor(1.0, 180.0, 80.0, facing_deg=90)
    assert main(["run", model, str(path), "--out", str(tmp_path / "out")]) == 1
    assert "its beams lie from 0 to 179 degrees" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    write(to_onnx(build(sensor=sensor), "fp32"), tmp_path / "left.onnx")
    assert main(["run", str(tmp_path / "left.onnx"), str(path), "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["scans"] == 120
    assert not {"other laser", "few returns"} & summary["degraded"].keys()


def test_scan_matching_of_the_left_half_follows_the_drive():
    """The same drive as a log's, whose poses are the reference: 1.26 rad of turns on 5.8 m."""
    sensor = Sensor(1.0, 180.0, 80.0, facing_deg=90)
    stepper = ICP({"beams": 450, "max_iterations": 30, "max_distance": 5.0}, sensor).stepper()
    scans = list(open_stream(case("left_half.bag")).scans)
    depths = [sensor.encode(scan) for scan in scans]
    for scan, depth in zip(scans, depths, strict=True):
        returned = (scan.ranges > 0) & (scan.ranges < sensor.max_range)
        assert np.count_nonzero(depth) == np.count_nonzero(returned), "no beam is dropped"
    steps = np.array([stepper(np.stack(pair)).array() for pair in pairwise(depths)])
    truth = carmen.load("robotlaser_neg_res", root=case("robotlaser_neg_res.log.gz").parent)
    expected = relative_steps(truth.poses)
    assert np.abs(steps[:, 2]).sum() == pytest.approx(np.abs(expected[:, 2]).sum(), rel=0.05)
    assert np.hypot(*steps[:, :2].T).sum() == pytest.approx(np.hypot(*expected[:, :2].T).sum(), rel=0.1)


@pytest.mark.slow
def test_memory_is_constant_over_a_long_stream(model):
    """A fifth of an hour of scans, made as they are read."""
    import tracemalloc

    scans, angles, used = random_scans(50).astype(np.float64), np.deg2rad(np.arange(181) - 90.0), []

    def endless():
        for number in range(8000):
            if number in (4000, 7999):
                used.append(tracemalloc.get_traced_memory()[0])
            yield Scan(scans[number % 50], angles, stamp=0.1 * number)

    tracemalloc.start()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rcnn_odom.deployment.run.MAP_SCANS", 100)
        patch.setattr("rcnn_odom.deployment.run.LATENCIES", 100)
        run(Odometer.from_onnx(model), ScanStream("long", endless()), "tiny")
    tracemalloc.stop()
    assert used[1] - used[0] < 200_000, used


def test_the_map_shows_walls_where_they_are(tmp_path):
    """With true motions the scans of a square room lie on each other."""
    from rcnn_odom.evaluation.figures import map_figure

    odometer = Odometer(_Straight())
    points, poses = [], []
    angles = np.deg2rad(np.arange(360) - 180.0)
    for step in range(5):
        x = 0.5 * step
        with np.errstate(divide="ignore"):
            forward = np.where(np.cos(angles) > 0, (10 - x) / np.cos(angles), (-10 - x) / np.cos(angles))
            ranges = np.minimum(forward, np.abs(10 / np.sin(angles)))
        pose = odometer.step(ranges, 0.1 * step, angles)
        points.append(odometer.returns())
        poses.append([pose.x, pose.y, pose.heading])
    seen = np.concatenate(points)
    assert np.abs(np.abs(seen).max(1) - 10).max() < 0.1
    map_figure("room", np.array(poses), points).savefig(tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 5000
    map_figure("nothing seen", np.zeros((1, 3)), [np.empty((0, 2), np.float32)])


def test_the_map_has_no_ghosts(monkeypatch, tmp_path):
    """While nothing is seen, the walls of the last scan stay where they were."""
    drawn = []

    def map_figure(title, poses, points):
        drawn.extend(points)
        return SimpleNamespace(savefig=lambda *arguments, **options: None)

    monkeypatch.setattr("rcnn_odom.evaluation.figures.map_figure", map_figure)
    angles = np.deg2rad(np.arange(360) - 180.0)
    x = np.cos(angles)
    wall = [np.where(x > 0.3, (10 - 0.5 * n) / x, 0.0) for n in range(3)]  # it is 10 m ahead at first
    rows = [Scan(scan, angles, stamp=0.1 * n) for n, scan in enumerate([*wall, *[np.zeros(360)] * 5])]
    rows.insert(3, Scan(wall[0], angles, stamp=0.1))  # late
    run(Odometer(_Straight()), ScanStream("room", iter(rows)), "straight", tmp_path / "out")
    assert [len(points) > 0 for points in drawn] == [True] * 3 + [False] * 6
    np.testing.assert_allclose(np.concatenate(drawn)[:, 0], 10.0, atol=0.1)


class _Straight:
    def __init__(self):
        self.description = Description(Sensor(1.0, 360.0, 40.0), (0.5, 0.1, 0.1), 0.0, 0.1)

    def __call__(self, pair):
        return Step(0.5, 0.0, 0.0)

    def reset(self):
        pass


def test_errors_inside_are_not_hidden(model, tmp_path):
    class Broken:
        description = Odometer.from_onnx(model).description

        def reset(self):
            pass

        def __call__(self, pair):
            raise RuntimeError("a fault of the program")

    rows = [Scan(scan) for scan in random_scans(3)]
    with pytest.raises(RuntimeError):
        run(Odometer(Broken()), ScanStream("log", iter(rows)), "tiny", tmp_path / "out")
    assert len(read_kitti(tmp_path / "out" / "trajectory.txt")) == 1
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["stopped"] == "a fault of the program"
    with pytest.raises(InputError):
        run(Odometer.from_onnx(model), ScanStream("log", iter(())), "tiny")


def test_encoded_points_are_decoded_to_where_they_were():
    from rcnn_odom.models.encoding import decode

    for sensor in (SENSOR, Sensor(0.5, 360.0, 80.0)):
        depth = encode(np.deg2rad([-45.0, 0.0, 30.0]), [5.0, 6.0, 7.0], sensor)
        expected = [[5 * np.sqrt(0.5), -5 * np.sqrt(0.5)], [6.0, 0.0], [7 * np.sqrt(0.75), 3.5]]
        np.testing.assert_allclose(decode(depth, sensor), expected, atol=1e-6)
    backwards = encode([np.pi], [3.0], Sensor(0.5, 360.0, 80.0))
    np.testing.assert_allclose(decode(backwards, Sensor(0.5, 360.0, 80.0)), [[-3.0, 0.0]], atol=1e-6)


BLOCKED = ("torch", "lightning", "pytorch_lightning", "hydra", "omegaconf")
FORBID = f"import sys; sys.modules.update(dict.fromkeys({BLOCKED!r}))"


def test_the_command_needs_no_pytorch(model, tmp_path):
    make_carmen(tmp_path, "robot", frames=4)
    command = ["run", model, str(tmp_path / "robot.log"), "--out", str(tmp_path / "out")]
    code = f"{FORBID}; from rcnn_odom.cli import main; sys.exit(main({command!r}))"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_nothing_in_deployment_needs_pytorch_or_lightning(tmp_path):
    code = f"""{FORBID}
from pathlib import Path

import numpy as np

from rcnn_odom.deployment import odometer, onnx_model, run, sampling, shipped
from rcnn_odom.geometry import Step
from rcnn_odom.models.contract import Description
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream


class Straight:
    description = Description(Sensor(1.0, 180.0, 40.0), (0.5, 0.1, 0.1), 0.0, 0.1)

    def __call__(self, pair):
        return Step(0.5, 0.0, 0.0)

    def reset(self):
        pass


scans = (Scan(np.full(181, 5.0), stamp=0.1 * number) for number in range(4))
stream, out = ScanStream("room", scans), Path({str(tmp_path)!r})
summary = run.run(odometer.Odometer(Straight()), stream, "straight", out)
assert (summary["scans"], summary["path_m"], summary["degraded"]) == (4, 1.5, {{}})
assert not [name for name in {BLOCKED!r} if sys.modules[name]]
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
    assert {path.name for path in tmp_path.iterdir()} == FILES
