"""Modules: training, estimating whole drives, checkpoints."""

import io
import os
import pickle

import lightning as L
import numpy as np
import pytest
import torch

from odometry import DEVIATION, MEAN, NAMES, SENSOR, motions_like, options
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, compose, motions_of
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.two_numbers import steps_of
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.training import modules
from rcnn_odom.training.checkpoint import load_module
from rcnn_odom.training.datamodule import OdometryDataModule
from rcnn_odom.training.modules import OdometryModule, module_for
from rcnn_odom.training.windows import Windows

torch.set_num_threads(1)
LENGTHS = [5.0, 10.0]
NAMED = [
    modules.CNNRegression,
    modules.CNNClassification,
    modules.RCNNRegression,
    modules.RCNNClassification,
]


def build(variant, seed=0, sensor=SENSOR, **changes):
    torch.manual_seed(seed)
    module = module_for(variant)(options(variant, **changes), sensor.as_dict(), LENGTHS)
    module.set_units([steps_of(motions_like(MEAN, DEVIATION), "middle")])
    return module


def random_scans(frames, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).uniform(0, 40, (frames, 181)).astype(np.float32))


def small_data(module, frames=60):
    rng = np.random.default_rng(0)

    def drive(name):
        motions = np.stack([rng.normal(0.5, 0.2, frames - 1), rng.normal(0.01, 0.03, frames - 1)], axis=1)
        scans = rng.uniform(0, 40, (frames, 181)).astype(np.float32)
        poses = compose(steps_of(motions, "start"))
        return Drive(name, name, scans, poses, np.arange(float(frames)), FORWARD_CAMERA)

    recipe = {name: module.model.options[name] for name in ("window", "batch_size")}
    data = OdometryDataModule(None, ["a"], ["b"], ["c"], SENSOR, "unused", **recipe)
    data.drives = {split: [drive(split)] for split in ("train", "val", "test")}
    return data


def small_trainer(epochs=2):
    return L.Trainer(
        accelerator="cpu",
        max_epochs=epochs,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        gradient_clip_val=1.0,
    )


def save(module, path, **changes):
    """A checkpoint as Lightning writes it."""
    trainer = small_trainer()
    trainer.strategy.connect(module)
    trainer.save_checkpoint(path, weights_only=True)
    if changes:
        torch.save({**torch.load(path, weights_only=True), **changes}, path)
    return path


# --- training ------------------------------------------------------------------------------------


class Record(L.Callback):
    def __init__(self):
        self.losses = []

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx):
        self.losses.append(outputs["loss"].item())


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("variant", NAMES)
@pytest.mark.parametrize("per_sample_norm", [False, True])
def test_training_learns_from_finite_losses(variant, per_sample_norm):
    module = build(variant, per_sample_norm=per_sample_norm)
    before = {name: value.clone() for name, value in module.named_parameters()}
    data, trainer, record = small_data(module), small_trainer(), Record()
    trainer.callbacks.append(record)
    trainer.fit(module, datamodule=data)
    assert len(record.losses) == 2 * len(data.train_dataloader())
    assert np.isfinite(record.losses).all()
    for name, value in module.named_parameters():
        assert value.isfinite().all()
        assert not torch.equal(value, before[name]), name
    assert np.isfinite(float(trainer.callback_metrics["val/drift"]))


@pytest.mark.parametrize("variant", NAMES)
def test_loss_is_that_of_the_paper(variant):
    module = build(variant)
    rng = np.random.default_rng(1)
    pairs = rng.uniform(0, 40, (3, 5, 2, 181)).astype(np.float32)
    steps = rng.normal([0.5, 0.0, 0.0], [0.2, 0.1, 0.08], (3, 5, 3)).astype(np.float32)
    batch = {"pairs": torch.from_numpy(pairs), "steps": torch.from_numpy(steps), "frames": torch.arange(3)}
    outputs = module.training_step(batch, 0)
    assert "diverged" not in outputs
    truth = motions_of(steps)
    with torch.no_grad():
        estimate, _ = module.model.motions(torch.from_numpy(pairs))
    error = estimate.motion.numpy().astype(np.float64) - truth
    distance, rotation = np.sqrt((error**2).mean((0, 1)))
    if variant.endswith("cls"):
        scores = estimate.scores.numpy().astype(np.float64)
        share = np.exp(scores) / np.exp(scores).sum(-1, keepdims=True)
        number = np.clip(np.floor(np.degrees(truth[..., 1]) / 0.1) + 56, 0, 111).astype(int)
        rotation = -np.log(np.take_along_axis(share, number[..., None], -1)).mean()
        outside = (np.abs(np.degrees(truth[..., 1])) > 5.6).mean()
        assert outputs["headings_outside_classes"].item() == pytest.approx(outside)
    expected = distance + (1 if variant.endswith("cls") else 100) * rotation
    assert outputs["loss"].item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.filterwarnings("ignore")
