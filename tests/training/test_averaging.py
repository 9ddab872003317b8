"""The moving average of the weights: what validates, is kept and is gone on from."""

import os
import signal
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest
import torch
from test_saving import assert_same, kill_after, result_of

from conftest import configure_in
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import BEST, LAST
from rcnn_odom.training import averaging, saving, stages
from rcnn_odom.training.averaging import Averaging
from rcnn_odom.training.checkpoint import load_module
from rcnn_odom.training.modules import OdometryModule
from rcnn_odom.training.run_state import State, settings_fingerprint, state_of, write_config
from rcnn_odom.training.settings import plain
from train import train

AVERAGED = "model.averaging=0.7"
"""A decay that the warm-up reaches at step 21: some of a training's steps are before, some behind it."""
STEPS = 7
"""Of an epoch of the tiny recordings."""


def weights_of(module):
    return {name: value.detach().numpy().copy() for name, value in module.named_parameters()}


class Watch:
    """What a training's weights are, after every step and in every validation."""

    def __init__(self, monkeypatch):
        self.after_step, self.in_validation = [], []
        batch_end, validation_step = saving.Saving.on_train_batch_end, OdometryModule.validation_step

        def watch_step(callback, trainer, module, *rest):
            self.after_step.append(weights_of(module))
            batch_end(callback, trainer, module, *rest)

        def watch_validation(module, batch, batch_idx):
            self.in_validation.append(weights_of(module))
            return validation_step(module, batch, batch_idx)

        monkeypatch.setattr(saving.Saving, "on_train_batch_end", watch_step)
        monkeypatch.setattr(OdometryModule, "validation_step", watch_validation)

    def average(self, decay, steps):
        """By its definition, in double precision: weights of their own for all steps."""
        share = np.ones(1)
        for n in range(1, steps):
            kept = min(decay, (1 + n) / (10 + n))
            share = np.append(share * kept, 1 - kept)
        assert share.sum() == pytest.approx(1)
        return {
            name: np.tensordot(share, np.stack([each[name] for each in self.after_step[:steps]]), 1)
            for name in self.after_step[0]
        }


def assert_close(weights, expected):
    for name, value in expected.items():
        np.testing.assert_allclose(weights[name], value, rtol=1e-5, atol=1e-6, err_msg=name)


def differ(weights, others):
    return max(float(np.abs(np.asarray(weights[name]) - others[name]).max()) for name in others) > 1e-4


def best_of(run):
    return torch.load(run / BEST, weights_only=True)["state_dict"]


def test_the_average_is_validated_and_kept_while_training_goes_on_without_it(
    configure, kitti, tmp_path, monkeypatch
):
    options = ["model=cnn_cls", *kitti, "model.epochs=4"]
    with monkeypatch.context() as patch:
        alone = Watch(patch)
        train(configure(*options, run="alone"))
    watch = Watch(monkeypatch)
    train(configure(*options, AVERAGED))
    assert len(watch.after_step) == 4 * STEPS
    for step, (one, other) in enumerate(zip(watch.after_step, alone.after_step, strict=True)):
        assert all(np.array_equal(value, other[name]) for name, value in one.items()), step
    averages = [watch.average(0.7, STEPS * epoch) for epoch in range(1, 5)]
    for epoch, (weights, expected) in enumerate(zip(watch.in_validation, averages, strict=True)):
        assert_close(weights, expected)
        assert differ(weights, watch.after_step[STEPS * epoch + STEPS - 1]), "the test shows nothing"
    curves = result_of(tmp_path / "outputs" / "run")[2]
    drifts = [value for _, value in curves["Validation: after each epoch/drift in %, all drives"]]
    best = {name: value.numpy() for name, value in best_of(tmp_path / "outputs" / "run").items()}
    assert_close(best, averages[int(np.argmin(drifts))])


