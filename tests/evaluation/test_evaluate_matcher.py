"""``evaluate.py model=matcher`` from the command line's configuration to what it leaves behind."""

import json

import numpy as np
import pytest
import yaml

from data.make_carmen import make_carmen
from evaluate import evaluate
from rcnn_odom import cli
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, change_frame, poses_to_planar
from rcnn_odom.recordings.trajectory import read_kitti, read_motions


@pytest.fixture
def evaluate_matcher(configure):
    def run(*options, run="matcher"):
        return evaluate(configure("model=matcher", *options, name="evaluate", run=run))

    return run


def test_scan_matching_leaves_what_a_trained_run_leaves(evaluate_matcher, tmp_path, caplog):
    caplog.set_level("INFO")
    options = ["data=simulated", "data.frames=30", "data.test=['05']", "data.train=['00','02']"]
    metrics = evaluate_matcher(*options, "data.lengths=[10.0]", "data.workers=1", "model.wheels=true")
    folder = tmp_path / "outputs" / "matcher"
    assert json.loads((folder / "metrics.json").read_text()) == metrics
    assert (metrics["variant"], metrics["data"]) == ("matcher", "simulated")
    assert set(metrics["baselines"]) == {"mean_motion", "held_motion", "matcher_two_numbers"}
    assert set(metrics["latency"]) == {"median_ms", "p99_ms", "frames", "threads"}
    assert "matcher_two_numbers" in caplog.text
    assert metrics["test"]["drift"] < 0.02
    assert metrics["test"]["sequences"]["05"]["distance_mae_m"] < 0.02
    settings = yaml.safe_load((folder / "config.yaml").read_text())
    assert settings["model"]["wheels"] is True
    assert settings["data"]["test"] == ["05"]
    for kind in ("trajectory", "motion"):
        assert (folder / "figures" / f"05_{kind}.png").stat().st_size > 10_000
    trajectories = folder / "trajectories"
    assert np.loadtxt(trajectories / "05.tum").shape == (30, 8)
    truth, methods = read_motions(trajectories / "05_motions.csv")
    assert len(truth) == 29
    assert set(methods) == {"estimate", "mean_motion", "held_motion"}


def test_a_robots_log_beside_its_wheels_and_the_command_line(evaluate_matcher, tmp_path, capsys):
    planar = make_carmen(tmp_path / "logs", "robot", frames=40)
    options = ["data=carmen", f"data.root={tmp_path}/logs", "data.train=[missing]", "data.test=[robot]"]
    metrics = evaluate_matcher(*options, "data.lengths=[1.0,2.0]", "data.workers=1")
    # The training logs are not there, so there is no mean motion.
    assert set(metrics["baselines"]) == {"held_motion", "wheel_odometry", "matcher_two_numbers"}
    trajectories = tmp_path / "outputs" / "matcher" / "trajectories"
    camera = read_kitti(trajectories / "robot.txt")
    found = poses_to_planar(change_frame(camera, np.linalg.inv(FORWARD_CAMERA)))
    place = (planar[:, 0] + 1j * planar[:, 1] - complex(*planar[0, :2])) * np.exp(-1j * planar[0, 2])
    assert np.abs(found[:, 0] + 1j * found[:, 1] - place).max() < 0.1
    files = [str(trajectories / name) for name in ("robot_truth.txt", "robot.txt")]
    capsys.readouterr()
    assert cli.main(["drift", *files, "--planar", "--lengths", "1,2", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["t_err"] == pytest.approx(
        metrics["test"]["sequences"]["robot"]["drift"]["t_err"], rel=1e-6
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["model=matcher"], "model=matcher needs recordings: add data=simulated"),
        (["model=cnn_reg"], "model=cnn_reg: a trained network is scored by its run, run="),
        (
            ["model=rcnn_cls", "data=simulated"],
            "model=rcnn_cls: a trained network is scored by its run, run=",
        ),
        (["model=matcher", "data=simulated", "model.wheels=2"], "model.wheels=2: must be true or false"),
        (
            ["model=matcher", "data=simulated", "data.deskew=maybe"],
            "data.deskew=maybe: choose one of auto, on, off",
        ),
        (["model=matcher", "data=kitti"], "data.root is missing"),
    ],
)
def test_mistakes_are_told_in_a_line(configure, options, message):
    with pytest.raises(InputError, match=message):
        evaluate(configure(*options, name="evaluate", run="matcher"))
