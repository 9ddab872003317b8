"""Options of Lightning's Trainer: each that is allowed trains, each other one is refused with what to use."""

import inspect
import json
from dataclasses import fields

import lightning as L
import pytest
import torch
from test_saving import assert_same, result_of

from evaluate import evaluate
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import BEST, LAST
from rcnn_odom.evaluation.sweep_report.folders import read_run
from rcnn_odom.training import saving, stages
from rcnn_odom.training.modules import OdometryModule
from rcnn_odom.training.run_state import State, fingerprints, state_of
from rcnn_odom.training.settings import plain
from rcnn_odom.training.trainer_options import INSTEAD, TrainerOptions, explain_refusal, max_time_in_seconds
from train import train


@pytest.fixture
def steps(monkeypatch):
    """Fills with the learning rate of each training step."""
    rates = []
    step = OdometryModule.training_step

    def training_step(self, batch, index):
        rates.append(self.trainer.optimizers[0].param_groups[0]["lr"])
        return step(self, batch, index)

    monkeypatch.setattr(OdometryModule, "training_step", training_step)
    return rates


# --- which there are -----------------------------------------------------------------------------


def test_every_option_of_lightning_is_allowed_or_refused_by_name():
    allowed = {each.name for each in fields(TrainerOptions)}
    theirs = set(inspect.signature(L.Trainer.__init__).parameters) - {"self"}
    assert theirs == allowed | INSTEAD.keys()
    assert not allowed & INSTEAD.keys()


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("+trainer.limit_val_batches=1", "validation uses whole drives after every epoch"),
        ("+trainer.check_val_every_n_epoch=2", "validation uses whole drives after every epoch"),
        ("+trainer.overfit_batches=1", "set data.train"),
        ("+trainer.max_epochs=3", "set model.epochs"),
        ("+trainer.max_steps=3", "set model.epochs"),
        ("+trainer.accumulate_grad_batches=2", "set model.batch_size"),
        ("+trainer.default_root_dir=here", "set run_dir"),
        ("+trainer.logger=false", "leave it out"),
        ("+trainer.num_nodes=2", "trainer=ddp trainer.devices"),
        ("+trainer.foo=1", "there is no such option; there are accelerator, benchmark"),
        ("+trainer.strategy=fsdp", "choose one of auto, ddp_spawn"),
        ("+trainer.limit_train_batches=0.5", "a whole number of batches above 0"),
        ("+trainer.limit_train_batches=0", "a whole number of batches above 0"),
        ("+trainer.fast_dev_run=-1", "true, or a number of training batches"),
        ("+trainer.max_time=30", "a time above 0, for instance 00:01:30:00"),
        ("+trainer.max_time=00:30", "a time above 0"),
        ("+trainer.max_time={hour: 1}", "a time above 0"),
        ("+trainer.max_time=00:00:00:00", "a time above 0"),
        ("trainer.devices=two", "a number of devices"),
        ("trainer.devices=0", "a number of devices"),
        ("trainer.devices=auto", "trainer=ddp trainer.devices"),
        ("+trainer.deterministic=maybe", "true, false or warn"),
    ],
)
def test_what_has_no_meaning_is_refused_before_anything_is_encoded(
    configure, kitti, tmp_path, option, message
):
    with pytest.raises(InputError, match=rf"^trainer\.\w+.*: .*{message}"):
        train(configure("model=cnn_reg", *kitti, option))
    assert not (tmp_path / "outputs").exists()
    if "devices" not in option:
        with pytest.raises(InputError, match=r"^trainer\."):
            evaluate(configure("model=matcher", *kitti, option, name="evaluate"))


@pytest.mark.parametrize("option", ["max_time=00:00:01:00", "fast_dev_run=true", "limit_train_batches=2"])
def test_options_of_training_are_refused_where_nothing_is_trained(configure, kitti, option):
    with pytest.raises(InputError, match="nothing is trained; leave it out"):
        evaluate(configure("model=matcher", *kitti, f"+trainer.{option}", name="evaluate"))


def test_every_refusal_says_what_to_do():
    for name in (*INSTEAD, "foo"):
        assert explain_refusal(name).startswith(f"trainer.{name}: ")
        assert ";" in explain_refusal(name) or "set " in explain_refusal(name)


