"""A training that is stopped, killed or runs out of disk goes on to the very same result, or says why not."""

import hashlib
import json
import os
import pickle
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from conftest import ROOT, SMALL
from evaluate import evaluate
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import BEST, LAST
from rcnn_odom.training import saving
from rcnn_odom.training.checkpoint import load_module
from rcnn_odom.training.training_log import TrainingLog
from rcnn_odom.training.windows import Windows
from train import train

# The networks of a configuration, with all that draws at random.
VARIED = [
    *("model.dropout=0.2", "data.augment.mirror=true", "data.augment.max_turn_deg=5"),
    *("data.augment.move=[0.3,0.1,2]", "data.augment.max_range_scale=1.2", "data.augment.beam_pattern=[1,4]"),
    *("data.augment.lost_beams=0.2", "data.augment.lost_sector_deg=40", "data.augment.noise=0.05"),
]


class Killed(BaseException):
    """Takes the place of ``kill -9`` within a process."""


def result_of(run):
    """Weights, metrics and curves that a run ends with."""
    metrics = json.loads((run / "metrics.json").read_text())
    events = EventAccumulator(str(run / "tensorboard"), {"tensors": 0, "images": 0, "scalars": 0})
    events.Reload()
    curves = {
        tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]
    }
    weights = torch.load(run / BEST, weights_only=True)["state_dict"]
    return weights, {key: metrics[key] for key in ("val", "test", "baselines")}, curves


def assert_same(one, other):
    (weights, metrics, curves), (weights_too, metrics_too, curves_too) = one, other
    assert weights.keys() == weights_too.keys()
    for name, value in weights.items():
        assert torch.equal(value, weights_too[name]), name
    assert metrics == metrics_too
    assert curves.keys() == curves_too.keys()
    for tag, points in curves.items():
        assert points == curves_too[tag], tag


@pytest.fixture
def save_at_every_step(monkeypatch):
    monkeypatch.setattr(saving, "SAVE_EVERY_SECONDS", -1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "averaging"), [("cnn_cls", "0.0"), ("cnn_cls", "0.6"), ("rcnn_reg", "0.0")]
)
def test_killed_after_any_step_it_goes_on_bit_for_bit(
    configure, kitti, tmp_path, monkeypatch, caplog, save_at_every_step, variant, averaging
):
    options = [f"model={variant}", *kitti, *VARIED, f"model.averaging={averaging}"]
    if variant == "rcnn_reg":  # the first stage is the other variant's test
        train(configure("model=cnn_cls", *kitti, run="cnn"))
        options += [f"model.pretrained={tmp_path}/outputs/cnn/{BEST}", "model.batch_size=2", "model.stride=6"]
    outputs = tmp_path / "outputs"
    copy_after_each_step(monkeypatch, outputs, lambda: train(configure(*options, run="whole")))
    whole = result_of(outputs / "whole")
    epoch = 7 if variant == "cnn_cls" else 4
    for step in range(1, 2 * epoch + 1):
        run = f"killed_{step}"
        with caplog.at_level("INFO"):
            train(configure(*options, run=run))
        # The validation belongs to the epoch's last step, after which nothing is saved before it.
        saved = step - 1 if step % epoch == 0 else step
        assert f"continuing from {outputs}/{run}/{LAST}, step {saved}\n" in caplog.text
        assert_same(result_of(outputs / run), whole)


def copy_after_each_step(monkeypatch, outputs, train_it):
    """Runs a training and keeps what ``kill -9`` would leave of its folder after each step."""
    batch_end = saving.Saving.on_train_batch_end

    def copy(self, trainer, *arguments):
        batch_end(self, trainer, *arguments)
        shutil.copytree(outputs / "whole", outputs / f"killed_{trainer.global_step}")

    with monkeypatch.context() as patch:
        patch.setattr(saving.Saving, "on_train_batch_end", copy)
        train_it()


def kill_after(monkeypatch, step, train_it):
    """Runs a training that dies after a step."""
    batch_end = saving.Saving.on_train_batch_end

    def die(self, trainer, *arguments):
        batch_end(self, trainer, *arguments)
        if trainer.global_step == step:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(saving.Saving, "on_train_batch_end", die)
        with pytest.raises(Killed):
            train_it()


def test_a_run_whose_folder_was_moved_goes_on_bit_for_bit(
    configure, kitti, tmp_path, monkeypatch, save_at_every_step
):
    options = ["model=cnn_reg", *kitti]
    train(configure(*options, run="whole"))
    kill_after(monkeypatch, 10, lambda: train(configure(*options, run="here")))
    (tmp_path / "outputs" / "here").rename(tmp_path / "outputs" / "there")
    train(configure(*options, run="there"))
    assert_same(*(result_of(tmp_path / "outputs" / run) for run in ("there", "whole")))


def test_killed_before_the_first_checkpoint_it_begins_again_with_clean_curves(
    configure, kitti, tmp_path, monkeypatch
):
    options = ["model=cnn_reg", *kitti, "model.batch_size=4"]
    train(configure(*options, run="whole"))
    kill_after(monkeypatch, 12, lambda: train(configure(*options)))
    train(configure(*options))
    assert_same(*(result_of(tmp_path / "outputs" / run) for run in ("run", "whole")))


