"""What every model has, whichever it is."""

import subprocess
import sys
from dataclasses import dataclass

import hydra
import numpy as np
import pytest
import torch
from hydra import initialize_config_dir
from omegaconf import OmegaConf

from conftest import ROOT
from odometry import ANGLES, NAMES, SENSOR, build, options, random_scans
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, compose, relative_steps
from rcnn_odom.models.contract import Model, all_models, check_model, find_model
from rcnn_odom.models.tracking import estimate_by_tracking
from rcnn_odom.models.trained import TrainedModel
from rcnn_odom.models.two_numbers import steps_of
from rcnn_odom.options import check_options
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.training import settings  # noqa: F401  (what the files of conf look up)

torch.set_num_threads(1)


def batch_of(windows=3, pairs=4, seed=0):
    rng = np.random.default_rng(seed)
    scans = rng.uniform(0, 40, (windows, pairs, 2, 181)).astype(np.float32)
    motions = rng.normal([0.5, 0.0], [0.2, 0.08], (windows, pairs, 2))
    steps = steps_of(motions, "middle").astype(np.float32)
    return {"pairs": torch.from_numpy(scans), "steps": torch.from_numpy(steps)}, motions


def drive_of(scans, steps=None):
    steps = np.zeros((len(scans) - 1, 3)) if steps is None else steps
    return Drive("a", "k", scans, compose(steps), np.arange(float(len(scans))), FORWARD_CAMERA)


# --- finding them --------------------------------------------------------------------------------


def test_all_models_are_found_by_their_names():
    assert all(find_model(name).name == name for name in (*NAMES, "matcher"))
    assert {name for name, model in all_models().items() if model.trains} == {*NAMES, "cnn_warp", "rcnn_warp"}
    with pytest.raises(InputError, match="no model is called resnet; there are cnn_cls, cnn_reg"):
        find_model("resnet")


class WithoutLoss(TrainedModel):
    name, Options = "toy", object

    def forward(self, pairs, state=()):
        return pairs, pairs, state


class Lonely:
    name = Options = estimate = stepper = "lonely"


class OfWholeScans(Model):
    """It lacks a stepper, and has a tracker of its own."""

    name, uses_depth_vectors = "toy", False

    @dataclass
    class Options:
        pass

    def estimate(self, drive):
        return estimate_by_tracking(self.tracker(), drive.raw_scans())

    def tracker(self):
        return "a tracker"


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (WithoutLoss, "model toy: lacks loss; "),
        (type("Bare", (Model,), {}), "model toy: lacks name, Options, estimate, stepper or tracker; "),
        (Lonely, "model toy: is not a subclass of Model; "),
        (find_model("cnn_reg"), "model toy: its class is named cnn_reg; "),
    ],
)
def test_a_class_that_lacks_a_part_is_refused_in_one_line(model, message):
    with pytest.raises(InputError, match=message) as refused:
        check_model("toy", model)
    assert "\n" not in str(refused.value)


def test_a_model_of_whole_scans_needs_no_stepper():
    check_model("toy", OfWholeScans)
    toy = OfWholeScans({}, SENSOR)
    assert toy.tracker() == "a tracker"
    with pytest.raises(NotImplementedError, match="toy uses whole scans"):
        toy.stepper()


@pytest.mark.parametrize("variant", NAMES)
def test_a_network_comes_through_a_stream_of_whole_scans(variant):
    model, scans = build(variant), random_scans(8)
    assert model.uses_depth_vectors
    whole = model.estimate(drive_of(scans))
    rows = [Scan(scan.astype(float), ANGLES, stamp=0.1 * n) for n, scan in enumerate(scans)]
    streamed = estimate_by_tracking(model.tracker(), rows)
    np.testing.assert_allclose(streamed.values, whole.values, atol=1e-5)
    np.testing.assert_allclose(streamed.covariances, whole.covariances, rtol=1e-4, atol=1e-6)