@pytest.mark.parametrize(
    "option",
    [
        "gradient_clip_algorithm=norm",
        *(
            pytest.param(option, marks=pytest.mark.slow)
            for option in (
                "strategy=auto",
                "deterministic=warn",
                "benchmark=true",
                "detect_anomaly=true",
                "sync_batchnorm=true",
                "fast_dev_run=0",
                "max_time=null",
            )
        ),
    ],
)
def test_what_is_allowed_trains(configure, kitti, option):
    try:
        metrics = train(configure("model=cnn_reg", *kitti, f"+trainer.{option}"))
    finally:
        torch.use_deterministic_algorithms(False)
        torch.autograd.set_detect_anomaly(False)
    assert metrics["training"]["epochs"] == 2
    assert metrics["training"]["steps"] == 14


def test_an_option_that_is_off_makes_no_other_training(configure, kitti):
    off = plain(configure("model=cnn_reg", *kitti, "+trainer.fast_dev_run=false", "+trainer.max_time=null"))
    assert off == plain(configure("model=cnn_reg", *kitti))


# --- fewer batches -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "batches"), [("true", 1), ("3", 3), pytest.param("99", 7, marks=pytest.mark.slow)]
)
def test_fast_dev_run_is_one_epoch_of_so_many_batches_and_whole_drives(
    configure, kitti, tmp_path, steps, value, batches
):
    metrics = train(configure("model=cnn_reg", *kitti, f"+trainer.fast_dev_run={value}"))
    assert len(steps) == batches
    assert metrics["training"]["epochs"] == 1
    assert metrics["training"]["steps"] == batches
    assert metrics["val"]["drift"] > 0
    assert metrics["test"]["sequences"]["05"]["frames"] == 60
    assert json.loads((tmp_path / "outputs" / "run" / "metrics.json").read_text()) == metrics
    assert (
        state_of(tmp_path / "outputs" / "run", plain(configure("model=cnn_reg", *kitti))).state is State.OTHER
    )


@pytest.mark.slow
def test_fast_dev_run_is_for_both_stages(configure, kitti, tmp_path, steps):
    metrics = train(
        configure("model=rcnn_reg", *kitti, "model.first_stage.epochs=3", "+trainer.fast_dev_run=2")
    )
    first = json.loads((tmp_path / "outputs" / "run" / "first_stage" / "metrics.json").read_text())
    for training in (metrics["training"], first["training"]):
        assert (training["epochs"], training["steps"]) == (1, 1 if training is metrics["training"] else 2)
    assert len(steps) == 3, "an epoch of the second stage has one batch here"


def test_the_schedule_ends_with_the_batches_that_are_trained(configure, kitti, steps):
    train(configure("model=cnn_reg", *kitti, "+trainer.limit_train_batches=3"))
    optimizer = torch.optim.Adam([torch.zeros(1, requires_grad=True)], lr=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-3, total_steps=6)
    expected = []
    for _ in range(6):
        expected.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert steps == pytest.approx(expected)


# --- a limited time ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("max_time", "seconds"),
    [
        ("00:00:00:30", 30),
        ("1:02:03:04", 93784),
        ({"minutes": 1}, 60),
        ({"hours": 1, "seconds": 0.5}, 3600.5),
        ("00:30", None),
        ("a:b:c:d", None),
        ({"hour": 1}, None),
        ({"seconds": -1}, None),
        ({"days": 10**20}, None),
    ],
)
def test_forms_of_a_time(max_time, seconds):
    assert max_time_in_seconds(max_time) == seconds


def time_out_after(monkeypatch, step):
    """Lets the time be over after a step; None: never."""

    def wish(self):
        return (
            saving.TIME_UP
            if self.seconds is not None and self._trainer.global_step >= step
            else saving.CONTINUE
        )

    start = saving.Saving.on_train_start

    def on_train_start(self, trainer, module):
        self._trainer = trainer
        start(self, trainer, module)

    monkeypatch.setattr(saving.Saving, "on_train_start", on_train_start)
    monkeypatch.setattr(saving.Saving, "_own_request", wish)


