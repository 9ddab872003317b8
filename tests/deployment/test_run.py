"""``rcnn-odom run``: recordings and live scans through an exported network."""

import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import torch

from conftest import ROOT, SHARED
from data.make_bag import (
    FORMATS,
    ODOMETRY,
    SCAN,
    START,
    TRANSFORMS,
    arrival_of,
    laser_scan,
    make_bag,
    odometry,
    static_transforms,
    store_of,
    write_bag,
)
from data.make_carmen import make_carmen
from data.make_kitti import TR, make_kitti
from odometry import SENSOR, build, random_scans
from outputs import breaks_off
from rcnn_odom.cli import main
from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.deployment.run import run
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.figures import new_figure
from rcnn_odom.geometry import FORWARD_CAMERA, Step, change_frame, planar_to_poses, relative_steps
from rcnn_odom.models.contract import Description, Registered, find_model
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.models.pairs import PairTracker
from rcnn_odom.recordings import carmen, kitti
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream
from rcnn_odom.recordings.trajectory import read_kitti, read_tum
from rcnn_odom.training.onnx_graph import to_onnx, write

FILES = {"trajectory.txt", "trajectory.tum", "steps.jsonl", "report.html", "summary.json"}


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


@pytest.fixture(autouse=True)
def no_time_plots(monkeypatch):
    """Which take seconds for each run; test_report_page.py draws them."""
    for name in ("_motion_pictures", "_deviation_pictures"):
        monkeypatch.setattr(f"rcnn_odom.deployment.report_pictures.{name}", lambda timeline: ())


def numbers(pose):
    """Those of a line of JSON, None as nan."""
    covariance = np.array(pose["covariance"], dtype=float)
    return [pose["stamp"], pose["x"], pose["y"], pose["heading"], *pose["step"], *covariance.flat]


def steps_in(out):
    return [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]


def test_a_carmen_log_gives_the_poses_of_the_odometer(model, tmp_path, capsys):
    make_carmen(tmp_path, "robot", frames=30)
    out = tmp_path / "out"
    assert main(["run", "--model", model, str(tmp_path / "robot.log"), "--out", str(out)]) == 0
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
    *_, path, speed, trouble = capsys.readouterr().out.splitlines()
    assert path.startswith(f"path     30 scans, {summary['path_m']:.1f} m driven; ended ")
    assert speed.startswith("speed    ")
    assert trouble == f"trouble  none; look at {out / 'report.html'}"


def test_a_checkpoint_is_exported_and_run(tmp_path):
    network = build()
    weights = {f"model.{name}": value for name, value in network.state_dict().items()}
    settings = {"variant": "rcnn_reg", "model": network.options, "sensor": SENSOR.as_dict(), "lengths": [5.0]}
    saved = {"state_dict": {**weights, "mean_step": torch.zeros(3)}, "hyper_parameters": settings}
    torch.save(saved, tmp_path / "best.ckpt")
    scans = random_scans(6)
    bag, out = make_bag(tmp_path, "mcap", scans), tmp_path / "out"
    assert main(["run", "--model", str(tmp_path / "best.ckpt"), str(bag), "--out", str(out)]) == 0
    odometer = Odometer(network.tracker())
    expected = [odometer.step(scan).x for scan in scans.astype(np.float64)]
    np.testing.assert_allclose([step["x"] for step in steps_in(out)], expected, atol=1e-4)


@pytest.mark.parametrize("kind", FORMATS)
def test_bags_of_all_kinds(model, tmp_path, kind):
    scans = random_scans(15)
    out = tmp_path / "out"
    assert main(["run", "--model", model, str(make_bag(tmp_path, kind, scans)), "--out", str(out)]) == 0
    odometer = Odometer.from_onnx(model)
    # The angles of a LaserScan are in single precision.
    expected = [odometer.step(scan) for scan in scans.astype(np.float64)]
    got = steps_in(out)
    np.testing.assert_allclose([step["x"] for step in got], [pose.x for pose in expected], atol=1e-4)
    assert not any(step["degraded"] for step in got)


def test_a_kitti_folder_is_written_in_its_camera_frame(velodyne, tmp_path):
    make_kitti(tmp_path, ["05"], frames=12)
    out = tmp_path / "out"
    assert main(["run", "--model", velodyne, str(tmp_path / "sequences" / "05"), "--out", str(out)]) == 0
    steps = steps_in(out)
    expected = planar_to_poses([[step["x"], step["y"], step["heading"]] for step in steps])
    np.testing.assert_allclose(read_kitti(out / "trajectory.txt"), change_frame(expected, TR), atol=1e-9)
    assert steps[-1]["x"] != 0


