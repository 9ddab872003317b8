"""Training that begins with the weights of another: of the same model, or of its first stage."""

import shutil

import numpy as np
import pytest
import torch

from conftest import configure_in
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import BEST, CONFIG, find_weights
from rcnn_odom.training import stages
from rcnn_odom.training.checkpoint import load_module, weights_fingerprint
from rcnn_odom.training.overrides import read_paths
from rcnn_odom.training.run_state import link_latest, settings_fingerprint, write_config, write_json
from rcnn_odom.training.settings import plain
from train import train

NOT_AT_ALL = ["model.learning_rate=1.0e-30", "model.epochs=1"]
"""No weight of a size that counts changes in single precision."""
ON_OTHER_DRIVES = ["data.train=['05[0:0.8]']", "data.val=['10']", "data.test=['00']"]


@pytest.fixture(scope="module")
def given(kitti, tmp_path_factory):
    """A function: the folder of a finished run of a variant, only to be read."""
    runs = {}

    def given(variant):
        if variant not in runs:
            folder = tmp_path_factory.mktemp(variant)
            train(configure_in(folder)(f"model={variant}", *kitti))
            runs[variant] = folder / "outputs" / "run"
        return runs[variant]

    return given


def estimates(module, drive):
    return module.model.estimate(drive).values


@pytest.mark.parametrize("variant", ["cnn_reg", "rcnn_cls"])
def test_after_no_training_it_estimates_what_the_given_network_does(
    given, configure, kitti, tmp_path, caplog, variant
):
    caplog.set_level("INFO")
    run = given(variant)
    options = [f"model={variant}", *kitti, *ON_OTHER_DRIVES, *NOT_AT_ALL, f"model.pretrained={run}"]
    cfg = configure(*options, "model.beta=7.0", "trainer.precision=32-true")
    metrics = train(cfg)
    before, after = load_module(run / BEST), load_module(tmp_path / "outputs" / "run" / BEST)
    drive = stages.build_datamodule(plain(cfg)).load(("test",)).drives["test"][0]
    expected = estimates(before, drive)
    np.testing.assert_allclose(estimates(after, drive), expected, atol=1e-7)
    assert np.abs(expected).max() > 0.1
    # The scales of its outputs have stayed with its weights; what is told of the drives is of the new ones.
    for name in ("model.head.mean", "model.head.deviation"):
        assert torch.equal(after.state_dict()[name], before.state_dict()[name])
    for name in ("mean_step", "model.typical_step"):
        assert not torch.equal(after.state_dict()[name], before.state_dict()[name])
    assert metrics["pretrained"] == {
        "path": str(run / BEST),
        "val_drift": pytest.approx(metrics["val"]["drift"]),
    }
    assert f"starting from the weights of {run / BEST}; validation drift before training:" in caplog.text
    assert "fine-tuning on 48 scans and" in caplog.text
    assert "(recommended: 2000 scans and 200 m or more)" in caplog.text
    assert "fine-tuning has not helped" in caplog.text
    assert not (tmp_path / "outputs" / "run" / "first_stage").exists()


def test_outputs_latest_goes_on_bit_for_bit(given, configure, kitti, tmp_path, monkeypatch):
    outputs, run = tmp_path / "outputs", tmp_path / "outputs" / "given"
    shutil.copytree(given("cnn_reg"), run)
    link_latest(outputs, run)
    options = ["model=cnn_reg", *kitti, *ON_OTHER_DRIVES, "model.batch_size=4"]
    whole = train(configure(*options, f"model.pretrained={run / BEST}", run="whole"))
    assert whole["pretrained"]["path"].endswith(f"given/{BEST}")
    link_latest(outputs, run)

    def stop(self, trainer, module):
        if trainer.current_epoch == 1:
            raise KeyboardInterrupt

    latest = f"model.pretrained={outputs / 'latest'}"
    with monkeypatch.context() as patch:
        patch.setattr(stages.TrainingLog, "on_train_epoch_start", stop, raising=False)
        with pytest.raises(KeyboardInterrupt):
            train(configure(*options, latest))
    assert (outputs / "latest" / CONFIG).resolve() == (outputs / "run" / CONFIG).resolve()
    again = train(configure(*options, latest))
    assert again["test"] == whole["test"]
    assert again["fingerprint"] == whole["fingerprint"]
    prints = [weights_fingerprint(outputs / name / BEST) for name in ("given", "whole", "run")]
    assert prints[1] == prints[2] != prints[0]