def test_the_contract_is_known_without_pytorch():
    names = "contract, pairs, streaming, tracking"
    heavy = "{'torch', 'numba', 'scipy'} & sys.modules.keys()"
    code = f"import sys; from rcnn_odom.models import {names}; assert not {heavy}, {heavy}"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


# --- options -------------------------------------------------------------------------------------


@pytest.mark.parametrize("choice", sorted(path.stem for path in (ROOT / "conf" / "model").glob("*.yaml")))
def test_options_of_every_choice_are_accepted(choice):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        cfg = hydra.compose("config", [f"model={choice}", "outputs=a", "run_dir=b"])
    values = OmegaConf.to_container(cfg.model, resolve=True)
    check_options(find_model(values.pop("variant")).Options, values, "model.")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kernel_size": 4}, "model.kernel_size=4: must be odd"),
        ({"pooling": "sum"}, "model.pooling=sum: choose one of avg, max"),
        ({"apply": "never"}, "model.apply=never: choose one of start, middle, end"),
        ({"dropout": 1.0}, "model.dropout=1.0: must be a number from 0 and below 1"),
        ({"epochs": 0}, "model.epochs=0: must be a whole number above 0"),
        ({"freeze": 1}, "model.freeze=1: must be true or false"),
        ({"projection": 0}, "model.projection=0: must be null or a whole number above 0"),
        ({"rotation_classes": {"count": 0, "width_deg": 1.0}}, "model.rotation_classes.count=0: must be"),
        ({"first_stage": 3}, "model.first_stage=3: is a group; set its members"),
        ({"first_stage": {**options("cnn_cls"), "variant": "cnn_reg"}}, "model.first_stage.variant=cnn_reg"),
        ({"hidden": 3}, "model.hidden: there is no such option"),
    ],
)
def test_options_without_meaning_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        check_options(find_model("rcnn_reg").Options, options(**changes), "model.")


# --- training ------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", NAMES)
def test_loss_is_that_of_the_paper(variant):
    model = build(variant)
    batch, truth = batch_of()
    outputs = model.loss(batch)
    with torch.no_grad():
        estimate, _ = model.motions(batch["pairs"])
    error = estimate.motion.numpy().astype(np.float64) - truth
    distance, rotation = np.sqrt((error**2).mean((0, 1)))
    classifies = variant.endswith("cls")
    if classifies:
        scores = estimate.scores.numpy().astype(np.float64)
        share = np.exp(scores) / np.exp(scores).sum(-1, keepdims=True)
        number = np.clip(np.floor(np.degrees(truth[..., 1]) / 0.1) + 56, 0, 111).astype(int)
        rotation = -np.log(np.take_along_axis(share, number[..., None], -1)).mean()
        outside = (np.abs(np.degrees(truth[..., 1])) > 5.6).mean()
        assert outputs["headings_outside_classes"].item() == pytest.approx(outside)
    assert outputs["loss_distance"].item() == pytest.approx(distance, rel=1e-5)
    assert outputs["loss_rotation"].item() == pytest.approx(rotation, rel=1e-5)
    expected = distance + (1 if classifies else 100) * rotation
    assert outputs["loss"].item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("variant", NAMES)
def test_loss_tells_which_window_diverged(variant):
    batch, _ = batch_of()
    batch["pairs"][1, 2, 0, 5] = torch.nan
    assert build(variant).loss(batch)["diverged"].tolist() == [False, True, False]


@pytest.mark.parametrize("variant", NAMES)
@pytest.mark.parametrize("angle", ["expectation", "argmax"])
@pytest.mark.parametrize("freeze", [False, True])
def test_every_weight_that_is_trained_gets_a_gradient(variant, angle, freeze):
    changes = {"freeze": freeze} if variant.startswith("rcnn") else {}
    model = build(variant, angle=angle, **changes).train()
    model.loss(batch_of()[0])["loss"].backward()
    trained = {name for name, weight in model.named_parameters() if weight.requires_grad}
    assert {name for name, weight in model.named_parameters() if weight.grad is not None} == trained
    fixed = {name for name, _ in model.named_parameters()} - trained
    first_stage = {name for name, _ in model.named_parameters() if name.startswith("cnn.")}
    rotation = {name for name in first_stage if name.startswith("cnn.head.rotation")}
    assert fixed == (first_stage if changes.get("freeze") else rotation if angle == "argmax" else set())