def test_two_topics_and_the_wrong_laser(model, velodyne, tmp_path, capsys):
    bag = str(make_bag(tmp_path, "mcap", random_scans(5), ("/a", "/b")))
    out = tmp_path / "out"
    assert main(["run", "--model", model, bag, "--out", str(out)]) == 1
    assert "choose one with --topic: /a, /b" in capsys.readouterr().err
    assert main(["run", "--model", velodyne, bag, "--out", str(out), "--topic", "/a"]) == 1
    message = capsys.readouterr().err
    assert "but the sensor's lie all round, one every 0.5 (frame laser); take --model matcher" in message
    assert not out.exists()
    assert main(["run", "--model", model, bag, "--out", str(out), "--topic", "/a"]) == 0


def test_what_is_there_is_not_overwritten(model, tmp_path, capsys):
    make_carmen(tmp_path, "robot", frames=5)
    command = ["run", "--model", model, str(tmp_path / "robot.log"), "--out", str(tmp_path / "out")]
    assert main(command) == 0
    before = (tmp_path / "out" / "trajectory.txt").read_bytes()
    assert main(command) == 1
    assert "holds a trajectory already; choose another --out" in capsys.readouterr().err
    assert (tmp_path / "out" / "trajectory.txt").read_bytes() == before
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "report.html").write_text("of somebody else")
    assert main([*command[:-1], str(tmp_path / "other")]) == 1
    assert "holds report.html already; choose another --out" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "other").iterdir()] == ["report.html"]
    command[-1] = str(tmp_path / "robot.log" / "out")
    assert main(command) == 1
    assert "cannot be written" in capsys.readouterr().err


def test_a_log_that_breaks_off_leaves_valid_files(model, tmp_path, capsys):
    make_carmen(tmp_path, "robot", frames=80, compress="gz")
    log = tmp_path / "robot.log.gz"
    log.write_bytes(log.read_bytes()[:-2000])
    out = tmp_path / "out"
    assert main(["run", "--model", model, str(log), "--out", str(out)]) == 1
    assert "cannot be read to its end" in capsys.readouterr().err
    summary = json.loads((out / "summary.json").read_text())
    assert "cannot be read to its end" in summary["stopped"]
    count = len(read_kitti(out / "trajectory.txt"))
    assert 0 < count < 80
    assert count == len(read_tum(out / "trajectory.tum")[0]) == len(steps_in(out)) == summary["scans"]
    assert "The run ended before the recording did" in (out / "report.html").read_text()


def start(*arguments, **options):
    command = [sys.executable, "-m", "rcnn_odom.cli", *map(str, arguments)]
    return subprocess.Popen(command, text=True, stderr=subprocess.PIPE, **options)


def test_live_answers_each_line_at_once(model, tmp_path):
    scans = random_scans(6).astype(np.float64)
    process = start(
        "run",
        "--model",
        model,
        "--live",
        "--out",
        tmp_path / "out",
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
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
        "run",
        "--model",
        model,
        "--live",
        "--out",
        tmp_path / "out",
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
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


def test_a_run_that_is_stopped_by_hand_ends_with_the_three_lines(model, tmp_path):
    """On standard error, of the scans so far; the exit status says that it was stopped."""
    options = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    # A shell starts jobs in the background with this signal ignored, and so would the run.
    options["preexec_fn"] = lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)
    process = start("run", "--model", model, "--live", "--out", tmp_path / "out", **options)
    for number, scan in enumerate(random_scans(4).astype(np.float64)):
        process.stdin.write(json.dumps({"stamp": 0.1 * number, "ranges": scan.tolist()}) + "\n")
        process.stdin.flush()
        process.stdout.readline()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 130
    path, speed, trouble, last = errors.splitlines()[-4:]
    assert path.startswith("path     4 scans, ")
    assert speed.startswith("speed    ")
    assert trouble == f"trouble  stopped: by Ctrl-C; look at {tmp_path / 'out' / 'report.html'}"
    assert last == "rcnn-odom: interrupted"
    assert len(steps_in(tmp_path / "out")) == 4
    assert (tmp_path / "out" / "report.html").exists()


