"""The table of methods on sets of recordings, from the command line's configuration to its files."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from conftest import ROOT, SHARED
from evaluate import evaluate
from odometry import build
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import Step, planar_to_poses
from rcnn_odom.models.contract import Registered
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.options import check_options
from rcnn_odom.recordings.formats import open_recording
from rcnn_odom.recordings.parts import parse_part
from rcnn_odom.recordings.recording import Drive, Recording
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.training.benchmark.measure import run_timed, score_timed
from rcnn_odom.training.benchmark.methods import find_method
from rcnn_odom.training.benchmark.sets import LoadedSet, SetOptions
from rcnn_odom.training.benchmark.table import as_markdown, as_text
from rcnn_odom.training.onnx_graph import to_onnx, write
from rcnn_odom.training.settings import plain

SHORT = [
    "benchmark.sets.street.reader.frames=30",
    "benchmark.sets.indoor.reader.frames=30",
    "benchmark.sets.indoor.lengths=[0.5]",
    "benchmark.root=nowhere",
]


@pytest.fixture
def measure_method(configure):
    def run(method, *options):
        overrides = ["benchmark=quick", f"benchmark.method={method}", *SHORT, *options]
        return evaluate(configure(*overrides, name="evaluate", run=method))

    return run


def test_a_method_is_measured_on_every_set_that_is_there(measure_method, tmp_path, caplog):
    pytest.importorskip("kiss_icp", reason="kiss-icp is not installed")
    caplog.set_level("INFO")
    metrics = measure_method("kiss_icp")
    folder = tmp_path / "outputs" / "kiss_icp"
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    assert list(metrics["benchmark"]) == ["street", "indoor"]
    assert "kitti 90 is left out: nowhere/kitti: no such folder" in caplog.text
    street = metrics["benchmark"]["street"]
    assert (street["scans"], street["failures"], street["errors"]) == (30, 0, 0)
    assert street["drift"] < 0.05
    assert street["path_ratio"] == pytest.approx(1, abs=0.03)
    assert 0 < street["median_ms"] <= street["p99_ms"]
    rows = json.loads((folder / "benchmark.json").read_text())["rows"]
    assert rows == {"kiss_icp": metrics["benchmark"]}
    assert "| kiss_icp |" in (folder / "benchmark.md").read_text()
    assert as_text(rows) in caplog.text


@pytest.mark.parametrize(
    ("network", "of_its_laser", "of_another"),
    [("all_round", "street", "indoor"), ("half_circle", "indoor", "street"), ("tiny", "indoor", "street")],
)
def test_a_network_has_a_row_on_the_sets_of_its_laser(
    measure_method, tmp_path, caplog, network, of_its_laser, of_another
):
    caplog.set_level("INFO")
    if network == "tiny":  # of those that are given encoded scans as they are
        network = str(tmp_path / "tiny.onnx")
        write(to_onnx(build(sensor=Sensor(1.0, 180.0, 40.0)), "fp32"), Path(network))
    metrics = measure_method(network)
    assert list(metrics["benchmark"]) == [of_its_laser]
    assert f"{network}: {of_another} is of a laser that it was not trained for" in caplog.text


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("nobody", [], "no model is called nobody; there are"),
        ("karto", ["benchmark.only=[roof]"], "no set of benchmark.sets is called roof; there are indoor"),
        ("cnn_reg", [], "benchmark.method=cnn_reg: this network needs training; give a run"),
        ("karto", ["+benchmark.options.cell=1"], "benchmark.options.cell: there is no such option"),
        ("karto", ["+benchmark.options.voxel=0"], "benchmark.options.voxel=0: must be a number above 0"),
        (
            "karto",
            ["benchmark.sets.street.lengths=[]"],
            r"benchmark.sets.street.lengths=\[\]: must be a list",
        ),
        ("karto", ["+benchmark.sets.street.size=1"], "benchmark.sets.street.size: there is no such option"),
    ],
)
def test_mistakes_are_told_in_a_line(measure_method, method, options, message):
    with pytest.raises(InputError, match=message):
        measure_method(method, *options)


class Walking:
    """A tracker that says 1 m ahead for every scan, but once 1.6 m, once a turn, once an error."""

    period = float("nan")
    has_seen = False

    def reset(self):
        self.has_seen, self.count = False, 0

    def begin(self, scan):
        self.has_seen = True
        return ()

    def register(self, scan, periods=1, seconds=None):
        self.count += 1
        if self.count == 8:
            return Registered(Step(1.0, 0.0, 0.0), ("error: walking: lost",), is_estimated=False)
        return Registered(
            Step(1.6 if self.count == 3 else 1.0, 0.0, np.deg2rad(6.0) if self.count == 5 else 0.0)
        )


def walked_set(**options):
    """Ten steps of 1 m straight ahead."""
    poses = planar_to_poses([(frame, 0.0, 0.0) for frame in range(11)])
    recording = Recording("walk", poses, np.arange(11.0), lambda frame: Scan(np.ones(5)), "key")
    options = {"lengths": [5.0], "frames": None, "relations": None} | options
    return LoadedSet(
        options, recording, Drive.unencoded(recording), [Scan(np.ones(5), stamp=t) for t in range(11)]
    )


def test_failures_and_the_path_are_those_of_the_truth():
    loaded = walked_set(frames=[6, 7])
    timed = run_timed(Walking(), loaded)
    assert len(timed.milliseconds) == 10
    scores = score_timed(timed, loaded)
    assert (scores["failures"], scores["errors"]) == (3, 1)
    assert scores["path_ratio"] == pytest.approx(10.6 / 10)
    assert scores["stretch"]["path_m"] == pytest.approx(2.0)
    assert scores["stretch"]["end_ratio"] == pytest.approx(0.0, abs=1e-12)


def test_relations_are_found_in_a_part_of_a_recording(tmp_path):
    """The relation between scans 4 and 6 says 2.1 m; that between 0 and 4 lies outside of the part."""
    (tmp_path / "walk.relations").write_text("4 6 2.1 0 0 0 0 0\n0 4 4 0 0 0 0 0\n")
    loaded = walked_set(relations=str(tmp_path / "walk.relations"))
    recording = replace(loaded.recording, wheel_odometry=loaded.recording.poses)
    loaded = LoadedSet(loaded.options, recording, loaded.drive.part(3, 11), loaded.scans[3:])
    relations = score_timed(run_timed(Walking(), loaded), loaded)["relations"]
    assert relations["not_in_estimate"] == 1
    # Steps to scans 5 and 6 are the second and the third of the part: 1 and 1.6 m.
    assert relations["sequential"]["translation_mean_m"] == pytest.approx(0.5)


def test_the_table_has_a_row_for_each_method():
    one = {"drift": 0.0123, "median_ms": 1.0, "p99_ms": 2.5, "failures": 0, "errors": 0, "path_ratio": 0.998}
    lost = one | {"drift": None, "failures": 12, "errors": 2, "path_ratio": 0.0}
    sequential = {"count": 3, "translation_mean_m": 0.046, "rotation_mean_deg": 0.35}
    rows = {"ours": {"a": one, "b": one | {"relations": {"sequential": sequential}}}, "theirs": {"a": lost}}
    text = as_text(rows)
    drift, times, failures, path, relations = [part.splitlines() for part in text.split("\n\n")]
    assert drift[0].split() == ["drift,", "%", "a", "b"]
    assert [line.split() for line in drift[1:]] == [["ours", "1.23", "1.23"], ["theirs", "-", "-"]]
    assert times[1].split() == ["ours", *["1.00", "/", "2.50"], *["1.00", "/", "2.50"]]
    assert failures[2].split() == ["theirs", "12", "(2", "errors)", "-"]
    assert path[2].split() == ["theirs", "0.000", "-"]
    # Only the columns that have such a score.
    assert relations[0].split()[-1] == "b"
    assert relations[1].endswith("4.6 cm, 0.35 deg")
    page = as_markdown(rows, {"processor": "x"})
    assert "- processor: x" in page
    assert "| ours | 1.23 | 1.23 |" in page


def test_every_set_of_the_shipped_tables_can_be_read(configure):
    """Of those on disk the first scan is one of the laser that the set says."""
    if not (SHARED / "data").is_dir():
        pytest.skip(f"no recordings in {SHARED}/data")
    read = 0
    for name in ("full", "voxels_outdoors", "voxels_indoors"):
        cfg = configure(
            f"benchmark={name}", "benchmark.method=karto", f"benchmark.root={SHARED}/data", name="evaluate"
        )
        for title, options in plain(cfg)["benchmark"]["sets"].items():
            check_options(SetOptions, options, f"benchmark.sets.{title}.")
            sensor = Sensor(**options["sensor"])
            if "root" not in options["reader"]:
                continue
            recording = open_recording(options["reader"])(parse_part(options["recording"])[0])
            scan = recording.read_scan(0)
            bearings = sensor.bearings_of(scan)
            assert np.abs(np.rad2deg(bearings)).max() <= sensor.field_of_view_deg / 2 + 0.5, title
            spacing = np.rad2deg(np.median(np.abs(np.diff(bearings))))
            assert spacing == pytest.approx(sensor.resolution_deg, rel=0.01) or title.startswith("kitti")
            read += 1
    assert read > 10


def test_the_shipped_networks_share_the_sets_of_the_table(configure):
    """By the first scan of each: every set is of a laser that just one of them was trained for."""
    if not (SHARED / "data").is_dir():
        pytest.skip(f"no recordings in {SHARED}/data")
    root = f"benchmark.root={SHARED}/data"
    cfg = configure("benchmark=full", "benchmark.method=all_round", root, name="evaluate")
    make = {name: find_method(name, {}, {}) for name in ("all_round", "half_circle")}
    measured = {}
    for title, options in plain(cfg)["benchmark"]["sets"].items():
        recording = open_recording(options["reader"])(parse_part(options["recording"])[0])
        loaded = LoadedSet(options, recording, Drive.unencoded(recording), [recording.read_scan(0)])
        measured[title] = [name for name in make if make[name](loaded)]
        turns_round = options["sensor"]["field_of_view_deg"] == 360
        assert measured[title] == ["all_round" if turns_round else "half_circle"], title
    assert measured["sim 05"] == measured["kitti 90"] == ["all_round"]
    assert measured["ual"] == measured["aces"] == measured["freiburg-101"] == ["half_circle"]


@pytest.mark.slow
def test_the_sweep_writes_one_table(tmp_path):
    command = [sys.executable, "evaluate.py", "-m", "+sweeps=peers", "benchmark=quick", *SHORT]
    done = subprocess.run(
        [*command, f"outputs={tmp_path}", "benchmark.method=kiss_icp,matcher,all_round,half_circle"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "peers" / "benchmark.json").read_text())["rows"]
    assert list(rows) == ["kiss_icp", "matcher", "all_round", "half_circle"]
    assert done.stdout.count("drift, %") == 1
    assert f"also in {tmp_path}/peers/benchmark.md" in done.stdout
