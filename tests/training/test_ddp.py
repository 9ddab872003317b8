"""Training and testing in two processes on the CPU."""

import logging
import os
import signal
import subprocess
import sys
import time

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_experiment import STUB

from conftest import LENGTHS, ROOT, SMALL, configure_in
from data.make_kitti import make_kitti
from evaluate import evaluate
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import BEST, LAST
from rcnn_odom.training import stages
from rcnn_odom.training.checkpoint import load_module
from rcnn_odom.training.settings import plain
from rcnn_odom.training.windows import Batches, WindowSampler
from train import train

FRAMES = {"00": 60, "03": 45, "10": 70, "09": 40, "08": 90, "05": 80, "07": 50, "06": 35}


@pytest.fixture(scope="module")
def uneven(tmp_path_factory):
    """Options for drives of which no two are as long as each other; three validate and three test."""
    root = tmp_path_factory.mktemp("uneven")
    for name, frames in FRAMES.items():
        make_kitti(root, [name], frames=frames)
    splits = ["data.train=['00','03']", "data.val=['10','09','08']", "data.test=['05','07','06']"]
    return [f"data.root={root}", "data=kitti", *splits, LENGTHS]


def drift_of_one_process(module, settings, split):
    """Validation or test drift of a network, in this process alone."""
    data = stages.build_datamodule(settings).load((split,))
    data.drives["val"] = data.drives[split]
    trainer = stages.build_trainer(
        settings | {"trainer": settings["trainer"] | {"devices": 1, "strategy": "auto"}}
    )
    trainer.validate(module, data, verbose=False)
    scores = trainer.callback_metrics
    return {name: float(value) for name, value in scores.items() if "drift" in name or "mae" in name}


@pytest.mark.slow
def test_two_processes_score_as_one_and_log_once(configure, uneven, tmp_path, capfd):
    options = ["model=rcnn_reg", *uneven, "model.first_stage.epochs=2", "model.epochs=3"]
    configuration = configure(*options, "trainer=ddp")
    metrics = train(configuration)
    run = tmp_path / "outputs" / "run"
    text = capfd.readouterr().out
    assert text.count("epoch  1/2") == text.count("epoch  1/3") == text.count("epoch  3/3") == 1

    settings = plain(configuration)
    alone = drift_of_one_process(load_module(run / BEST), settings, "val")
    assert metrics["val"]["drift"] == pytest.approx(alone["val/drift"], abs=1e-6)
    scores = evaluate(configure(f"run={run}", "trainer=default", name="evaluate", run="one"))
    again = evaluate(
        configure(f"run={run}", "trainer=ddp", "trainer.accelerator=cpu", name="evaluate", run="two")
    )
    for report in (scores, again):
        assert report["test"]["drift"] == pytest.approx(metrics["test"]["drift"], abs=1e-6)
        for name in ("05", "07", "06"):
            expected = metrics["test"]["sequences"][name]
            got = report["test"]["sequences"][name]
            assert got["drift"]["t_err"] == pytest.approx(expected["drift"]["t_err"], abs=1e-6)
            assert got["distance_mae_m"] == pytest.approx(expected["distance_mae_m"], abs=1e-6)

    events = EventAccumulator(str(run / "tensorboard"), {"scalars": 0})
    events.Reload()
    drift = "Validation: after each epoch/drift in %, all drives"
    for tag in (drift, drift.replace("all drives", "drive 09"), "Training: mean of each epoch/loss"):
        assert len(events.Scalars(tag)) == 3, tag
    best = min(point.value for point in events.Scalars(drift))
    assert best == pytest.approx(100 * metrics["val"]["drift"])


@pytest.mark.slow
def test_a_first_stage_without_a_gradient_trains_in_two_processes(configure, uneven, caplog):
    options = ["model=rcnn_reg", "model.angle=argmax", "model.epochs=2", "model.batch_size=2", "trainer=ddp"]
    with caplog.at_level(logging.INFO):
        metrics = train(configure(*options, *uneven))
    assert metrics["training"]["epochs"] == 2
    assert "argmax" in caplog.text


@pytest.mark.slow
def test_new_worlds_are_made_once_and_shared(configure, tmp_path, capfd):
    options = ["data.fresh_worlds=true", "data.keep_worlds=true", "trainer=ddp"]
    train(configure("model=cnn_reg", *STUB, *options))
    assert capfd.readouterr().out.count("new worlds for every epoch") == 1
    names = sorted(path.name.split("-")[0] for path in (tmp_path / "outputs" / "cache").glob("*.npy"))
    assert names == ["00", "00~1", "02", "02~1", "05", "10"]