def test_a_run_that_is_stopped_before_its_first_scan_has_no_lines(model, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    stream = ScanStream("log", breaks_off([], KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        run(Odometer.from_onnx(model), stream, "tiny", tmp_path / "out")
    assert caplog.messages == []
    assert not (tmp_path / "out").exists()


def test_bytes_that_are_no_text_are_a_line_that_is_no_scan(model):
    good = json.dumps({"ranges": random_scans(1)[0].tolist()}).encode()
    done = subprocess.run(
        [sys.executable, "-m", "rcnn_odom.cli", "run", "--model", model, "--live"],
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
    assert main(["run", "--model", model, "--live"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_live_without_a_scan(model, capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdin", iter(()))
    assert main(["run", "--model", model, "--live"]) == 1
    assert "standard input: no scan in it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give one INPUT or --live"),
        (["a", "--live", "--model", "all_round"], "give one INPUT or --live"),
        (["a", "b", "--model", "all_round"], "give one INPUT or --live"),
        (["a.bag", "b.bag", "--out", "x"], "give one INPUT or --live"),
        (["a"], "--out DIR is needed"),
        (["a", "--out", "x", "--threads", "2"], "--threads works only with a network (--model)"),
        (
            ["a", "--out", "x", "--model", "b.onnx", "--wheels"],
            "--wheels works only with the matcher, not with a network",
        ),
        (["a", "--out", "x", "--model", "b.onnx", "--deskew", "on"], "--deskew works only with the matcher"),
        (
            ["a", "--out", "x", "--model", "all_round", "--odom-topic", "/odom"],
            "--odom-topic works only with the matcher",
        ),
        (["a", "--out", "x", "--deskew", "perhaps"], "invalid choice: 'perhaps'"),
        (["--live", "--ring", "3"], "--ring works only with recordings"),
        (["--live", "--base", "base_link"], "--base works only with recordings"),
        (["--live", "--wheels"], "--wheels works only with recordings"),
        (["a", "--out", "x", "--base", "b", "--laser-pose", "1", "0", "0"], "both set the pose of the laser"),
        (["a", "--out", "x", "--wheels", "--odom-topic", "/o"], "choose different odometry"),
        (
            ["a", "--out", "x", "--laser-pose", "1", "2"],
            "'1 2' is not three numbers, metres, metres and degrees",
        ),
        (["a", "--out", "x", "--laser-pose", "1", "2", "nan"], "is not three numbers"),
        (["a", "--out", "x", "--every", "0"], "'0' is not a whole number, 1 or more"),
    ],
)
def test_wrong_usage(arguments, message, capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["run", *arguments])
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (["all_round", "my drive", "--out", "x"], "rcnn-odom run 'my drive' --model all_round --out x"),
        (["RUN/best.ckpt", "a.bag", "--out", "x"], "rcnn-odom run a.bag --model RUN/best.ckpt --out x"),
        (["--live", "net.onnx"], "rcnn-odom run --model net.onnx --live"),
        (
            ["a.onnx", "b.bag", "--out", "x", "--height", "-0.1:0.1", "--laser-pose", "-1", "0", "90"],
            "rcnn-odom run b.bag --model a.onnx --out x --laser-pose -1 0 90 --height -0.1:0.1",
        ),
    ],
)
def test_the_order_of_earlier_versions_is_answered_with_the_new_command(old, new, capsys):
    assert main(["run", *old]) == 1
    answer = capsys.readouterr().err
    assert answer == (f"rcnn-odom: error: the recording comes first, and the model is an option: {new}\n")


def test_a_recording_that_is_not_there(model, tmp_path, capsys):
    assert main(["run", str(tmp_path / "none"), "--model", model, "--out", str(tmp_path / "out")]) == 1
    assert "no such file or folder" in capsys.readouterr().err


def test_models_that_are_none(tmp_path, capsys):
    for model in ("rcnn_huge", str(tmp_path / "none.ckpt")):
        assert main(["run", "--model", model, str(tmp_path), "--out", str(tmp_path / "out")]) == 1
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
        "robot.bag: scan 5: its beams lie from 0 to 179 degrees, one every 1, but the sensor's lie from -90 "
        "to 90 degrees, one every 1; take --model matcher, which fits any laser, or train a model on "
        "recordings of such a laser (rcnn-odom train data=... data.sensor.field_of_view_deg=180 "
        "data.sensor.resolution_deg=1 data.sensor.facing_deg=90)"
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
        # The same scans as the next one's, but the first two are none: two steps less. The third has less
        # than half of the beams, which lie as those after it.
        ("slow_start.bag", 40, 31.9, {"no returns": 2}),
        ("range_max_0.bag", 40, 33.7, {}),
        ("foreign_topic.bag", 10, 7.8, {}),
    ],
)
def test_cases_that_are_read(tmp_path, name, scans, metres, degraded):
    """By a network, over the length that scan matching finds."""
    assert main(["run", "--model", "all_round", str(case(name)), "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["scans"], summary["degraded"]) == (scans, degraded)
    assert summary["path_m"] == pytest.approx(metres, rel=0.02)


def test_a_scan_of_too_few_beams_is_left_out_by_a_network_that_needs_all(velodyne, tmp_path):
    case_, out = case("slow_start.bag"), tmp_path / "out"
    assert main(["run", "--model", velodyne, str(case_), "--out", str(out)]) == 0
    degraded = json.loads((out / "summary.json").read_text())["degraded"]
    assert degraded == {"no returns": 2, "other laser": 1}


def test_a_laser_that_sees_the_left_half_is_refused_or_read_whole(model, tmp_path, capsys):
    path, sensor = case("left_half.bag"), Sensor(1.0, 180.0, 80.0, facing_deg=90)
    assert main(["run", "--model", model, str(path), "--out", str(tmp_path / "out")]) == 1
    assert "its beams lie from 0 to 179 degrees" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    write(to_onnx(build(sensor=sensor), "fp32"), tmp_path / "left.onnx")
    assert (
        main(["run", "--model", str(tmp_path / "left.onnx"), str(path), "--out", str(tmp_path / "out")]) == 0
    )
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["scans"] == 120
    assert not {"other laser", "few returns"} & summary["degraded"].keys()


def test_scan_matching_of_the_left_half_follows_the_drive(tmp_path):
    """The same drive as a log's, whose poses are the reference: 1.26 rad of turns on 5.8 m."""
    assert main(["run", str(case("left_half.bag")), "--out", str(tmp_path / "out")]) == 0
    steps = np.array([step["step"] for step in steps_in(tmp_path / "out")[1:]])
    truth = carmen.load("robotlaser_neg_res", root=case("robotlaser_neg_res.log.gz").parent)
    expected = relative_steps(truth.poses)
    assert np.abs(steps[:, 2]).sum() == pytest.approx(np.abs(expected[:, 2]).sum(), rel=0.05)
    assert np.hypot(*steps[:, :2].T).sum() == pytest.approx(np.hypot(*expected[:, :2].T).sum(), rel=0.1)


def test_a_whole_drive_has_the_poses_of_the_command(tmp_path):
    """`evaluate.py model=matcher` estimates with this, the command with a stream."""
    make_kitti(tmp_path, ["05"], frames=15)
    out = tmp_path / "out"
    assert main(["run", str(tmp_path / "sequences" / "05"), "--out", str(out)]) == 0
    drive = Drive.unencoded(kitti.load("05", root=tmp_path))
    estimate = find_model("matcher")({}, SENSOR).estimate(drive)
    streamed = np.array([step["step"] for step in steps_in(out)])
    np.testing.assert_array_equal(streamed[1:], estimate.values)
    assert np.abs(streamed[1:]).sum() > 1
    covariances = np.array([step["covariance"] for step in steps_in(out)], dtype=float)
    np.testing.assert_array_equal(covariances[1:], estimate.covariances)


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


ROUND = 250
"""Number of scans in a round of :func:`_drive_rounds_in_a_room`."""


@pytest.mark.slow
def test_scan_matching_stays_as_small_and_fast_as_it_began(tmp_path):
    """20,000 scans, 80 rounds in a room with boxes: the map and what is kept must not grow."""
    # In a process of its own, whose memory no other test has left in pieces.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        summary, seconds, megabytes = pool.submit(_drive_rounds_in_a_room, tmp_path / "out").result()
    assert summary["degraded"] == {}
    assert summary["path_m"] == pytest.approx(20_000 / ROUND * 2 * np.pi * 3.0, rel=0.02)
    assert megabytes[19_999] - megabytes[2000] < 8, megabytes
    first, last = np.median(seconds[:1000]), np.median(seconds[-1000:])
    assert last < 1.5 * first, (first, last)


def _drive_rounds_in_a_room(folder):
    """Matches 20,000 scans; the summary, the seconds of each scan, and the process's megabytes at two."""
    angles, rng = np.deg2rad(np.arange(-90.0, 91.0)), np.random.default_rng(0)
    clean = [_ranges_in_a_room(3.0, 2 * np.pi * number / ROUND, angles) for number in range(ROUND)]
    seconds, megabytes = [], {}

    def scans():
        for number in range(20_000):
            if number in (2000, 19_999):
                pages = int(Path("/proc/self/statm").read_text().split()[1])
                megabytes[number] = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
            noisy = clean[number % ROUND] + rng.normal(0, 0.01, len(angles))
            start = time.perf_counter()
            yield Scan(noisy, angles, stamp=0.1 * number)
            seconds.append(time.perf_counter() - start)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rcnn_odom.deployment.run.MAP_SCANS", 100)
        patch.setattr("rcnn_odom.deployment.run.LATENCIES", 100)
        summary = run(Odometer(), ScanStream("long", scans()), "matcher", folder)
    return summary, seconds, megabytes


def _ranges_in_a_room(radius, turn, angles):
    """Metres (P,) to the walls of a room of 16 by 12 m and of boxes in it, from a round about its middle."""
    corners = [((-8, -6), (8, 6)), ((-1, -1), (1, 0.5)), ((5, 3), (6, 5)), ((-6, -5), (-5, -4))]
    ways = np.stack([np.cos(angles + turn + np.pi / 2), np.sin(angles + turn + np.pi / 2)], axis=1)
    place, nearest = radius * np.array([np.cos(turn), np.sin(turn)]), np.full(len(angles), np.inf)
    for (left, low), (right, high) in corners:
        for axis, value, start, end in (
            *((0, x, low, high) for x in (left, right)),
            *((1, y, left, right) for y in (low, high)),
        ):
            distance = (value - place[axis]) / np.where(ways[:, axis] == 0, 1e-12, ways[:, axis])
            other = place[1 - axis] + distance * ways[:, 1 - axis]
            hits = (distance > 0) & (start <= other) & (other <= end)
            nearest = np.where(hits, np.minimum(nearest, distance), nearest)
    return nearest


def test_the_map_shows_walls_where_they_are(tmp_path):
    """With true motions the scans of a square room lie on each other."""
    from rcnn_odom.evaluation.figures import map_figure

    odometer = Odometer(PairTracker(_Straight()))
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
    map_figure(np.array(poses), points, np.arange(5.0)).savefig(tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 5000
    # Nothing seen, and nothing moved.
    map_figure(np.zeros((1, 3)), [np.empty((0, 2), np.float32)], np.zeros(1)).savefig(tmp_path / "no.png")


def test_the_map_has_no_ghosts(monkeypatch, tmp_path):
    """While nothing is seen, the walls of the last scan stay where they were."""
    drawn = []

    def map_figure(poses, points, times, clock):
        drawn.extend(points)
        return new_figure(1, 1)[0]

    monkeypatch.setattr("rcnn_odom.deployment.report_pictures.map_figure", map_figure)
    angles = np.deg2rad(np.arange(360) - 180.0)
    x = np.cos(angles)
    wall = [np.where(x > 0.3, (10 - 0.5 * n) / x, 0.0) for n in range(3)]  # it is 10 m ahead at first
    rows = [Scan(scan, angles, stamp=0.1 * n) for n, scan in enumerate([*wall, *[np.zeros(360)] * 5])]
    rows.insert(3, Scan(wall[0], angles, stamp=0.1))  # late
    run(Odometer(PairTracker(_Straight())), ScanStream("room", iter(rows)), "straight", tmp_path / "out")
    assert [len(points) > 0 for points in drawn] == [True] * 3 + [False] * 7, "the last one is the end"
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
        description = Odometer.from_onnx(model).tracker.description

        def reset(self):
            pass

        def __call__(self, pair):
            raise RuntimeError("a fault of the program")

    rows = [Scan(scan) for scan in random_scans(3)]
    with pytest.raises(RuntimeError):
        run(Odometer(PairTracker(Broken())), ScanStream("log", iter(rows)), "tiny", tmp_path / "out")
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


# --- without a network ---------------------------------------------------------------------------


class Asked:
    """A stand-in for the matcher: half a metre ahead and a small turn, whatever it sees."""

    period = float("nan")
    step = Step(0.5, 0.0, 0.1, np.diag([0.01, 0.02, 0.03]) ** 2)
    made = ()

    def __init__(self, wheels=False, deskew=True):
        Asked.made = (wheels, deskew)
        self.wheel_poses = []
        self.reset()

    def reset(self):
        self.has_seen, self._points = False, np.empty((0, 2))

    def begin(self, scan):
        self.has_seen = bool((scan.ranges > 0).any())
        return ()

    def register(self, scan, periods=1, seconds=None):
        self._points = np.column_stack(
            [scan.ranges * np.cos(scan.bearings), scan.ranges * np.sin(scan.bearings)]
        )
        return Registered(self.step)

    def returns(self):
        return self._points


@pytest.fixture
def asked(monkeypatch):
    """The command with a stand-in in place of the matcher."""
    monkeypatch.setattr("rcnn_odom.models.matcher.MatcherTracker", Asked)
    return Asked


def test_without_a_model_it_is_the_matcher_for_any_laser(asked, tmp_path, capsys):
    """A laser of 91 beams aside, which fits no shipped network."""
    angles = np.deg2rad(np.arange(0.0, 91.0))
    lines = [
        {"stamp": 0.1 * n, "ranges": [5.0] * 91, "angle_min": 0.0, "angle_increment": float(angles[1])}
        for n in range(8)
    ]
    (tmp_path / "scans.jsonl").write_text("\n".join(map(json.dumps, lines)))
    assert main(["run", str(tmp_path / "scans.jsonl"), "--out", str(tmp_path / "out")]) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["model"], summary["scans"], summary["laser_pose"]) == ("matcher", 8, None)
    assert summary["path_m"] == pytest.approx(3.5)
    assert asked.made == (False, True)
    assert "path     8 scans, 3.5 m driven; ended " in capsys.readouterr().out
    covariance = np.array(steps_in(tmp_path / "out")[-1]["pose_covariance"])
    assert np.linalg.eigvalsh(covariance).min() > 0


@pytest.mark.parametrize(
    ("words", "compensated", "deskew"),
    [([], False, True), ([], True, False), (["on"], True, True), (["off"], False, False)],
)
def test_deskewing_is_left_out_where_the_recording_has_done_it(
    asked, monkeypatch, tmp_path, words, compensated, deskew
):
    stream = replace(scans_of(*[FULL] * 4), is_compensated=compensated)
    monkeypatch.setattr("rcnn_odom.recordings.formats.open_stream", lambda path, options: stream)
    options = ["--deskew", *words] if words else []
    assert main(["run", "drive", "--out", str(tmp_path / "out"), *options]) == 0
    assert asked.made == (False, deskew)


def test_every_third_scan_in_two_ways(asked, tmp_path, capsys):
    make_carmen(tmp_path, "robot", frames=31)
    log = str(tmp_path / "robot.log")
    for arguments in ([log, "--every", "3"], [f"{log}[::3]"]):
        out = tmp_path / f"out{len(arguments)}"
        assert main(["run", *arguments, "--out", str(out)]) == 0
        stamps = carmen.load("robot", root=tmp_path).stamps[::3]
        assert [step["stamp"] for step in steps_in(out)] == stamps.tolist()
    with pytest.raises(SystemExit):
        main(["run", f"{log}[::3]", "--every", "3", "--out", str(tmp_path / "b")])
    assert "--every and [::3] have the same meaning" in capsys.readouterr().err


def test_the_poses_of_a_robot_whose_laser_sits_aside(asked, tmp_path, capsys):
    """The robot's motion is worked out with matrices."""
    make_carmen(tmp_path, "robot", frames=12)
    command = ["run", str(tmp_path / "robot.log"), "--laser-pose", "-0.3", "0.1", "-90"]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    on_robot, step = planar_to_poses([[-0.3, 0.1, -np.pi / 2], [0.5, 0.0, 0.1]])
    poses = [np.eye(4)]
    for _ in range(11):
        poses.append(poses[-1] @ on_robot @ step @ np.linalg.inv(on_robot))
    steps = steps_in(tmp_path / "out")
    got = planar_to_poses([[each["x"], each["y"], each["heading"]] for each in steps])
    np.testing.assert_allclose(got, poses, atol=1e-9)
    camera = change_frame(np.array(poses), FORWARD_CAMERA)
    np.testing.assert_allclose(read_kitti(tmp_path / "out" / "trajectory.txt"), camera, atol=1e-9)
    assert " m driven by the robot; ended " in capsys.readouterr().out
    page = (tmp_path / "out" / "report.html").read_text()
    assert "of the robot, with its laser -0.3 m ahead, 0.1 m to the left, turned by -90 degrees" in page
    assert "<th>--laser-pose</th><td>-0.3 0.1 -90</td>" in page


def test_the_wheels_of_a_log_or_none(asked, monkeypatch, tmp_path, capsys):
    with_wheels = [Scan(np.full(181, 5.0), np.deg2rad(FULL), wheel_pose=(0.1 * n, 0, 0)) for n in range(5)]
    for rows, status in ((with_wheels, 0), ([replace(each, wheel_pose=None) for each in with_wheels], 1)):
        stream = ScanStream("robot.log", iter(rows))
        monkeypatch.setattr("rcnn_odom.recordings.formats.open_stream", lambda path, options, it=stream: it)
        assert main(["run", "robot.log", "--wheels", "--out", str(tmp_path / f"out{status}")]) == status
    assert len(steps_in(tmp_path / "out0")) == 5
    assert asked.made == (True, True)
    assert (
        "robot.log: its scans have no wheel odometry; leave out --wheels; for a bag, name its topic "
        "with --odom-topic" in capsys.readouterr().err
    )


def test_a_bag_that_tells_of_its_robot(asked, monkeypatch, tmp_path, capsys):
    """Its /tf_static by --base, and its odometry by --odom-topic, which is carried over to the laser."""
    store, topics = store_of("mcap"), {"/scan": SCAN, "/tf_static": TRANSFORMS, "/odom": ODOMETRY}
    messages = [
        (
            "/tf_static",
            arrival_of(0),
            static_transforms(store, {("base_link", "laser"): (0.2, -0.1, 0.3, 0, 0, 90)}, False),
        )
    ]
    for number in range(6):
        at = arrival_of(number)
        scan = laser_scan(store, np.full(181, 5.0), START + 0.1 * number, 180.0, False, number)
        wheels = odometry(store, (0.5 * number, 0.0, 0.0), START + 0.1 * number, False)
        messages += [("/odom", at, wheels), ("/scan", at + 1, scan)]
    bag = str(write_bag(tmp_path, "mcap", topics, messages))
    seen, register = [], Asked.register
    monkeypatch.setattr(
        Asked, "register", lambda self, scan, *more: seen.append(scan.wheel_pose) or register(self, scan)
    )
    command = ["run", bag, "--base", "base_link", "--odom-topic", "/odom", "--out", str(tmp_path / "out")]
    assert main(command) == 0
    assert asked.made[0] is True
    np.testing.assert_allclose(seen, [(0.5 * n + 0.2, -0.1, np.pi / 2) for n in range(1, 6)], atol=1e-6)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["laser_pose"] == pytest.approx([0.2, -0.1, np.pi / 2])
    on_robot, step = planar_to_poses([[0.2, -0.1, np.pi / 2], Asked.step.array()])
    last = steps_in(tmp_path / "out")[1]
    np.testing.assert_allclose(
        planar_to_poses([[last["x"], last["y"], last["heading"]]])[0],
        on_robot @ step @ np.linalg.inv(on_robot),
        atol=1e-9,
    )
    seen.clear()
    command = ["run", bag, "--odom-topic", "/odom", "--laser-pose", "1", "0", "0"]
    assert main([*command, "--out", str(tmp_path / "out2")]) == 0
    np.testing.assert_allclose(seen, [(0.5 * n + 1, 0, 0) for n in range(1, 6)], atol=1e-6)
    assert main([*command[:2], "--base", "chassis", "--out", str(tmp_path / "out3")]) == 1
    assert "/tf_static has no frame chassis, only base_link, laser" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--base", "--odom-topic"])
def test_an_option_of_bags_for_another_format(asked, tmp_path, capsys, option):
    make_carmen(tmp_path, "robot", frames=5)
    log = str(tmp_path / "robot.log")
    assert main(["run", log, option, "/name", "--out", str(tmp_path / "out")]) == 1
    name = option.removeprefix("--").replace("-", "_")
    assert capsys.readouterr().err == (
        f"rcnn-odom: error: {log}: read as carmen, which has no option {name}; leave it out\n"
    )
    assert not (tmp_path / "out").exists()


def test_ranges_without_angles_are_refused(asked, monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdin", iter([json.dumps({"ranges": [5.0] * 181})] * 2))
    assert main(["run", "--live"]) == 1
    assert "standard input: its first scan has no angles; give angle_min and" in capsys.readouterr().err


def test_one_line_without_angles_ends_no_run(asked, monkeypatch, capsys):
    good = {"ranges": [5.0] * 181, "angle_min": -1.5708, "angle_increment": 0.0174533}
    rows = [good, good, {"ranges": [5.0] * 181}, good]
    monkeypatch.setattr(sys, "stdin", iter(map(json.dumps, rows)))
    assert main(["run", "--live"]) == 0
    printed = capsys.readouterr()
    assert len(printed.out.splitlines()) == 3
    assert "skipped: 1 scans without angles" in printed.err


@pytest.mark.parametrize(("deskew", "last"), [("on", 0.1 * 180 / 360), ("auto", None)])
def test_the_time_of_a_turn_counts_where_a_user_says_so(asked, monkeypatch, deskew, last):
    """Depth cameras, which see all at once, write it as well."""
    seen, register = [], Asked.register
    monkeypatch.setattr(
        Asked, "register", lambda self, scan, *more: seen.append(scan.times) or register(self, scan)
    )
    row = {"ranges": [5.0] * 181, "angle_min": -np.pi / 2, "angle_increment": np.pi / 180, "scan_time": 0.1}
    monkeypatch.setattr(sys, "stdin", iter([json.dumps(row)] * 3))
    assert main(["run", "--live", "--deskew", deskew]) == 0
    assert len(seen) == 2
    assert seen[0] is None if last is None else seen[0][-1] == pytest.approx(last)


def test_the_name_that_the_matcher_had(capsys):
    assert main(["run", "a.bag", "--out", "x", "--model", "icp"]) == 1
    assert capsys.readouterr().err == (
        "rcnn-odom: error: --model icp is now --model matcher, the default; leave out --model\n"
    )


LINE = np.deg2rad(np.arange(-80.0, 81.0))
BAD = {
    "empty": [Scan(np.empty(0), np.empty(0))] * 9,
    "all inf": [Scan(np.full(181, np.inf), np.deg2rad(FULL))] * 9,
    "all nan": [Scan(np.full(181, np.nan), np.deg2rad(FULL))] * 9,
    "one beam": [Scan(np.array([5.0 - 0.1 * n]), np.zeros(1)) for n in range(9)],
    "a line": [Scan(3 / np.cos(LINE), LINE) for _ in range(9)],
    "counts": [
        Scan(np.full(60 + 40 * (n % 3), 5.0), np.linspace(-1, 1, 60 + 40 * (n % 3))) for n in range(9)
    ],
    "some nan": [Scan(np.where(np.arange(181) % 7 > n, 5.0, np.nan), np.deg2rad(FULL)) for n in range(9)],
    "same way": [Scan(np.full(50, 5.0), np.zeros(50))] * 9,
    "two frames": [Scan(np.full(181, 5.0), np.deg2rad(FULL), frame_id="ab"[n % 2]) for n in range(9)],
}


@pytest.mark.parametrize("stamps", ["even", "equal", "none", "backwards"])
@pytest.mark.parametrize("kind", BAD)
def test_bad_input_is_one_line_or_poses(tmp_path, kind, stamps):
    """With the matcher itself, whatever it makes of it."""
    times = {"even": 0.1 * np.arange(9), "equal": np.full(9, 5.0), "backwards": 9 - 0.1 * np.arange(9)}
    of_scans = times.get(stamps, [None] * 9)
    rows = [replace(scan, stamp=stamp) for scan, stamp in zip(BAD[kind], of_scans, strict=True)]
    try:
        summary = run(Odometer(), ScanStream("bad", iter(rows)), "matcher", tmp_path / "out")
    except InputError as error:
        refusal = str(error)
    else:
        refusal = ""
    if refusal:
        assert "\n" not in refusal
        assert ";" in refusal
        return
    steps = steps_in(tmp_path / "out")
    assert summary["scans"] == len(steps) == 9
    assert np.isfinite([[step["x"], step["y"], step["heading"]] for step in steps]).all()


BLOCKED = ("torch", "lightning", "pytorch_lightning", "hydra", "omegaconf")
FORBID = f"import sys; sys.modules.update(dict.fromkeys({BLOCKED!r}))"


@pytest.mark.parametrize("words", [[], ["--model", "all_round"], ["--model", "fused"]])
def test_the_command_needs_no_pytorch(tmp_path, words):
    make_kitti(tmp_path, ["05"], frames=4)
    command = ["run", str(tmp_path / "sequences" / "05"), *words, "--out", str(tmp_path / "out")]
    code = f"{FORBID}; from rcnn_odom.cli import main; main({command!r})"
    code += "; sys.exit('onnxruntime' in sys.modules)" if not words else ""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
    assert (tmp_path / "out" / "trajectory.txt").exists()


def test_nothing_in_deployment_needs_pytorch_or_lightning(tmp_path):
    code = f"""{FORBID}
from pathlib import Path

import numpy as np

from rcnn_odom.deployment import odometer, run, sampling, shipped
from rcnn_odom.geometry import Step
from rcnn_odom.models.contract import Description, Registered, find_model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.onnx_stepper import OnnxStepper
from rcnn_odom.models.pairs import PairTracker
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
summary = run.run(odometer.Odometer(PairTracker(Straight())), stream, "straight", out)
assert (summary["scans"], summary["path_m"], summary["degraded"]) == (4, 1.5, {{}})
assert not [name for name in {BLOCKED!r} if sys.modules[name]]
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)
    assert {path.name for path in tmp_path.iterdir()} == FILES