@pytest.mark.parametrize("variant", NAMES)
def test_units_are_those_of_the_training_steps(variant):
    rng = np.random.default_rng(0)
    steps = relative_steps(compose(rng.normal([0.5, 0.02, 0.01], [0.2, 0.05, 0.03], (200, 3))))
    model = build(variant)
    model.set_units([steps[:150], steps[150:]])
    x, y, heading = steps.T
    motions = np.stack([x * np.cos(heading / 2) + y * np.sin(heading / 2), heading], 1)
    for head in [model.head] + ([model.cnn.head] if variant.startswith("rcnn") else []):
        np.testing.assert_allclose(head.mean, motions.mean(0), rtol=1e-5)
        np.testing.assert_allclose(head.deviation, motions.std(0), rtol=1e-5)
    np.testing.assert_allclose(model.describe().typical_step, np.sqrt((steps**2).mean(0)), rtol=1e-5)


# --- estimating ----------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", NAMES)
@pytest.mark.parametrize("frames", [2, 64, 65, 66, 155])
def test_estimate_equals_a_single_pass(variant, frames):
    model, scans = build(variant), random_scans(frames)
    found = model.estimate(drive_of(scans))
    assert (found.values.shape, found.values.dtype) == ((frames - 1, 3), np.float64)
    scans = torch.from_numpy(scans)
    with torch.no_grad():
        steps, covariances, _ = model(torch.stack([scans[:-1], scans[1:]], 1)[None])
    np.testing.assert_allclose(found.values, steps[0], atol=1e-5)
    np.testing.assert_allclose(found.covariances, covariances[0], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("variant", ["rcnn_reg", "rcnn_cls"])
def test_lstm_remembers_across_the_chunk_border(variant):
    model, scans = build(variant), random_scans(155)
    whole = model.estimate(drive_of(scans)).values
    # The second chunk begins with frame 64: alone it would know nothing of those before.
    alone = model.estimate(drive_of(scans[64:])).values
    assert np.abs(alone[0] - whole[64]).max() > 1e-4
    changed = scans.copy()
    changed[60] = 0
    assert np.abs(model.estimate(drive_of(changed)).values[64:66] - whole[64:66]).max() > 1e-6


@pytest.mark.parametrize("variant", NAMES)
def test_estimate_has_no_memory_between_drives(variant):
    model, drive = build(variant), drive_of(random_scans(20))
    first = model.estimate(drive).values
    model.estimate(drive_of(random_scans(30, seed=1)))
    np.testing.assert_array_equal(model.estimate(drive).values, first)


@pytest.mark.parametrize("variant", NAMES)
def test_training_mode_and_autocast_do_not_change_estimates(variant):
    model, drive = build(variant), drive_of(random_scans(70))
    expected = model.estimate(drive).values
    np.testing.assert_array_equal(model.train().estimate(drive).values, expected)
    with torch.autocast("cpu", torch.bfloat16):
        np.testing.assert_array_equal(model.estimate(drive).values, expected)


@pytest.mark.parametrize("variant", NAMES)
def test_a_stream_gives_the_same_steps(variant):
    model, scans = build(variant), random_scans(12)
    whole, stepper = model.estimate(drive_of(scans)), model.stepper()
    assert stepper.description == model.describe()
    assert stepper.description.sensor == SENSOR
    for _ in range(2):
        for frame in range(11):
            step = stepper(scans[frame : frame + 2])
            np.testing.assert_allclose(step.array(), whole.values[frame], atol=1e-5)
            np.testing.assert_allclose(step.covariance, whole.covariances[frame], rtol=1e-4, atol=1e-6)
        stepper.reset()