# Within the first epoch, at its end, within the second one.
@pytest.mark.parametrize(
    ("step", "epochs"),
    [(3, 0), *(pytest.param(step, 1, marks=pytest.mark.slow) for step in (7, 10))],
)
def test_a_training_whose_time_is_up_is_scored_and_goes_on_to_the_same_result(
    configure, kitti, tmp_path, monkeypatch, caplog, step, epochs
):
    caplog.set_level("INFO")
    options = ["model=cnn_reg", *kitti]
    train(configure(*options, run="whole"))
    with monkeypatch.context() as patch:
        time_out_after(patch, step)
        metrics = train(configure(*options, "+trainer.max_time={minutes: 1}"))
    run = tmp_path / "outputs" / "run"
    training = metrics["training"]
    assert (training["epochs"], training["steps"]) == (epochs, step)
    assert training["stopped_by"] == "trainer.max_time"
    assert (metrics["val"]["drift"] is None) == (epochs == 0)
    assert metrics["test"]["sequences"]["05"]["frames"] == 60
    assert (
        f"stopped by trainer.max_time after {epochs} of 2 epochs; the same command continues it"
        in caplog.text
    )
    assert (run / LAST).exists()
    assert (run / BEST).exists()
    assert (
        evaluate(configure(f"run={run}", name="evaluate", run="scored"))["test"]["drift"]
        == metrics["test"]["drift"]
    )
    train(configure(*options, "+trainer.max_time=01:00:00:00"))
    assert f"continuing from {run / LAST}, step {step}" in caplog.text
    assert not (run / LAST).exists()
    assert_same(result_of(run), result_of(tmp_path / "outputs" / "whole"))
    assert "stopped_by" not in json.loads((run / "metrics.json").read_text())["training"]


def test_the_end_of_the_last_epoch_is_the_end_whatever_the_time(configure, kitti, monkeypatch):
    time_out_after(monkeypatch, 14)
    assert (
        "stopped_by"
        not in train(configure("model=cnn_reg", *kitti, "+trainer.max_time=00:00:01:00"))["training"]
    )


def test_the_time_is_that_of_one_sitting(configure, kitti):
    options = ["model=cnn_reg", *kitti, "model.epochs=40", "+trainer.max_time={milliseconds: 1}"]
    assert [train(configure(*options))["training"]["steps"] for _ in range(3)] == [1, 2, 3]


def test_a_run_whose_time_was_up_is_unfinished_for_everyone(configure, kitti, tmp_path, monkeypatch):
    options = ["model=cnn_cls", *kitti, "model.epochs=1", "+trainer.max_time=00:00:01:00"]
    with monkeypatch.context() as patch:
        time_out_after(patch, 3)
        train(configure(*options))
    run, outputs = tmp_path / "outputs" / "run", tmp_path / "outputs"
    found = read_run(run, "run")
    assert (found.status, found.problem) == (
        "unfinished",
        "stopped by trainer.max_time; the same command continues it",
    )
    settings = plain(configure(*options))
    wanted = fingerprints(settings, stages.build_datamodule(settings).load())
    assert state_of(run, settings, wanted).state is State.STOPPED
    assert state_of(run, plain(configure(*options[:-1])), wanted).state is State.STOPPED
    assert state_of(tmp_path / "new", settings, wanted, outputs).state is State.NEW, (
        "its weights are no twin's"
    )
    # A job of a sweep that is started again goes on.
    assert "stopped_by" not in stages.train(settings, reuse=True)["training"]
    assert state_of(run, settings, wanted).state is State.FINISHED
    assert state_of(tmp_path / "new", settings, wanted, outputs).state is State.TWIN


@pytest.mark.slow
def test_a_second_stage_waits_for_a_whole_first_one(configure, kitti, tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    options = ["model=rcnn_reg", *kitti, "+trainer.max_time=00:00:01:00"]
    with monkeypatch.context() as patch:
        time_out_after(patch, 3)
        assert train(configure(*options)) is None
        # Another run does not take what is not whole.
        assert train(configure(*options, run="other")) is None
    run = tmp_path / "outputs" / "run"
    assert "stopped by trainer.max_time after 0 of 1 epochs; the same command continues it" in caplog.text
    assert "the first stage is not finished, so the second one cannot start" in caplog.text
    assert not (run / "metrics.json").exists()
    assert read_run(run, "run").status == "unfinished"
    metrics = train(configure(*options))
    assert metrics["first_stage"] == str(run / "first_stage" / BEST)
    train(configure(*options[:-1], f"outputs={tmp_path}/others", f"run_dir={tmp_path}/others/run"))
    assert_same(result_of(run), result_of(tmp_path / "others" / "run"))


@pytest.mark.slow
def test_both_stages_share_the_time(configure, kitti, monkeypatch):
    spent = []
    start = saving.Saving.on_train_start

    def on_train_start(self, trainer, module):
        spent.append(self.spent)
        start(self, trainer, module)

    monkeypatch.setattr(saving.Saving, "on_train_start", on_train_start)
    train(configure("model=rcnn_reg", *kitti, "+trainer.max_time=00:01:00:00"))
    assert spent[0] < spent[1]
