"""``rcnn-odom export`` on a trained run."""

import json
import shutil

import numpy as np
import pytest
import torch

from odometry import random_scans
from rcnn_odom.cli import main
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import BEST, METRICS
from rcnn_odom.models.onnx_stepper import OnnxStepper
from rcnn_odom.models.trained import TorchStepper
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.training import export as export_job
from rcnn_odom.training.checkpoint import load_module
from train import train


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Where the first test leaves the run that it has trained."""
    return tmp_path_factory.mktemp("trained") / "run"


@pytest.fixture
def run(configure, kitti, tmp_path, trained):
    """The folder of a trained run, for each test a copy of its own."""
    if not trained.exists():
        train(configure("model=rcnn_reg", "model.projection=16", *kitti))
        shutil.copytree(tmp_path / "outputs" / "run", trained)
    return shutil.copytree(trained, tmp_path / "copy" / "run")


@pytest.mark.slow
def test_export_prints_the_drift_of_each_precision(run, capsys, monkeypatch):
    monkeypatch.setattr(export_job, "MAX_ADDED_DRIFT", 1.0)  # two epochs on 60 frames: int8 may cost anything
    expected = json.loads((run / METRICS).read_text())["test"]["drift"]
    capsys.readouterr()
    assert main(["export", str(run / BEST), "--format", "onnx", "--quantize", "int8"]) == 0
    printed = capsys.readouterr().out
    rows = {
        line.rsplit(None, 2)[0]: float(line.split()[-1])
        for line in printed.splitlines()
        if "onnx" in line[:5]
    }
    assert rows["onnx fp32"] == pytest.approx(100 * expected, abs=0.011)
    assert "checkpoint" in printed
    told = OnnxStepper(run / "model_int8.onnx").metadata["drift"]
    assert told["data"] == "kitti"
    assert 100 * told["mean"] == pytest.approx(rows["onnx int8"], abs=0.01)
    assert not (run / "model.onnx").exists()
    assert main(["export", str(run)]) == 0
    assert OnnxStepper(run / "model.onnx").metadata["drift"]["mean"] == pytest.approx(expected, abs=1e-4)


@pytest.mark.slow
def test_a_precision_that_costs_too_much_is_not_written(run, capsys, monkeypatch):
    monkeypatch.setattr(export_job, "MAX_ADDED_DRIFT", -1.0)
    assert main(["export", str(run), "--quantize", "int8"]) == 1
    assert "percentage points of drift, more than -100, and is not written" in capsys.readouterr().err
    assert not list(run.glob("*.onnx"))


def test_a_checkpoint_of_a_stopped_training_gets_its_uncertainty_in_the_file_alone(run):
    fitted = load_module(run / BEST).model
    assert fitted.calibrated, "train.py has fitted it"
    saved = torch.load(run / BEST, weights_only=True)
    for name in ("uncertainty.weights", "uncertainty.lateral", "least_filled", "period"):
        saved["state_dict"][f"model.{name}"].fill_(torch.nan)
    torch.save(saved, run / BEST)
    before = (run / BEST).read_bytes()
    assert main(["export", str(run)]) == 0
    assert (run / BEST).read_bytes() == before
    exported, pair = OnnxStepper(run / "model.onnx"), random_scans(2, bins=361)
    np.testing.assert_allclose(exported(pair).covariance, TorchStepper(fitted)(pair).covariance, rtol=1e-3)
    assert exported.description.least_filled == pytest.approx(float(fitted.least_filled))


def test_without_recordings_the_drift_can_be_left_out(run, capsys, tmp_path):
    alone = tmp_path / "alone" / "checkpoints" / "best.ckpt"
    alone.parent.mkdir(parents=True)
    alone.write_bytes((run / BEST).read_bytes())
    assert main(["export", str(alone)]) == 1
    assert "config.yaml" in capsys.readouterr().err
    out = tmp_path / "deep" / "model.onnx"
    assert main(["export", str(alone), "--no-drift", "--out", str(out)]) == 0
    assert "drift" not in OnnxStepper(out).metadata


def test_what_is_no_checkpoint(tmp_path, capsys):
    assert main(["export", str(tmp_path)]) == 1
    assert "no such checkpoint" in capsys.readouterr().err


def test_training_tells_the_coverage(run):
    coverage = json.loads((run / METRICS).read_text())["coverage"]["05"]
    assert set(coverage) == {"distance", "heading", "distance_m", "heading_deg"}
    assert 0 <= coverage["distance"]["1"] <= coverage["distance"]["2"] <= 1
    assert (run / "figures" / "coverage.png").stat().st_size > 5000


def test_other_drives_to_fit_the_uncertainty_on(run, capsys):
    before, pair = (run / BEST).read_bytes(), random_scans(2, bins=361)
    assert main(["export", str(run), "--out", str(run / "own.onnx")]) == 0
    assert main(["export", str(run), "--fit-on", "10[:0.5]"]) == 0
    assert "errors within 1 or 2 deviations, %" in capsys.readouterr().out
    own, other = (OnnxStepper(run / name)(pair) for name in ("own.onnx", "model.onnx"))
    np.testing.assert_array_equal(own.array(), other.array())
    assert (np.diagonal(own.covariance) != np.diagonal(other.covariance)).all()
    assert (run / BEST).read_bytes() == before, "evaluate.py would otherwise tell other coverages"


def test_a_refused_export_leaves_the_checkpoint_as_well(run, capsys, monkeypatch):
    before = (run / BEST).read_bytes()
    monkeypatch.setattr(export_job, "MAX_ADDED_DRIFT", -1.0)
    assert main(["export", str(run), "--fit-on", "10[:0.5]"]) == 1
    assert "is not written" in capsys.readouterr().err
    assert (run / BEST).read_bytes() == before


@pytest.mark.parametrize("name", ["00", "00[0.5:]", "00~3", "00~3[:0.5]", "05", "05~1"])
def test_drives_that_were_trained_or_are_tested_on_tell_nothing_of_others(run, capsys, name):
    """A training on NAME also sees its new worlds, ``NAME~1`` and so on."""
    assert main(["export", str(run), "--fit-on", "10", name]) == 1
    assert f"--fit-on: {name[:2]} was trained or is tested on; name other drives" in capsys.readouterr().err


def test_a_checkpoint_steps_through_the_same_graph(run):
    model, scans = load_module(run / BEST).model, random_scans(5, bins=361)
    odometer, reference = export_job.load_odometer(run / BEST), TorchStepper(model)
    angles = np.deg2rad(np.arange(361) - 180.0)
    poses = [odometer.step(scan, angles=angles) for scan in scans]
    for earlier, later, pose in zip(scans[:-1], scans[1:], poses[1:], strict=True):
        pair = np.stack([model.sensor.encode(Scan(each.astype(float), angles)) for each in (earlier, later)])
        np.testing.assert_allclose(pose.step.array(), reference(pair).array(), atol=1e-5)
    with pytest.raises(InputError, match="no such checkpoint"):
        export_job.load_odometer(run / "none.ckpt")


def test_a_validation_drive_may_be_a_part_of_a_trained_recording():
    data = {"train": ["a[:0.8]", "b"], "val": ["a[0.8:]"], "test": ["c"]}
    export_job._refuse_used_drives(["a[0.8:]", "d"], data)
    with pytest.raises(InputError, match="--fit-on: a was trained or is tested on"):
        export_job._refuse_used_drives(["a[0.9:]"], data)