# As `python train.py`, but it saves four times a second, so that kills also fall between epochs' ends.
COMMAND = f"""
import runpy, sys
from rcnn_odom.training import saving
saving.SAVE_EVERY_SECONDS = 0.25
sys.path.insert(0, {str(ROOT)!r})
sys.argv[0] = {str(ROOT / "train.py")!r}
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.fixture
def command(tmp_path, kitti):
    """A function that starts the training of a recurrent network, as a user does."""
    script = tmp_path / "command.py"
    script.write_text(COMMAND)

    def command(outputs, *options):
        every = [*SMALL, *kitti, "model=rcnn_reg", "model.hidden_size=64", *VARIED]
        every += ["model.window=8", "model.stride=4"]
        every += ["model.epochs=40", "model.first_stage.epochs=40", "model.first_stage.batch_size=4"]
        every += ["model.batch_size=2", f"outputs={outputs}", *options]
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        return subprocess.Popen(
            [sys.executable, str(script), *every],
            cwd=tmp_path,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    return command


def only_run(outputs):
    [run] = [path.parent for path in outputs.glob("rcnn_reg-*/*/config.yaml")]
    return run


@pytest.mark.slow
def test_killed_at_ten_random_moments_the_same_command_ends_bit_for_bit(command, tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    process = command(whole)
    first_line, start = process.stdout.readline(), time.monotonic()
    text, _ = process.communicate(timeout=300)
    seconds = time.monotonic() - start
    assert (only_run(whole) / "metrics.json").exists(), first_line + text
    print(f"{seconds:.1f} s without a kill")
    moments = random.Random(0)
    for _ in range(10):
        process = command(broken)
        print(process.stdout.readline(), end="")
        time.sleep(moments.uniform(0, 0.4) * seconds)
        process.kill()
        print(process.communicate()[0])
    text, _ = command(broken).communicate(timeout=300)
    # Where the last kill came too late, the same command has begun the next run.
    runs = sorted((path.parent for path in broken.glob("rcnn_reg-*/*/config.yaml")), key=lambda run: run.name)
    assert (runs[0] / "metrics.json").exists(), text
    assert_same(result_of(runs[0]), result_of(only_run(whole)))
    assert_same(*(result_of(run / "first_stage") for run in (runs[0], only_run(whole))))


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_asked_to_stop_it_saves_and_says_how_to_go_on(command, tmp_path, number):
    process = command(tmp_path / "outputs", "model.first_stage.epochs=500")
    for line in process.stdout:
        if line.startswith("epoch  2/"):
            break
    process.send_signal(number)
    rest = process.stdout.read()
    assert process.wait(timeout=60) == 130
    run = only_run(tmp_path / "outputs")
    assert f"stopped; the same command continues the run in {run.relative_to(tmp_path)}" in rest
    assert "Traceback" not in rest
    step = torch.load(run / "first_stage" / LAST, weights_only=True)["global_step"]
    assert step >= 2 * 14
    process = command(tmp_path / "outputs", "model.first_stage.epochs=500")
    for line in process.stdout:
        if line.startswith("continuing from"):
            break
    process.kill()
    process.communicate()
    assert line.endswith(f"step {step}\n")
    assert only_run(tmp_path / "outputs") == run


def limit_file_size(size):
    """No file may grow beyond so many bytes: a full disk, without one."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))


def test_full_disk_leaves_the_last_checkpoint_and_a_line(configure, kitti, tmp_path, monkeypatch):
    train(configure("model=cnn_reg", *kitti, run="whole"))
    last = tmp_path / "outputs" / "run" / LAST

    def fill(self, trainer, module):
        if trainer.current_epoch == 1:
            limit_file_size(100_000)

    with monkeypatch.context() as patch:
        patch.setattr(saving.Saving, "on_train_epoch_start", fill, raising=False)
        try:
            with pytest.raises(
                InputError, match=r"checkpoint cannot be written \(File too large\)"
            ) as failure:
                train(configure("model=cnn_reg", *kitti))
        finally:
            limit_file_size(resource.RLIM_INFINITY)
    assert "\n" not in str(failure.value)
    assert torch.load(last, weights_only=True)["epoch"] == 0
    assert sorted(path.name for path in last.parent.iterdir()) == ["best.ckpt", "last.ckpt"]
    train(configure("model=cnn_reg", *kitti))
    assert_same(*(result_of(tmp_path / "outputs" / run) for run in ("run", "whole")))


@pytest.mark.slow
def test_two_processes_do_not_train_one_run(configure, kitti, command, tmp_path):
    process = command(tmp_path / "outputs", f"run_dir={tmp_path}/outputs/run", "model.epochs=500")
    for line in process.stdout:
        if line.startswith("epoch"):
            break
    second = command(tmp_path / "outputs", f"run_dir={tmp_path}/outputs/run", "model.epochs=500")
    text, _ = second.communicate(timeout=60)
    process.kill()
    process.communicate()
    assert second.returncode == 1
    assert "another process is training this run" in text