def test_buffers_are_those_of_the_network(configure, kitti, tmp_path):
    train(configure("model=cnn_cls", *kitti, run="alone"))
    train(configure("model=cnn_cls", *kitti, AVERAGED))
    run, alone = (load_module(tmp_path / "outputs" / run / BEST) for run in ("run", "alone"))
    buffers = dict(run.named_buffers())
    # Beside them is what was fitted to the errors of the weights.
    same = ("mean_step", "model.typical_step", "model.head.mean", "model.head.deviation", "model.period")
    for name in same:
        assert torch.equal(buffers[name], dict(alone.named_buffers())[name]), name
    assert all(buffers[name].isfinite().all() for name in (*same[2:], "model.least_filled"))


def test_a_second_stage_begins_with_the_averaged_first(configure, kitti, tmp_path, monkeypatch):
    watch = Watch(monkeypatch)
    options = ["model.first_stage.averaging=0.7", AVERAGED, "model.freeze=true", "model.epochs=1"]
    train(configure("model=rcnn_reg", *kitti, *options))
    first, run = best_of(tmp_path / "outputs" / "run" / "first_stage"), best_of(tmp_path / "outputs" / "run")
    assert_close({name: value.numpy() for name, value in first.items()}, watch.average(0.7, STEPS))
    names = [name for name in watch.after_step[0] if name.startswith("model.encoder")]
    assert names
    for name in names:  # which is frozen, and so is its own average
        assert torch.equal(first[name], run[name.replace("model.", "model.cnn.", 1)]), name


def test_stopped_before_the_first_validation_the_average_is_scored(configure, kitti, tmp_path, monkeypatch):
    options, run = ["model=cnn_cls", *kitti, AVERAGED], tmp_path / "outputs" / "run"
    train(configure(*options, run="whole"))
    with monkeypatch.context() as patch:
        watch = Watch(patch)
        patch.setattr(
            saving.Saving,
            "_agree",
            lambda self, trainer, wanted: saving.TIME_UP if trainer.global_step == 5 else wanted,
        )
        metrics = train(configure(*options))
    assert metrics["training"]["stopped_by"] == "trainer.max_time"
    best = {name: value.numpy() for name, value in best_of(run).items()}
    assert_close(best, watch.average(0.7, 5))
    assert differ(best, watch.after_step[-1])
    train(configure(*options))
    assert_same(*(result_of(tmp_path / "outputs" / name) for name in ("run", "whole")))


@pytest.mark.parametrize("where", ["a step", "a validation"])
def test_asked_to_stop_it_goes_on_bit_for_bit(configure, kitti, tmp_path, monkeypatch, where):
    options = ["model=cnn_cls", *kitti, AVERAGED]
    train(configure(*options, run="whole"))
    in_step, in_validation = (saving.Saving, "on_train_batch_start"), (OdometryModule, "validation_step")
    hooked = in_step if where == "a step" else in_validation
    wrapped, calls = getattr(*hooked), []

    def interrupt(*arguments):
        calls.append(1)
        if len(calls) == (3 if where == "a step" else 1):
            os.kill(os.getpid(), signal.SIGINT)
        return wrapped(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(*hooked, interrupt)
        with pytest.raises(KeyboardInterrupt):
            train(configure(*options))
    saved = torch.load(tmp_path / "outputs" / "run" / LAST, weights_only=True)
    assert saved["global_step"] == (3 if where == "a step" else STEPS)
    train(configure(*options))
    assert_same(*(result_of(tmp_path / "outputs" / name) for name in ("run", "whole")))


class KeepingAverages(Averaging):
    """Leaves what every process has at the end of an epoch beside the checkpoints."""

    def on_train_epoch_end(self, trainer, pl_module):
        super().on_train_epoch_end(trainer, pl_module)
        own, average = pl_module.state_dict(), self._average_model.module.state_dict()
        folder = Path(trainer.checkpoint_callback.dirpath)
        torch.save((own, average), folder / f"{trainer.current_epoch}-of-{trainer.global_rank}.pt")


@pytest.fixture(scope="module")
def of_two_processes(kitti, tmp_path_factory):
    """Options of a training, and the folder of one that nobody has stopped.

    The validation has one drive, so that there is nothing to do in it for one of the two.
    """
    options, folder = ["model=cnn_cls", *kitti, "trainer=ddp", AVERAGED], tmp_path_factory.mktemp("two")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stages, "Averaging", KeepingAverages)
        train(configure_in(folder)(*options))
    return options, folder / "outputs" / "run"


