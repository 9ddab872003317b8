"""``rcnn-odom export`` on a trained run."""

import json

import pytest
import torch

from rcnn_odom.cli import main
from rcnn_odom.deployment.onnx_model import OnnxStepper
from rcnn_odom.training import export as export_job
from rcnn_odom.training.run_state import BEST, METRICS
from train import train


@pytest.fixture
def run(configure, kitti, tmp_path):
    train(configure("model=rcnn_reg", "model.projection=16", *kitti))
    return tmp_path / "outputs" / "run"


def test_export_prints_the_drift_of_each_precision(run, capsys, monkeypatch):
    monkeypatch.setattr(export_job, "ALLOWED", 1.0)  # two epochs on 60 frames: int8 may cost anything
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


def test_a_precision_that_costs_too_much_is_not_written(run, capsys, monkeypatch):
    monkeypatch.setattr(export_job, "ALLOWED", -1.0)
    assert main(["export", str(run), "--quantize", "int8"]) == 1
    assert "percentage points of drift, more than -100, and is not written" in capsys.readouterr().err
    assert not list(run.glob("*.onnx"))


def test_a_checkpoint_of_a_stopped_training_gets_its_uncertainty(run):
    saved = torch.load(run / BEST, weights_only=True)
    assert torch.isfinite(saved["state_dict"]["uncertainty.weights"]).all(), "train.py has fitted it"
    fitted = saved["state_dict"]["uncertainty.weights"].clone()
    saved["state_dict"]["uncertainty.weights"].fill_(torch.nan)
    torch.save(saved, run / BEST)
    assert main(["export", str(run)]) == 0
    torch.testing.assert_close(
        torch.load(run / BEST, weights_only=True)["state_dict"]["uncertainty.weights"], fitted
    )


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
    assert main(["export", str(run), "--fit-on", "10", "00[0.5:]"]) == 1
    assert "--fit-on: 00 was trained or is tested on; name other drives" in capsys.readouterr().err
    before = torch.load(run / BEST, weights_only=True)["state_dict"]["uncertainty.weights"]
    assert main(["export", str(run), "--fit-on", "10[:0.5]"]) == 0
    printed = capsys.readouterr().out
    assert "truth within so many deviations, %" in printed
    after = torch.load(run / BEST, weights_only=True)["state_dict"]["uncertainty.weights"]
    assert not torch.equal(before, after)