@pytest.mark.slow
def test_a_mistake_in_a_process_is_one_line(configure, uneven):
    options = ["trainer=ddp", "model.learning_rate=1e30", "trainer.gradient_clip_val=null"]
    with pytest.raises(InputError, match="training diverged in epoch 1") as failure:
        train(configure("model=cnn_reg", *uneven, *options))
    assert "\n" not in str(failure.value)


def test_a_batch_must_come_out_even(configure, uneven):
    with pytest.raises(InputError, match=r"model.batch_size=7: windows cannot be shared evenly among 2"):
        train(configure("model=cnn_reg", *uneven, "trainer=ddp", "model.batch_size=7"))


@pytest.mark.slow
def test_more_devices_than_windows_are_refused(configure, kitti):
    with pytest.raises(InputError, match="have 1 windows of 32 pairs, fewer than the 2 devices"):
        train(configure("model=rcnn_reg", *kitti, "trainer=ddp", "model.window=32"))


@pytest.mark.parametrize("start", [0, 2])
def test_processes_share_every_batch(start):
    def batches(*place):
        sampler = WindowSampler([40, 30], 4, False, seed=1)
        chosen = Batches(sampler, 4, *place)
        chosen.skip_batches(start)
        return list(chosen)

    first, second, whole = batches(0, 2), batches(1, 2), batches()
    assert len(whole) == 3 - start
    for one, other, both in zip(first, second, whole, strict=True):
        assert sorted(one + other) == sorted(both)
        assert len(one) == len(other) == 2


@pytest.fixture(scope="module")
def whole(uneven, tmp_path_factory):
    """Options of a training, and the weights that it gives when nobody stops it."""
    options = ["model=cnn_cls", *uneven, "trainer=ddp", "model.batch_size=2", "model.epochs=3"]
    folder = tmp_path_factory.mktemp("whole")
    train(configure_in(folder)(*options))
    return options, torch.load(folder / "outputs" / "run" / BEST, weights_only=True)["state_dict"]


def start(options, outputs):
    return subprocess.Popen(
        [sys.executable, str(ROOT / "train.py"), *SMALL, *options, f"outputs={outputs}"],
        cwd=outputs.parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def saved(outputs, which):
    [path] = outputs.glob(f"cnn_cls-kitti/*/{which}")
    return torch.load(path, weights_only=True)


@pytest.mark.parametrize("everyone", [False, True])
@pytest.mark.slow
def test_asked_to_stop_processes_save_and_go_on_bit_for_bit(whole, tmp_path, everyone):
    """By SIGTERM to the process that was started, or by Ctrl-C, which all in the terminal get."""
    options, weights = whole
    process = start(options, tmp_path / "stopped")
    for line in process.stdout:
        if line.startswith("epoch  1/"):
            break
    time.sleep(0.2)
    if everyone:
        os.killpg(process.pid, signal.SIGINT)
    else:
        process.terminate()
    rest = process.stdout.read()
    assert process.wait(timeout=60) == 130, rest
    assert "the same command continues" in rest
    assert "Traceback" not in rest
    step = saved(tmp_path / "stopped", LAST)["global_step"]
    if everyone:  # what follows is the same
        return
    text, _ = start(options, tmp_path / "stopped").communicate(timeout=200)
    assert f"step {step}\n" in text
    found = saved(tmp_path / "stopped", BEST)["state_dict"]
    assert all(torch.equal(value, found[name]) for name, value in weights.items())


@pytest.mark.slow
def test_processes_whose_time_is_up_are_scored_and_go_on_bit_for_bit(configure, whole, tmp_path):
    options, weights = whole
    metrics = train(configure(*options, "+trainer.max_time={milliseconds: 1}"))
    assert metrics["training"]["steps"] == 1
    assert metrics["training"]["stopped_by"] == "trainer.max_time"
    assert metrics["test"]["sequences"]["05"]["frames"] == 80
    train(configure(*options))
    found = torch.load(tmp_path / "outputs" / "run" / BEST, weights_only=True)["state_dict"]
    assert all(torch.equal(value, found[name]) for name, value in weights.items())


@pytest.mark.slow
def test_fast_dev_run_in_two_processes(configure, uneven):
    options = ["model=cnn_cls", *uneven, "trainer=ddp", "+trainer.sync_batchnorm=true"]
    training = train(configure(*options, "+trainer.fast_dev_run=2"))["training"]
    assert (training["epochs"], training["steps"]) == (1, 2)
