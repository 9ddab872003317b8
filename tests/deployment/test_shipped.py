"""The trained networks that ship with the project."""

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
from rcnn_odom.recordings import carmen, kitti, simulated
from rcnn_odom.recordings.recording import Drive

NETWORKS = {"all_round": Sensor(), "half_circle": Sensor(0.25, 270.0, 40.0)}
REAL, LOGS = SHARED / "data" / "kitti", SHARED / "data" / "carmen"


def test_they_are_small_and_found_by_their_names():
    assert shipped_models() == list(NETWORKS)
    assert sum(find_file(name).stat().st_size for name in NETWORKS) < 10e6
    with pytest.raises(InputError, match=r"nor a model that ships with rcnn-odom \(all_round, half_circle\)"):
        find_file("rcnn_large")


@pytest.mark.parametrize("name", NETWORKS)
def test_each_says_how_it_is_used(name):
    description = OnnxStepper(find_file(name)).description
    assert description.sensor == NETWORKS[name]
    assert description.warping is not None
    assert np.isfinite([*description.typical_step, *description.typical_change]).all()
    assert np.isnan(description.period), "scans may come at any rate"


@pytest.mark.parametrize("name", NETWORKS)
def test_each_has_a_card(name):
    card = (FOLDER / f"{name}.md").read_text()
    assert card.startswith(f"# {name}\n")
    assert re.findall("^## (.+)$", card, re.MULTILINE) == ["Data", "Drift", "Uncertainty", "Speed", "Limits"]


@pytest.mark.parametrize("name", NETWORKS)
def test_the_card_tells_the_drift_that_the_file_does(name):
    scored = OnnxStepper(find_file(name)).metadata.get("drift")
    if scored is None:
        pytest.skip(f"{name}.onnx was exported with --no-drift")
    card = (FOLDER / f"{name}.md").read_text()
    for ratio in (scored["mean"], *scored["sequences"].values()):
        assert f"{100 * ratio:.2f}" in card


def follow(name, drive):
    """Poses (N, 4, 4) of a drive by a shipped network, which finds nothing unusual."""
    odometer = Odometer.from_onnx(name)
    poses = [odometer.step(scan) for scan in drive.raw_scans()]
    assert not {pose.degraded for pose in poses} - {""}
    return np.array([pose.matrix() for pose in poses])


def drift_of(name, drive, lengths):
    """Its drift on a drive, a ratio."""
    estimate, truth = (
        change_frame(poses, drive.camera_from_laser)
        for poses in (follow(name, drive), np.linalg.inv(drive.poses[0]) @ drive.poses)
    )
    result = drift(truth, estimate, planar=True, lengths=lengths)
    assert result.segments > 5
    return result.t_err


@pytest.mark.parametrize("laser", [{"kind": "hdl64"}, {"kind": "regular", "spacing_deg": 0.13}])
def test_all_round_follows_a_simulated_street(laser):
    """A drive that no training has seen: another world, its first 150 frames."""
    street = simulated.load("05", scale="small", frames=150, seed=77, laser=laser)
    assert drift_of("all_round", Drive.unencoded(street), [25.0, 50.0]) < 0.01


@pytest.mark.parametrize(
    "laser", [{"kind": "sick"}, {"kind": "sick", "spacing_deg": 0.5}, {"kind": "hokuyo"}], ids=str
)
def test_half_circle_follows_a_robot_in_a_simulated_building(laser):
    """Without stamps, whose jitter indoors is at times taken for a gap."""
    building = simulated.load("05", world="indoor", frames=300, seed=77, laser=laser)
    drive = replace(Drive.unencoded(building), has_clock=False)
    assert drift_of("half_circle", drive, [2.0, 5.0]) < 0.1


def test_half_circle_follows_a_real_robot():
    """A stretch of aces, which was not trained on; the reference itself errs by some centimetres."""
    if not LOGS.is_dir():
        pytest.skip(f"no real recordings at {LOGS}")
    aces = Drive.unencoded(carmen.load("aces", root=LOGS, reference=LOGS / "reference"))
    assert drift_of("half_circle", aces.part(2000, 2300), [2.0, 5.0]) < 0.2


def test_all_round_runs_on_real_frames(tmp_path):
    if not REAL.is_dir():
        pytest.skip(f"no real recordings at {REAL}")
    out = tmp_path / "out"
    assert main(["run", str(REAL / "sequences" / "90"), "--model", "all_round", "--out", str(out)]) == 0
    steps = [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]
    truth = kitti.load("90", root=REAL)
    end = np.linalg.inv(truth.poses[0]) @ truth.poses[-1]
    error = np.hypot(steps[-1]["x"] - end[0, 3], steps[-1]["y"] - end[1, 3])
    assert error / 48.1 < 0.03, "a constant motion ends 25 % of the way off"
    assert not any(step["degraded"] for step in steps)
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["model"], summary["scans"]) == ("all_round", 40)