def test_every_epoch_draws_other_windows(monkeypatch):
    draws = []
    original = Windows.__getitems__

    def spy(self, batch):
        draws.append([frame for frame, _, _ in batch])
        return original(self, batch)

    monkeypatch.setattr(Windows, "__getitems__", spy)
    module = build("cnn_reg")
    data = small_data(module)
    small_trainer().fit(module, datamodule=data)
    half = len(data.train_dataloader())
    assert len(draws) == 2 * half
    assert draws[:half] != draws[half:]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("freeze", [False, True])
def test_first_stage_is_taken_over_and_frozen_if_asked_for(freeze):
    cnn, module = build("cnn_cls", seed=5), build("rcnn_reg", seed=6, freeze=freeze)
    cnn.set_units([steps_of(motions_like(MEAN + 1, DEVIATION * 2), "middle")])
    module.model.take_first_stage(cnn.model)
    scans = random_scans(9)
    pairs = torch.stack([scans[:-1], scans[1:]], 1)[None]
    taken, given = (model.motions(pairs)[0] for model in (module.model, cnn.model))
    torch.testing.assert_close(taken.first_stage, given.motion)
    small_trainer(1).fit(module, datamodule=small_data(module))
    pair = module.model.cnn.parameters(), cnn.model.parameters()
    same = [torch.equal(a, b) for a, b in zip(*pair, strict=True)]
    assert all(same) if freeze else not any(same)


def test_units_of_training_drives_with_one_step_alone_are_not_zero():
    module = build("rcnn_reg")
    module.set_units([np.tile([1.0, 0.2, 0.0], (4, 1))])
    np.testing.assert_allclose(module.mean_step, [1.0, 0.2, 0.0], rtol=1e-6)
    for head in (module.model.head, module.model.cnn.head):
        assert (head.deviation > 0).all()


# --- estimating ----------------------------------------------------------------------------------


def in_one_pass(module, scans):
    with torch.no_grad():
        steps, _, _ = module.model(torch.stack([scans[:-1], scans[1:]], 1)[None])
    return steps[0].double().numpy()


def estimate(module, scans):
    return module.model.estimate_scans(scans).values


@pytest.mark.parametrize("variant", NAMES)
@pytest.mark.parametrize("frames", [2, 64, 65, 66, 129, 155])
def test_estimate_equals_a_single_pass(variant, frames):
    module, scans = build(variant).eval(), random_scans(frames)
    steps = estimate(module, scans)
    assert steps.shape == (frames - 1, 3)
    assert steps.dtype == np.float64
    np.testing.assert_allclose(steps, in_one_pass(module, scans), atol=1e-5)


@pytest.mark.parametrize("variant", ["rcnn_reg", "rcnn_cls"])
def test_lstm_remembers_across_the_chunk_border(variant):
    module, scans = build(variant).eval(), random_scans(155)
    whole = estimate(module, scans)
    # The second chunk begins with frame 64: alone it would know nothing of those before.
    alone = estimate(module, scans[64:])
    assert np.abs(alone[0] - whole[64]).max() > 1e-4
    changed = scans.clone()
    changed[60] = 0
    assert np.abs(estimate(module, changed)[64:66] - whole[64:66]).max() > 1e-6


@pytest.mark.parametrize("variant", NAMES)
def test_estimate_has_no_memory_between_drives(variant):
    module, scans = build(variant).eval(), random_scans(20)
    first = estimate(module, scans)
    estimate(module, random_scans(30, seed=1))
    np.testing.assert_array_equal(estimate(module, scans), first)