def test_the_fingerprint_is_of_the_weights_wherever_they_are(given, configure, kitti, tmp_path):
    moved, other = tmp_path / "moved.ckpt", tmp_path / "other.ckpt"
    shutil.copy(given("cnn_cls") / BEST, moved)
    saved = torch.load(moved, weights_only=True)
    saved["state_dict"]["model.head.rotation.bias"][0] += 1e-3
    torch.save(saved, other)
    files = [given("cnn_cls") / BEST, moved, other, None]
    datamodule = stages.build_datamodule(plain(configure("model=cnn_cls", *kitti))).load(("train", "val"))
    for model, option in (
        ("cnn_cls", "model.pretrained"),
        ("rcnn_reg", "model.pretrained"),
        ("rcnn_reg", "model.first_stage.pretrained"),
    ):
        prints = []
        for file in files:
            settings = plain(configure(f"model={model}", *kitti, f"{option}={file or 'null'}"))
            prints.append(settings_fingerprint(settings, datamodule))
        assert prints[0] == prints[1]
        assert len(set(prints)) == 3


@pytest.mark.parametrize(
    ("variant", "model", "options", "message"),
    [
        ("cnn_reg", "cnn_cls", [], "a checkpoint of cnn_reg, but cnn_cls is needed; give one"),
        ("cnn_reg", "rcnn_reg", [], "cnn_reg, but rcnn_reg is needed, or of cnn_cls, its first stage"),
        (
            "cnn_reg",
            "cnn_reg",
            ["model.kernel_size=5"],
            r"model\.kernel_size is 5 here; set model\.kernel_size=3",
        ),
        (
            "cnn_cls",
            "cnn_cls",
            ["model.rotation_classes.count=20", "model.pooling=max"],
            r"pooling is max, model\.rotation_classes\.count is 20 here; set model\.pooling=avg "
            r"model\.rotation_classes\.count=112 as in that",
        ),
        (
            "cnn_reg",
            "cnn_reg",
            ["data.sensor.resolution_deg=0.5", "data.sensor.field_of_view_deg=180"],
            r"with data\.sensor\.resolution_deg=1\.0 data\.sensor\.field_of_view_deg=360\.0, but the data "
            r"has resolution_deg=0\.5 and field_of_view_deg=180; set data\.sensor as in training",
        ),
    ],
)
def test_what_does_not_fit_is_refused_before_recordings_are_read(
    given, configure, kitti, tmp_path, variant, model, options, message
):
    cfg = configure(f"model={model}", *kitti, f"model.pretrained={given(variant)}", *options)
    with pytest.raises(InputError, match=message) as told:
        train(cfg)
    assert "\n" not in str(told.value)
    assert not (tmp_path / "outputs" / "cache").exists()


def test_no_such_file_and_weights_of_other_shapes_are_refused(given, configure, kitti, tmp_path):
    with pytest.raises(InputError, match=r"gone\.ckpt: no such checkpoint"):
        train(configure("model=cnn_reg", *kitti, f"model.pretrained={tmp_path}/gone.ckpt"))
    with pytest.raises(InputError, match="No such file or directory; name a run's folder"):
        plain(configure("model=cnn_reg", *kitti, f"model.pretrained={tmp_path}"))


# --- folders -------------------------------------------------------------------------------------


def write_run(run, pretrained=None, finished=True):
    write_config(run, {"data": {}, "model": {"pretrained": pretrained}, "trainer": {}})
    if finished:
        write_json(run / "metrics.json", {})


def test_a_run_stands_for_its_best_weights(tmp_path):
    outputs = tmp_path / "outputs"
    first, second = outputs / "first", outputs / "second"
    write_run(first)
    link_latest(outputs, first)
    assert find_weights(first) == first / BEST
    assert find_weights(outputs / "latest").resolve() == first / BEST
    assert find_weights(first / BEST) == first / BEST
    assert find_weights(tmp_path / "none.ckpt") == tmp_path / "none.ckpt"
    write_run(second, pretrained=str(first / BEST), finished=False)
    link_latest(outputs, second)
    assert find_weights(outputs / "latest") == first / BEST, "what the unfinished one began with"
    with pytest.raises(InputError, match="this run has not finished; let it finish"):
        find_weights(second)
    write_run(second, pretrained=str(first / BEST))
    assert find_weights(outputs / "latest").resolve() == second / BEST


def test_the_command_line_knows_latest_before_a_sweep_begins(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path / "outputs" / "run")
    link_latest(tmp_path / "outputs", tmp_path / "outputs" / "run")
    (found,) = read_paths(["model.pretrained=outputs/latest"])
    assert found == f'model.pretrained="outputs/run/{BEST}"'
    assert read_paths(["model.pretrained=a.ckpt"]) == ["model.pretrained=a.ckpt"]
