"""A run of version 0.1 (commit 3da1213), as it was written, and what today's commands make of it.

``data/old_run`` is a small ``cnn_reg``, trained on the tiny KITTI recordings of the other tests with 46 bins;
``05.txt`` is the trajectory that version 0.1 estimated with it.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
import yaml
from onnx import TensorProto, helper

from conftest import LENGTHS
from evaluate import evaluate
from rcnn_odom.cli import main
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import BEST, CONFIG
from rcnn_odom.evaluation.sweep_report import load_runs
from rcnn_odom.models.onnx_stepper import OnnxStepper

OLD = Path(__file__).parents[1] / "data" / "old_run"
DRIFT = 0.198044


@pytest.fixture
def old_run(kitti, tmp_path):
    """The folder of the run, with the recordings where this machine has them."""
    run = shutil.copytree(OLD, tmp_path / "outputs" / "old")
    root = kitti[0].removeprefix("data.root=")
    (run / CONFIG).write_text((run / CONFIG).read_text().replace("ROOT", root))
    return run


def test_its_configuration_has_the_form_of_then():
    settings = yaml.safe_load((OLD / CONFIG).read_text())
    assert settings["data"]["reader"]["_target_"] == "rcnn_odom.datasets.kitti.load"
    assert "apply" not in settings["model"]


def test_it_is_evaluated_as_it_was(configure, old_run, tmp_path):
    metrics = evaluate(configure(f"run={old_run}", name="evaluate", run="evaluation"))
    assert metrics["variant"] == "cnn_reg"
    assert metrics["test"]["drift"] == pytest.approx(DRIFT, rel=1e-4)
    assert 0 < metrics["coverage"]["05"]["heading"]["1"] <= 1
    assert "distance" not in metrics["coverage"]["05"], "what lies sideways was not known then"
    trajectory = np.loadtxt(tmp_path / "outputs" / "evaluation" / "trajectories" / "05.txt")
    np.testing.assert_allclose(trajectory, np.loadtxt(OLD / "05.txt"), atol=1e-4)


def test_it_is_evaluated_on_other_data(configure, old_run):
    other = ["data=simulated", "data.frames=30", "data.test=[07]", "data.sensor.resolution_deg=8.0", LENGTHS]
    metrics = evaluate(configure(f"run={old_run}", *other, name="evaluate", run="evaluation"))
    assert metrics["test"]["sequences"]["07"]["frames"] == 30


def test_its_steps_are_taken_where_it_was_trained_to(configure, old_run):
    other = ["data=simulated", "data.frames=30", "data.test=[07]", "data.sensor.resolution_deg=8.0"]
    with pytest.raises(InputError, match=r"data.apply=start: the network was trained with end"):
        evaluate(configure(f"run={old_run}", *other, "data.apply=start", name="evaluate", run="evaluation"))


def test_it_is_exported(old_run):
    assert main(["export", str(old_run)]) == 0
    metadata = OnnxStepper(old_run / "model.onnx").metadata
    assert metadata["drift"]["mean"] == pytest.approx(DRIFT, abs=1e-4)
    assert metadata["typical_step"][1] is None, "what lies sideways was not known then"


def test_the_report_has_it(old_run):
    metrics = {"variant": "cnn_reg", "data": "kitti", "test": {"drift": DRIFT}}
    (old_run / "metrics.json").write_text(json.dumps(metrics))
    assert len(load_runs(old_run.parent)) == 1


def test_a_checkpoint_that_misses_a_weight_is_refused_in_a_line(old_run, capsys):
    damaged = (old_run / BEST).read_bytes()[:100_000]
    (old_run / BEST).write_bytes(damaged)
    assert main(["export", str(old_run)]) == 1
    printed = capsys.readouterr().err
    assert "best.ckpt: not a checkpoint of this project, or of an older version" in printed
    assert printed.count("\n") == 1


def test_its_onnx_file_is_refused_in_a_line(tmp_path, capsys):
    scans = helper.make_tensor_value_info("scans", TensorProto.FLOAT, [1, 2, 46])
    motion = helper.make_tensor_value_info("motion", TensorProto.FLOAT, [1, 2, 46])
    graph = helper.make_graph([helper.make_node("Identity", ["scans"], ["motion"])], "old", [scans], [motion])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    metadata = {
        "version": "0.1.0",
        "variant": "cnn_reg",
        "sensor": {"resolution_deg": 8.0, "field_of_view_deg": 360.0, "max_range": 80.0},
        "apply": "end",
        "typical_motion": [1.0, 0.02],
        "least_filled": 0.4,
        "period": 0.1,
        "precision": "fp32",
    }
    helper.set_model_props(model, {"rcnn_odom": json.dumps(metadata)})
    onnx.save(model, tmp_path / "old.onnx")
    old = str(tmp_path / "old.onnx")
    assert main(["run", str(tmp_path), "--model", old, "--out", str(tmp_path / "out")]) == 1
    printed = capsys.readouterr().err
    assert "old.onnx: written by an older version; export the checkpoint again" in printed
    assert printed.count("\n") == 1