@pytest.mark.parametrize("variant", NAMES)
def test_training_mode_and_autocast_do_not_change_estimates(variant):
    module, scans = build(variant), random_scans(70)
    expected = estimate(module.eval(), scans)
    np.testing.assert_array_equal(estimate(module.train(), scans), expected)
    with torch.autocast("cpu", torch.bfloat16):
        np.testing.assert_array_equal(estimate(module, scans), expected)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("variant", NAMES)
def test_trainers_test_gives_the_estimates_of_each_drive(variant):
    module = build(variant)
    data = small_data(module)
    small_trainer().test(module, datamodule=data, verbose=False)
    expected = in_one_pass(module, torch.from_numpy(data.drives["test"][0].scans))
    assert list(module.estimates) == ["test"]
    np.testing.assert_allclose(module.estimates["test"].values, expected, atol=1e-5)


# --- checkpoints ---------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", NAMES)
def test_checkpoint_gives_the_same_estimates(tmp_path, variant):
    module, scans = build(variant), random_scans(70)
    path = save(module, tmp_path / "best.ckpt")
    loaded = load_module(path, variant, SENSOR)
    assert type(loaded) is NAMED[NAMES.index(variant)]
    assert loaded.variant == loaded.model.name == variant
    assert not loaded.training
    assert loaded.model.options == module.model.options
    assert loaded.lengths == LENGTHS
    np.testing.assert_array_equal(estimate(loaded, scans), estimate(module.eval(), scans))
    np.testing.assert_array_equal(loaded.mean_step, module.mean_step)


def as_of_old(path, module):
    """A checkpoint as version 0.1 wrote it: other names, and less known."""
    saved = torch.load(save(module, path), weights_only=True)
    weights = {}
    for name, value in saved["state_dict"].items():
        name = name.removeprefix("model.")
        if name in ("least_filled", "period"):
            weights[f"uncertainty.{name}"] = value
        elif name == "uncertainty.weights":
            weights[name] = value
        elif name.split(".")[0] in ("encoder", "head", "cnn", "lstm", "projection"):
            weights[f"network.{name}"] = value
        else:
            assert name in ("mean_step", "typical_step", "uncertainty.lateral")
    settings = saved["hyper_parameters"]
    model = {key: value for key, value in settings["model"].items() if key != "apply"}
    saved["hyper_parameters"] = {
        "variant": settings["variant"],
        "model": {"variant": settings["variant"], **model},
        "sensor": settings["sensor"],
        "scoring": {"lengths": settings["lengths"], "apply": settings["model"]["apply"]},
    }
    torch.save({**saved, "state_dict": weights}, path)
    return path


@pytest.mark.parametrize("variant", NAMES)
def test_checkpoint_of_an_older_version_gives_the_same_estimates(tmp_path, variant):
    module, scans = build(variant, apply="end").eval(), random_scans(70)
    module.model.uncertainty.weights.fill_(0.1)
    module.model.least_filled.fill_(0.3)
    module.model.period.fill_(0.2)
    loaded = load_module(as_of_old(tmp_path / "old.ckpt", module), variant, SENSOR)
    np.testing.assert_array_equal(estimate(loaded, scans), estimate(module, scans))
    assert loaded.lengths == LENGTHS
    assert loaded.model.options["apply"] == "end"
    assert "variant" not in loaded.model.options
    assert [float(loaded.model.least_filled), float(loaded.model.period)] == pytest.approx([0.3, 0.2])
    # Only what two numbers say is known: no variance but the heading's, and no sideways part.
    covariances = loaded.model.estimate_scans(scans).covariances
    expected = module.model.estimate_scans(scans).covariances
    np.testing.assert_allclose(covariances[:, 2, 2], expected[:, 2, 2])
    assert np.isnan(covariances[:, :2, :2]).all()
    distance, turn = np.hypot(MEAN, DEVIATION)
    np.testing.assert_allclose(loaded.model.typical_step, [distance, np.nan, turn], rtol=1e-6)
    np.testing.assert_allclose(loaded.mean_step, steps_of(MEAN, "end"), rtol=1e-6)


def test_older_checkpoint_of_another_form_is_refused(tmp_path):
    path = as_of_old(tmp_path / "old.ckpt", build("cnn_reg"))
    saved = torch.load(path, weights_only=True)
    saved["state_dict"]["decoder.weight"] = torch.zeros(3)
    torch.save(saved, path)
    with pytest.raises(InputError, match=r"old\.ckpt: not a checkpoint of this project, or of an older"):
        load_module(path)


