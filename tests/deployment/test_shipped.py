"""The trained network that ships with the project."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from conftest import SHARED
from rcnn_odom.cli import main
from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.deployment.shipped import FOLDER, find_file, shipped_models
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import drift
from rcnn_odom.geometry import change_frame
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.onnx_stepper import OnnxStepper
from rcnn_odom.recordings import kitti, simulated

REAL = SHARED / "data" / "kitti"


def test_it_is_small_and_told_of():
    assert shipped_models() == ["rcnn_small"]
    assert find_file("rcnn_small").stat().st_size < 10e6
    stepper = OnnxStepper(find_file("rcnn_small"))
    assert stepper.metadata["precision"] == "int8"
    assert stepper.description.sensor == Sensor()
    card = (FOLDER / "rcnn_small.md").read_text()
    mean = stepper.metadata["drift"]["mean"]
    assert f"{100 * mean:.2f} %" in card, "the card tells the drift that the file does"
    with pytest.raises(InputError, match=r"nor a model that ships with rcnn-odom \(rcnn_small\)"):
        find_file("rcnn_large")


def test_it_estimates_simulated_streets():
    """A drive that no training has seen: another world, its first 150 frames."""
    sequence = simulated.load("05", scale="small", frames=150, seed=77)
    odometer = Odometer.from_onnx("rcnn_small")
    poses = []
    for frame in range(150):
        pose = odometer.step(replace(sequence.read_scan(frame), stamp=float(sequence.stamps[frame])))
        assert pose.degraded == ""
        poses.append(pose.matrix())
    estimate, truth = (
        change_frame(every, sequence.camera_from_laser)
        for every in (np.array(poses), np.linalg.inv(sequence.poses[0]) @ sequence.poses)
    )
    result = drift(truth, estimate, planar=True, lengths=[25.0, 50.0])
    assert result.segments > 5
    assert result.t_err < 0.15


def test_it_runs_on_real_frames(tmp_path, capsys):
    if not REAL.is_dir():
        pytest.skip(f"no real recordings at {REAL}")
    out = tmp_path / "out"
    assert main(["run", str(REAL / "sequences" / "90"), "--model", "rcnn_small", "--out", str(out)]) == 0
    steps = [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]
    truth = kitti.load("90", root=REAL)
    end = np.linalg.inv(truth.poses[0]) @ truth.poses[-1]
    error = np.hypot(steps[-1]["x"] - end[0, 3], steps[-1]["y"] - end[1, 3])
    assert error / 48.1 < 0.15, "a constant motion ends 25 % of the way off"
    assert not any(step["degraded"] for step in steps)
    assert re.search(r"90: 40 scans, \d+\.\d m by rcnn_small", capsys.readouterr().out)