@pytest.mark.slow
def test_all_processes_have_the_same_average(of_two_processes):
    folder = (of_two_processes[1] / BEST).parent
    for epoch in range(2):
        (own, average), (own_too, average_too) = (
            torch.load(folder / f"{epoch}-of-{rank}.pt", weights_only=True) for rank in range(2)
        )
        for name, value in own.items():
            assert torch.equal(value.nan_to_num(), own_too[name].nan_to_num()), name
            assert torch.equal(average[name].nan_to_num(), average_too[name].nan_to_num()), name
        weights = [name for name in own if name.startswith("model.encoder")]
        assert not all(torch.equal(own[name], average[name]) for name in weights)


@pytest.mark.slow
def test_processes_whose_time_is_up_go_on_bit_for_bit(configure, of_two_processes, tmp_path):
    options, whole = of_two_processes
    metrics = train(configure(*options, "+trainer.max_time={milliseconds: 1}"))
    assert metrics["training"]["steps"] == 1
    train(configure(*options))
    assert_same(result_of(tmp_path / "outputs" / "run"), result_of(whole))


def test_a_killed_training_goes_on_by_its_fingerprint(configure, kitti, tmp_path, monkeypatch):
    monkeypatch.setattr(saving, "SAVE_EVERY_SECONDS", -1.0)
    options = ["model=cnn_cls", *kitti]
    kill_after(monkeypatch, 3, lambda: train(configure(*options, AVERAGED)))
    with pytest.raises(InputError, match="started with other settings"):
        train(configure(*options, "model.averaging=0.8"))
    settings = {value: plain(configure(*options, f"model.averaging={value}")) for value in (0.0, 0.7, 0.8)}
    data = stages.build_datamodule(settings[0.0]).load(("train", "val"))
    prints = [settings_fingerprint(each, data) for each in settings.values()]
    assert len(set(prints)) == 3
    first_stage = [
        plain(configure("model=rcnn_reg", *kitti, f"model.first_stage.averaging={value}"))
        for value in (0.0, 0.7)
    ]
    assert len({settings_fingerprint(each, data) for each in first_stage}) == 2


def test_without_averaging_a_run_of_an_earlier_version_goes_on(configure, kitti, tmp_path):
    settings = plain(configure("model=rcnn_reg", *kitti))
    earlier = deepcopy(settings)
    del earlier["model"]["averaging"], earlier["model"]["first_stage"]["averaging"]
    write_config(tmp_path / "begun", earlier)
    assert state_of(tmp_path / "begun", settings).state is State.STOPPED
    data = stages.build_datamodule(settings).load(("train", "val"))
    assert settings_fingerprint(settings, data) == settings_fingerprint(earlier, data)
    averaged = plain(configure("model=rcnn_reg", *kitti, AVERAGED))
    assert state_of(tmp_path / "begun", averaged).state is State.OTHER


@pytest.mark.parametrize("value", ["1.5", "1", "-0.1", "true", "null"])
def test_what_is_no_decay_is_refused_in_a_line(configure, kitti, value):
    with pytest.raises(
        InputError, match=r"model\.averaging=.*: must be a number from 0 and below 1"
    ) as error:
        train(configure("model=cnn_cls", *kitti, f"model.averaging={value}"))
    assert "\n" not in str(error.value)


def test_first_steps_do_not_linger():
    assert [averaging.decay_after(n, 0.998) for n in (1, 90)] == [2 / 11, 0.91]
    assert averaging.decay_after(10_000, 0.998) == 0.998
