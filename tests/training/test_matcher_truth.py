"""Recordings without poses learn from scan matching: its path, what it marks, and where that is kept."""

import re

import numpy as np
import pytest

from conftest import SHARED
from data.make_bag import make_bag
from data.make_carmen import make_carmen
from evaluate import evaluate
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import planar_to_poses, relative_steps
from rcnn_odom.models.matcher import Matcher
from rcnn_odom.recordings import carmen, logs, simulated
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.training import matcher_truth
from rcnn_odom.training.matcher_truth import MatcherTruth
from rcnn_odom.training.settings import plain
from rcnn_odom.training.stages import build_datamodule
from train import train

LENGTHS = "data.lengths=[1.0,2.0]"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A log of a robot and a bag of its scans, of which ten in the middle see nothing; the true steps."""
    folder = tmp_path_factory.mktemp("logs")
    planar = make_carmen(folder, "robot", frames=70, beams=181)
    scans = carmen.load("robot", root=folder)
    ranges = np.array([scans.read_scan(frame).ranges for frame in range(70)])
    ranges[30:40] = np.inf
    make_bag(folder, "mcap", ranges)
    return folder, relative_steps(planar_to_poses(planar))


def open_log(name, folder):
    return lambda _=None: logs.load(name, root=folder, reference="matcher")


def test_the_truth_is_what_the_matcher_estimates(folder, tmp_path):
    root, true_steps = folder
    opened = MatcherTruth(open_log("robot.log", root), tmp_path / "cache", "auto")("robot.log")
    expected = Matcher({}, None).estimate(Drive.unencoded(open_log("robot.log", root)())).values
    np.testing.assert_allclose(relative_steps(opened.poses), expected, atol=1e-9)
    errors = np.abs(relative_steps(opened.poses) - true_steps)
    assert np.median(errors[opened.trusted[1:]], axis=0) == pytest.approx(0, abs=0.02)


def test_marked_steps_are_counted_and_not_trusted(folder, tmp_path):
    opened = MatcherTruth(open_log("log_mcap", folder[0]), tmp_path / "cache", "auto")("log_mcap")
    assert not opened.trusted[30:41].any()  # the step after the last takes the error of its pose back
    assert opened.trusted[1:30].mean() > 0.9
    left_out = int((~opened.trusted[1:]).sum())
    note = next(note for note in opened.notes if note.startswith("truth: scan matching"))
    assert re.fullmatch(
        rf"truth: scan matching; 1\d of 69 steps are marked; these and the steps after them, {left_out} in "
        r"all, are not trained on \(.*\b10 no returns\b.*\)",
        note,
    )


def test_of_several_sources_only_those_without_poses_get_them(folder, configure, tmp_path):
    """``data=mixed``: a log by scan matching, beside simulated rooms, whose truth is known."""
    sources = [f"data.sources.logs.root={folder[0]}", "data.sources.logs.reference=matcher"]
    cfg = configure("model=cnn_warp", "data=mixed", *sources, "+data.sources.sick.frames=30")
    opened = build_datamodule(plain(cfg)).open_recording
    path = Matcher({}, None).estimate(Drive.unencoded(open_log("robot.log", folder[0])())).values
    np.testing.assert_allclose(relative_steps(opened("logs/robot").poses), path, atol=1e-9)
    room = simulated.load("00", world="indoor", frames=30, laser={"kind": "sick", "spacing_deg": 1.0})
    np.testing.assert_array_equal(opened("sick/00").poses, room.poses)


def test_the_path_is_computed_once(folder, tmp_path, monkeypatch, caplog):
    truth = MatcherTruth(open_log("log_mcap", folder[0]), tmp_path / "cache", "auto")
    first = truth("log_mcap")
    with monkeypatch.context() as patch:
        patch.setattr(matcher_truth, "match", None)
        again = truth("log_mcap")
    np.testing.assert_array_equal(again.poses, first.poses)
    np.testing.assert_array_equal(again.trusted, first.trusted)
    assert again.notes == first.notes
    (kept,) = (tmp_path / "cache").glob("*.npz")
    kept.write_bytes(kept.read_bytes()[:-100])
    np.testing.assert_array_equal(truth("log_mcap").poses, first.poses)
    assert "damaged, matching the scans again" in caplog.text
    monkeypatch.setattr(matcher_truth, "hash_statements", lambda sources: "another matcher")
    truth("log_mcap")
    assert len(list((tmp_path / "cache").glob("*.npz"))) == 2


@pytest.mark.parametrize("model", ["cnn_reg", "rcnn_reg"])
def test_a_bag_without_poses_trains_and_is_scored(folder, configure, tmp_path, caplog, model):
    caplog.set_level("INFO")
    options = [
        *(f"model={model}", "data=logs", f"data.root={folder[0]}", "data.reference=matcher", LENGTHS),
        *("data.train=[log_mcap]", "data.val=['robot.log[0:0.5]']", "data.test=['robot.log[::2]']"),
    ]
    metrics = train(configure(*options))
    assert metrics["test"]["drift"] > 0
    assert metrics["test"]["sequences"]["robot.log[::2]"]["frames"] == 35
    assert "of 70 scans to train on, in" in caplog.text
    assert "log_mcap: truth: scan matching; " in caplog.text
    scores = evaluate(configure("model=matcher", *options[1:], name="evaluate", run="evaluation"))
    assert scores["test"]["floor"] < metrics["test"]["drift"]


def test_it_trains_on_trajectories_that_run_wrote(folder, configure, tmp_path):
    from rcnn_odom.cli import main

    assert main(["run", str(folder[0] / "log_mcap"), "--out", str(tmp_path / "poses" / "log_mcap")]) == 0
    metrics = train(
        configure(
            *("model=cnn_reg", "data=logs", f"data.root={folder[0]}", f"data.reference={tmp_path}/poses"),
            *(
                "data.train=[log_mcap]",
                "data.val=[log_mcap]",
                "data.test=[log_mcap]",
                LENGTHS,
                "model.epochs=1",
            ),
        )
    )
    assert metrics["test"]["drift"] > 0


def test_a_carmen_log_takes_the_matcher_in_place_of_its_poses(folder, configure, caplog):
    caplog.set_level("INFO")
    metrics = train(
        configure(
            *("model=cnn_reg", "data=carmen", f"data.root={folder[0]}", "data.reference=matcher", LENGTHS),
            *("data.train=[robot]", "data.val=[robot]", "data.test=[robot]", "model.epochs=1"),
        )
    )
    assert "robot: truth: scan matching" in caplog.text
    assert "truth: the log's laser pose" not in caplog.text
    assert metrics["test"]["drift"] > 0


def test_no_reference_and_another_laser_are_refused_in_a_line(folder, configure):
    options = ["model=cnn_reg", "data=logs", f"data.root={folder[0]}", "data.train=[log_mcap]"]
    options += ["data.val=[log_mcap]", "data.test=[log_mcap]"]
    with pytest.raises(InputError, match=r"set data\.reference=matcher.*or data\.reference=FOLDER"):
        train(configure(*options))
    wrong = ["data.reference=matcher", "data.sensor.field_of_view_deg=360"]
    with pytest.raises(InputError, match=r"set data\.sensor\.field_of_view_deg=180 .*facing_deg=0"):
        train(configure(*options, *wrong, run="other"))


@pytest.mark.slow
def test_real_recordings_train(configure, caplog):
    if not SHARED.exists():
        pytest.skip("no real recordings here")
    caplog.set_level("INFO")
    for number, options in enumerate(
        [
            [
                "data.train=['data/carmen/ual.clf.gz[0:0.3]']",
                "data.val=['data/carmen/ual.clf.gz[0.9:]']",
                "data.test=['data/carmen/ual.clf.gz[0.3:0.4]']",
            ],
            [
                *("data.train=['cases/left_half.bag[:0.7]']", "data.val=['cases/left_half.bag[0.7:]']"),
                *("data.test=[cases/left_half.bag]", "data.sensor.facing_deg=90"),
            ],
        ]
    ):
        where = ["model=cnn_reg", "data=logs", f"data.root={SHARED}", "data.reference=matcher"]
        metrics = train(configure(*where, *options, "model.epochs=1", run=f"run{number}"))
        assert metrics["test"]["drift"] > 0
    assert "left_half.bag: truth: scan matching; 0 of 119 steps are marked" in caplog.text