def spoil_scan(monkeypatch, frame, value):
    """Lets one scan of the first training drive be bad, as a faulty laser's might be."""
    write = Windows._write_window

    def spoilt(self, pairs, motions, first, *rest):
        write(self, pairs, motions, first, *rest)
        if first <= frame <= first + self.length:
            pairs[:] = value

    monkeypatch.setattr(Windows, "_write_window", spoilt)


def test_nan_in_the_loss_names_the_frames(configure, kitti, monkeypatch):
    spoil_scan(monkeypatch, 31, float("nan"))
    with pytest.raises(
        InputError, match=r"step [1-7]: the loss is nan or inf, after frames 00: (30-31|31-32)"
    ) as e:
        train(configure("model=cnn_reg", *kitti))
    assert "\n" not in str(e.value)


def test_nan_in_the_loss_names_the_window(configure, kitti, monkeypatch):
    spoil_scan(monkeypatch, 31, float("inf"))
    with pytest.raises(InputError, match=r"the loss is nan or inf, after frames 00: (\d+)-(\d+);") as failure:
        train(configure("model=rcnn_reg", *kitti))
    first, last = map(int, re.search(r"(\d+)-(\d+);", str(failure.value)).groups())
    assert first <= 31 <= last


def test_nan_in_the_gradient_stops_before_the_step(configure, kitti, tmp_path, monkeypatch):
    def spoil(self, trainer, module, optimizer):
        if trainer.global_step == 9:
            next(module.parameters()).grad[:] = float("inf")

    monkeypatch.setattr(saving.Saving, "on_before_optimizer_step", spoil, raising=False)
    message = r"epoch 2, step 10: the gradient is nan or inf, after frames 00: \d+-\d+ .*learning_rate lower"
    for option in ("trainer.gradient_clip_val=1.0", "trainer.gradient_clip_val=null"):
        run = option.split("=")[1]
        with pytest.raises(InputError, match=message):
            train(configure("model=cnn_reg", *kitti, option, run=run))
        saved = torch.load(tmp_path / "outputs" / run / LAST, weights_only=True)
        assert saved["epoch"] == 0
        parts = ("model.encoder", "model.head")  # beside them is what has not been calibrated yet
        weights = [value for name, value in saved["state_dict"].items() if name.startswith(parts)]
        assert len(weights) > 12
        assert all(value.isfinite().all() for value in weights)


def test_bad_weights_are_not_saved(configure, kitti, tmp_path, monkeypatch, save_at_every_step):
    batch_end = TrainingLog.on_train_batch_end

    def spoil(self, trainer, module, *rest):
        batch_end(self, trainer, module, *rest)
        if trainer.global_step == 4:
            with torch.no_grad():
                list(module.parameters())[-1].fill_(float("nan"))

    monkeypatch.setattr(TrainingLog, "on_train_batch_end", spoil)
    with pytest.raises(InputError, match="step 4: a weight is nan or inf"):
        train(configure("model=cnn_reg", *kitti))
    assert torch.load(tmp_path / "outputs" / "run" / LAST, weights_only=True)["global_step"] == 3


class Malice:
    """What a stranger would put into a file: unpickled, it runs a command."""

    def __init__(self, proof):
        self.proof = proof

    def __reduce__(self):
        return os.system, (f"touch {self.proof}",)


def test_malicious_files_run_nothing(configure, kitti, tmp_path):
    proof, outputs = tmp_path / "proof", tmp_path / "outputs"
    malice = Malice(proof)
    pickle.loads(pickle.dumps(malice))
    assert proof.exists(), "the test itself is no threat"
    proof.unlink()
    train(configure("model=cnn_cls", *kitti, run="cnn"))
    evil = tmp_path / "evil.ckpt"
    refused = "not a checkpoint of this project"
    for content in ({"state_dict": malice}, malice):
        torch.save(content, evil)
        with pytest.raises(InputError, match=refused):
            train(configure("model=rcnn_reg", *kitti, f"model.pretrained={evil}", run="a"))
        with pytest.raises(InputError, match=refused):
            load_module(evil)
        last = outputs / "b" / LAST
        last.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(evil, last)
        with pytest.raises(InputError, match=refused):
            train(configure("model=cnn_reg", *kitti, run="b"))
        shutil.copyfile(evil, outputs / "cnn" / BEST)
        with pytest.raises(InputError, match=refused):
            evaluate(configure(f"run={outputs}/cnn", name="evaluate", run="c"))
    for scans in (outputs / "cache").glob("*.npy"):
        np.save(scans, np.array([malice], dtype=object), allow_pickle=True)
        scans.write_bytes(scans.read_bytes() + hashlib.sha256(scans.read_bytes()).digest())
    train(configure("model=cnn_reg", *kitti, run="d"))
    config = outputs / "cnn" / "config.yaml"
    config.write_text(f"data: !!python/object/apply:os.system ['touch {proof}']\nmodel: 1\ntrainer: 1\n")
    with pytest.raises(InputError, match="not the configuration of a run"):
        evaluate(configure(f"run={outputs}/cnn", name="evaluate", run="e"))
    assert not proof.exists()