def test_modules_of_the_paper_know_their_model():
    assert [type(build(name)) for name in NAMES] == NAMED
    assert module_for("another").func is OdometryModule


def test_checkpoint_holds_plain_values_only(tmp_path):
    saved = torch.load(save(build("rcnn_cls"), tmp_path / "best.ckpt"), weights_only=True)
    assert saved["hyper_parameters"]["variant"] == "rcnn_cls"
    assert saved["hyper_parameters"]["sensor"] == SENSOR.as_dict()


def test_other_variant_is_refused(tmp_path):
    path = save(build("cnn_reg"), tmp_path / "best.ckpt")
    with pytest.raises(InputError, match=r"best\.ckpt: a checkpoint of cnn_reg, but cnn_cls is needed"):
        load_module(path, "cnn_cls")


def test_other_sensor_is_refused(tmp_path):
    path = save(build("cnn_reg"), tmp_path / "best.ckpt")
    with pytest.raises(InputError, match=r"best\.ckpt: trained with .*180.*360"):
        load_module(path, sensor=Sensor())


class Evil:
    """Unpickled without care, makes a folder."""

    def __init__(self, folder):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (self.folder,)


@pytest.mark.parametrize("place", ["pickle", "whole", "hyper_parameters", "state_dict"])
def test_code_in_a_checkpoint_is_not_run(tmp_path, place):
    made, path = str(tmp_path / "made"), tmp_path / "evil.ckpt"
    if place == "pickle":
        path.write_bytes(pickle.dumps(Evil(made), protocol=2))
    elif place == "whole":
        torch.save(Evil(made), path)
    else:
        saved = torch.load(save(build("cnn_reg"), path), weights_only=True)
        saved[place]["extra"] = Evil(made)
        torch.save(saved, path)
    with pytest.raises(InputError, match=r"evil\.ckpt: not a checkpoint"):
        load_module(path)
    assert not os.path.exists(made)


def stored(content):
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


GARBAGE = {
    "empty": b"",
    "text": b"this is not a checkpoint\n",
    "stop": b".",
    "zeros": bytes(100),
    "truncated": stored({"state_dict": torch.zeros(1000)})[:700],
    "number": stored(5),
    "tensor": stored(torch.zeros(3)),
    "list": stored([1, 2]),
    "no-variant": stored({"hyper_parameters": {}, "state_dict": {}}),
    "no-hyper-parameters": stored({"state_dict": {}}),
    "unknown-variant": stored({"hyper_parameters": {"variant": "resnet"}, "state_dict": {}}),
    "no-settings": stored({"hyper_parameters": {"variant": "cnn_reg"}, "state_dict": {}}),
}


@pytest.mark.parametrize("content", GARBAGE.values(), ids=GARBAGE.keys())
def test_garbage_is_refused(tmp_path, content):
    path = tmp_path / "garbage.ckpt"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"garbage\.ckpt"):
        load_module(path)


def test_missing_weights_are_refused(tmp_path):
    path = save(build("cnn_reg"), tmp_path / "best.ckpt", state_dict={})
    with pytest.raises(InputError, match=r"best\.ckpt"):
        load_module(path)


def test_missing_file_and_folder_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such checkpoint"):
        load_module(tmp_path / "absent.ckpt")
    with pytest.raises(InputError, match="not a checkpoint"):
        load_module(tmp_path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty, not a checkpoint; give RUN/checkpoints/best.ckpt of a run"),
        (b"this is text\n", "not a checkpoint; give RUN/checkpoints/best.ckpt of a run"),
        (
            stored(Evil("made")),
            "not a checkpoint of this project, or of an older version (it holds more than numbers)",
        ),
    ],
)
def test_what_is_no_checkpoint_is_told_in_a_short_line(tmp_path, content, message):
    path = tmp_path / "best.ckpt"
    path.write_bytes(content)
    with pytest.raises(InputError) as refused:
        load_module(path)
    assert str(refused.value).startswith(f"{path}: {message}")
    assert len(str(refused.value)) < len(str(path)) + 120
