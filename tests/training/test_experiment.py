"""Whole experiments on tiny recordings in the real layouts."""

import json
import multiprocessing
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
import yaml
from hydra import compose, initialize_config_dir

from conftest import LENGTHS, ROOT, configure_in
from data.make_carmen import make_carmen
from evaluate import evaluate
from rcnn_odom import cli
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.drift import travelled
from rcnn_odom.evaluation.run_folder import BEST, LAST
from rcnn_odom.training import stages
from rcnn_odom.training.fresh_worlds import FreshWorlds
from rcnn_odom.training.modules import OdometryModule
from rcnn_odom.training.run_state import settings_fingerprint
from rcnn_odom.training.settings import plain
from train import train

VARIANTS = ["cnn_reg", "cnn_cls", "rcnn_reg", "rcnn_cls"]


@pytest.fixture(scope="module")
def trained(kitti, tmp_path_factory):
    """A function: the folder and the metrics of a variant's run, trained once and only to be read."""
    runs = {}

    def trained(variant):
        if variant not in runs:
            folder = tmp_path_factory.mktemp(variant)
            metrics = train(configure_in(folder)(f"model={variant}", *kitti))
            runs[variant] = folder / "outputs" / "run", metrics
        return runs[variant]

    return trained


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_run_leaves_everything_behind(trained, kitti, variant):
    run, metrics = trained(variant)
    assert (run.parent / "latest" / "config.yaml").resolve().parent == run
    assert json.loads((run / "metrics.json").read_text()) == metrics
    assert yaml.safe_load((run / "config.yaml").read_text())["model"]["variant"] == variant
    assert (run / BEST).exists()
    assert not (run / LAST).exists()
    for kind in ("trajectory", "motion"):
        assert (run / "figures" / f"05_{kind}.png").stat().st_size > 10_000
    assert len(list((run / "tensorboard").glob("events*"))) == 1
    assert len(np.loadtxt(run / "trajectories" / "05.txt")) == 60
    root = kitti[0].split("=")[1]
    truth = np.loadtxt(run / "trajectories" / "05_truth.txt")
    np.testing.assert_allclose(truth, np.loadtxt(f"{root}/poses/05.txt"), atol=1e-9)
    assert np.loadtxt(run / "trajectories" / "05.tum").shape == (60, 8)
    assert set(metrics["baselines"]) == {"mean_motion", "held_motion"}
    assert metrics["test"]["sequences"]["05"]["drift"]["segments"] > 0
    assert 0 <= metrics["test"]["floor"] < metrics["baselines"]["held_motion"]["drift"]


def test_the_command_line_prints_the_drift_of_metrics_json(trained, kitti, capsys):
    run, metrics = trained("cnn_reg")
    root = kitti[0].split("=")[1]
    trajectory = run / "trajectories" / "05.txt"
    capsys.readouterr()
    arguments = [f"{root}/poses/05.txt", str(trajectory), "--planar", "--lengths", "10,20", "--json"]
    assert cli.main(["drift", *arguments]) == 0
    printed = json.loads(capsys.readouterr().out)
    expected = metrics["test"]["sequences"]["05"]["drift"]
    assert printed["segments"] == expected["segments"]
    # Rotation is rounded to single precision inside, and the poses go through text.
    assert printed["t_err"] == pytest.approx(expected["t_err"], rel=1e-6)
    assert printed["r_err_deg_per_m"] == pytest.approx(expected["r_err_deg_per_m"], rel=1e-3)


def test_the_first_stage_is_trained_once_and_then_found(configure, kitti, tmp_path, caplog):
    caplog.set_level("INFO")
    train(configure("model=rcnn_reg", *kitti))
    stage = tmp_path / "outputs" / "run" / "first_stage" / BEST
    assert f"first stage: {stage}" in caplog.text
    assert caplog.text.count("training one") == 1
    train(configure("model=rcnn_cls", *kitti, run="second"))
    assert caplog.text.count("training one") == 1
    assert caplog.text.count(f"first stage: {stage}") == 2
    train(configure("model=rcnn_reg", *kitti, "seed=1", run="third"))
    assert caplog.text.count("training one") == 2


def test_a_cnn_cls_run_serves_as_first_stage(configure, kitti, tmp_path, caplog):
    caplog.set_level("INFO")
    train(configure("model=cnn_cls", *kitti, "model.epochs=1", run="cnn"))
    train(configure("model=rcnn_reg", *kitti))
    assert f"first stage: {tmp_path / 'outputs' / 'cnn' / BEST}" in caplog.text


def test_freezing_keeps_the_first_stage_and_fine_tuning_changes_it(trained, configure, kitti, tmp_path):
    stage = trained("cnn_cls")[0] / BEST
    weights = torch.load(stage, weights_only=True)["state_dict"]
    for freeze in (True, False):
        run = f"freeze_{freeze}"
        train(
            configure(
                "model=rcnn_reg", *kitti, f"model.pretrained={stage}", f"model.freeze={freeze}", run=run
            )
        )
        after = torch.load(tmp_path / "outputs" / run / BEST, weights_only=True)["state_dict"]
        same = [
            torch.equal(after[key.replace("model.", "model.cnn.")], weights[key])
            for key in weights
            if "encoder" in key or "head" in key
        ]
        assert all(same) == freeze


def test_evaluating_again_gives_the_same_numbers(trained, configure, tmp_path):
    run, metrics = trained("rcnn_reg")
    again = evaluate(configure(f"run={run}", name="evaluate", run="evaluation"))
    assert again["test"] == metrics["test"]
    assert again["baselines"] == metrics["baselines"]
    assert (tmp_path / "outputs" / "evaluation" / "metrics.json").exists()
    assert (tmp_path / "outputs" / "evaluation" / "config.yaml").exists()


def test_evaluating_on_other_data(trained, configure):
    options = ["data=simulated", "data.frames=50", "data.test=[07]", "data.sensor.resolution_deg=1.0"]
    run, _ = trained("cnn_reg")
    scores = evaluate(configure(f"run={run}", *options, name="evaluate", run="evaluation"))
    assert scores["data"] == "simulated"
    # 50 frames are shorter than 100 m: said, not scored.
    assert scores["test"]["drift"] is None
    assert scores["test"]["sequences"]["07"]["drift"]["segments"] == 0
    assert scores["test"]["sequences"]["07"]["distance_mae_m"] > 0


def test_carmen_logs_of_two_beam_counts_train_together(configure, tmp_path):
    make_carmen(tmp_path / "logs", "narrow", beams=180, frames=80)
    make_carmen(tmp_path / "logs", "wide", beams=361, frames=80, compress="bz2", seed=1)
    options = [
        "data=carmen",
        f"data.root={tmp_path}/logs",
        "data.train=['narrow[:0.8]',wide]",
        "data.val=['narrow[0.8:]']",
        "data.test=[wide]",
    ]
    metrics = train(configure("model=rcnn_reg", *options))
    assert set(metrics["baselines"]) == {"mean_motion", "held_motion", "wheel_odometry"}
    assert metrics["test"]["sequences"]["wide"]["moving"]["frames"] > 0


def test_a_stopped_run_goes_on_to_the_same_result(trained, configure, kitti, tmp_path, monkeypatch, caplog):
    _, whole = trained("cnn_reg")

    def stop(self, trainer, module):
        if trainer.current_epoch == 1:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(stages.TrainingLog, "on_train_epoch_start", stop, raising=False)
        with pytest.raises(KeyboardInterrupt):
            train(configure("model=cnn_reg", *kitti))
    assert f"the same command continues the run in {tmp_path}/outputs/run" in caplog.text
    assert (tmp_path / "outputs" / "run" / LAST).exists()
    assert train(configure("model=cnn_reg", *kitti))["test"] == whole["test"]


def test_a_run_folder_is_not_used_twice_or_for_something_else(trained, configure, kitti, tmp_path):
    shutil.copytree(trained("cnn_reg")[0], tmp_path / "outputs" / "run")
    with pytest.raises(InputError, match="finished run"):
        train(configure("model=cnn_reg", *kitti))
    (tmp_path / "outputs" / "run" / "metrics.json").unlink()
    with pytest.raises(InputError, match="other settings"):
        train(configure("model=cnn_reg", *kitti, "model.beta=3"))


def test_a_checkpoint_of_another_variant_sensor_or_network_is_refused(trained, configure, kitti, tmp_path):
    runs = {variant: trained(variant)[0] for variant in ("cnn_reg", "cnn_cls")} | {"missing": tmp_path}
    recurrent = ["model=rcnn_reg", *kitti]
    for number, (run, option, message) in enumerate(
        [
            ("cnn_reg", "seed=0", "cnn_reg, but rcnn_reg is needed, or of cnn_cls, its first stage"),
            ("cnn_cls", "data.sensor.max_range=50.0", "max_range=80.0.*data has"),
            ("cnn_cls", "model.kernel_size=5", "kernel_size=3, but model.kernel_size is 5"),
            ("missing", "seed=0", "no such checkpoint"),
        ]
    ):
        with pytest.raises(InputError, match=message):
            train(configure(*recurrent, f"model.pretrained={runs[run] / BEST}", option, run=f"bad{number}"))
    other = ["data=simulated", "data.frames=20"]
    with pytest.raises(InputError, match=r"resolution_deg=1\.0.*data has"):
        evaluate(configure(f"run={runs['cnn_reg']}", *other, name="evaluate", run="evaluation"))


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("trainer.accelerator=gpu", "accelerator=cpu"),
        ("trainer.precision=16-mixed", "choose one of auto, bf16-mixed, 32-true"),
        ("trainer.precision=32", "choose one of auto, bf16-mixed, 32-true"),
        ("trainer.gradient_clip_val=0", "must be null for no clipping"),
        ("trainer.accelerator=abacus", "accelerator=cpu"),
        ("data.lengths=100", "must be a list of lengths"),
        ("data.ring=abc", "must be null or a whole number"),
        ("data.ring=9", "data.ring must be 0 to 3"),
        ("trainer.devices=2", "trainer=ddp trainer.devices"),
        ("data.train=00", "must be a list of sequences"),
        ("data.val=['10','10']", "each once"),
        ("data.sensor.max_range=far", "must be a number above 0"),
        ("data.augment.mirror=maybe", "must be true or false"),
        ("data.augment.max_turn_deg=abc", "must be 0 or a positive number"),
        ("data.augment.move=[1,2]", "must be null or three deviations"),
        ("data.augment.move=[1,-2,0]", "must be null or three deviations"),
        ("data.augment.move=[1000,0,0]", "two scans would have nothing in common; at most 20 m"),
        ("data.augment.max_range_scale=0.5", "must be a number from 1"),
        ("data.augment.lost_beams=1", "below|less than 1"),
        ("data.augment.beam_pattern=[0.3,0.05]", "the least and the largest spacing in degrees"),
        ("data.augment.beam_pattern=[0.05,0.3]", "from 0.5 degrees, half a bin"),
        ("model.stride=0", "must be null or a whole number above 0"),
        ("data.workers=-1", "must be null or a whole number"),
        ("data.ring=-1", "not negative"),
        ("data.sensor.resolution_deg=60.0", "too few for the network"),
        ("seed=-1", "not negative"),
        ("model.epochs=true", "whole number above 0"),
        ("model.window=60", "training sequence 00 has 60 frames, a window needs 61"),
        ("data.train=[]", "must be a list of sequences"),
        ("data.val=['10[0.9:0.1]']", "two fractions"),
        ("data.val=['10[0.99:]']", "two are needed"),
        ("model.pooling=median", "choose one of avg, max"),
        ("model.apply=start", "set data.apply"),
        ("model.kernel_size=4", "must be odd"),
        ("model.beta=much", "must be a number above 0"),
        ("model.epochs=0", "whole number above 0"),
        ("data.apply=never", "choose one of start, middle, end"),
        ("data.sensor.resolution_deg=0.7", "no whole number of bins"),
    ],
)
def test_bad_options_are_named(configure, kitti, option, message):
    if option == "trainer.accelerator=gpu" and torch.cuda.is_available():
        pytest.skip("this machine has the GPU that the test wants absent")
    with pytest.raises(InputError, match=message):
        train(configure("model=cnn_reg", *kitti, option))


def test_numbers_serve_as_names_of_sequences(configure, kitti):
    assert plain(configure("model=cnn_reg", *kitti, "data.val=[10]"))["data"]["val"] == ["10"]


def test_bad_input_leaves_latest_where_it_was(configure, kitti, tmp_path):
    train(configure("model=cnn_reg", *kitti, run="good"))
    with pytest.raises(InputError):
        train(configure("model=cnn_reg", *kitti, "data.root=nowhere", run="bad"))
    latest = tmp_path / "outputs" / "latest" / "config.yaml"
    assert latest.resolve().parent == tmp_path / "outputs" / "good"


def test_parts_of_one_drive_have_files_of_their_own(configure, kitti, tmp_path):
    train(configure("model=cnn_reg", *kitti, "data.test=['05[:0.5]','05[0.5:]']"))
    assert len(list((tmp_path / "outputs" / "run" / "trajectories").glob("05*.tum"))) == 2


def test_moving_a_drive_from_training_to_validation_asks_for_another_first_stage(configure, kitti, tmp_path):
    prints = set()
    for split in (
        ["data.train=['00','10']", "data.val=['05']"],
        ["data.train=['00']", "data.val=['10','05']"],
    ):
        settings = plain(configure("model=cnn_cls", *kitti, *split))
        prints.add(settings_fingerprint(settings, stages.build_datamodule(settings).load(("train", "val"))))
    assert len(prints) == 2


@pytest.mark.parametrize("augmented", ["false", "true"])
@pytest.mark.slow
def test_training_in_bf16_learns_a_drive_by_heart(configure, kitti, augmented):
    options = ["data.val=['00']", "data.test=['00']", "model.epochs=40", "trainer.precision=bf16-mixed"]
    options += [f"data.augment.mirror={augmented}", f"data.augment.max_turn_deg={int(augmented == 'true')}"]
    metrics = train(configure("model=cnn_reg", *kitti, *options))
    assert metrics["test"]["drift"] < metrics["baselines"]["mean_motion"]["drift"] / 2


def test_a_model_that_does_not_train_is_refused(configure, kitti):
    settings = plain(configure("model=cnn_reg", *kitti)) | {"model": {"variant": "matcher"}}
    says = r"^model=matcher has nothing to train; score it: .*model=matcher data="
    with pytest.raises(InputError, match=says):
        stages.train(settings)


def test_training_that_diverges_says_so(configure, kitti):
    with pytest.raises(InputError, match=r"diverged in epoch \d.*learning_rate lower"):
        train(
            configure("model=cnn_reg", *kitti, "model.learning_rate=1e30", "trainer.gradient_clip_val=null")
        )


# --- the simulation ------------------------------------------------------------------------------

STUB = [
    "data=simulated",
    "data.reader.format=stub_drives",
    "data.train=['00','02']",
    "data.val=['10']",
    "data.test=['05']",
    "data.sensor.max_range=40.0",
    LENGTHS,
]
FRESH = [*STUB, "data.fresh_worlds=true", "model.epochs=3"]


def scans_trained_on(monkeypatch):
    """Fills with one number for each training batch, by which its scans are told from others."""
    seen = []
    step = OdometryModule.training_step

    def training_step(self, batch, index):
        seen.append(float(batch["pairs"].double().sum()))
        return step(self, batch, index)

    monkeypatch.setattr(OdometryModule, "training_step", training_step)
    return seen


def test_stopped_run_on_fresh_worlds_goes_on_with_the_same_worlds(configure, tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO")
    seen = scans_trained_on(monkeypatch)
    whole = train(configure("model=cnn_reg", *FRESH, "data.workers=2", run="whole"))
    expected = seen.copy()
    assert len(set(expected)) == len(expected)
    seen.clear()

    def stop(self, trainer, module):
        if trainer.current_epoch == 2:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(stages.TrainingLog, "on_train_epoch_start", stop, raising=False)
        with pytest.raises(KeyboardInterrupt):
            train(configure("model=cnn_reg", *FRESH))
    assert multiprocessing.active_children() == []
    assert train(configure("model=cnn_reg", *FRESH))["test"] == whole["test"]
    assert seen == expected
    assert multiprocessing.active_children() == []
    assert "new worlds for every epoch" in caplog.text
    assert len(list((tmp_path / "outputs" / "cache").glob("*.npy"))) == 4, "the new worlds leave no file"


@pytest.fixture
def worlds_seen(monkeypatch):
    """Fills with the names of the drives of each epoch."""
    seen = []
    drives_of = FreshWorlds.drives_of

    def remember(self, epoch):
        drives = drives_of(self, epoch)
        seen.append({drive.name for drive in drives})
        return drives

    monkeypatch.setattr(FreshWorlds, "drives_of", remember)
    return seen


@pytest.mark.slow
def test_no_stage_sees_the_new_worlds_of_the_other(configure, worlds_seen):
    train(configure("model=rcnn_reg", *FRESH, "model.epochs=2", "model.first_stage.epochs=3"))
    assert len(worlds_seen) == 5
    new = [names for names in worlds_seen if all("~" in name for name in names)]
    assert len(new) == 3, "each stage begins with the training set itself"
    assert len(set.union(*new)) == sum(map(len, new))


def test_a_given_first_stage_keeps_its_new_worlds_for_itself(configure, tmp_path, worlds_seen):
    train(configure("model=cnn_cls", *FRESH, "model.epochs=4", run="cnn"))
    given = f"model.pretrained={tmp_path / 'outputs' / 'cnn' / BEST}"
    train(configure("model=rcnn_reg", *FRESH, "model.epochs=2", "model.first_stage.epochs=1", given))
    assert [sorted(names) for names in worlds_seen] == [
        ["00", "02"],
        *([f"00~{epoch}", f"02~{epoch}"] for epoch in (1, 2, 3)),
        ["00", "02"],
        ["00~5", "02~5"],
    ]


@pytest.mark.parametrize(
    "option",
    ["fresh_worlds", "vary_pace", "realism.movers", "realism.missing", "realism.tilt"],
)
def test_a_training_on_other_new_worlds_is_another_one(configure, option):
    prints = set()
    for flag in ("true", "false"):
        settings = plain(configure("model=cnn_cls", *FRESH, f"data.{option}={flag}"))
        prints.add(settings_fingerprint(settings, stages.build_datamodule(settings).load(("train", "val"))))
    assert len(prints) == 2


def test_log_tells_how_long_training_waited(configure, caplog):
    caplog.set_level("INFO")
    train(
        configure("model=cnn_reg", *FRESH, "+data.reader.seconds=0.01", "data.train=['02']", "model.epochs=2")
    )
    epochs = [line for line in caplog.messages if line.startswith("epoch")]
    assert [bool(re.search(r"waited \d s for new worlds$", line)) for line in epochs] == [False, True]


def test_worlds_that_cannot_be_made_end_the_run_in_one_line(configure):
    with pytest.raises(InputError) as failure:
        train(configure("model=cnn_reg", *FRESH, "+data.reader.broken='00~1'"))
    assert str(failure.value) == "00~1: frame 20 is damaged; copy it again"
    assert multiprocessing.active_children() == []


def test_simulated_drives_train_on_fresh_worlds(configure):
    options = ["data=simulated", "data.frames=40", "data.train=['00']", "data.test=['05']", LENGTHS]
    metrics = train(configure("model=cnn_reg", *options, "data.fresh_worlds=true"))
    assert metrics["test"]["sequences"]["05"]["frames"] == 40


@pytest.mark.parametrize("scale", ["small", "full"])
def test_shipped_simulation_has_long_drives_to_score(configure, scale):
    module = stages.build_datamodule(plain(configure("data=simulated", f"data.scale={scale}")))
    for name in (*module.names["val"], *module.names["test"]):
        assert travelled(module.open_recording(name).poses)[-1] > 400


@pytest.mark.parametrize(
    ("options", "epochs"),
    [
        (["data=simulated"], [50, 20]),
        (["data=simulated", "data.scale=full"], [10, 5]),
        (["data=kitti", "data.root=x"], [10, 5]),
        (["data=indoor", "data.scale=full"], [10, 5]),
        (["data=carmen", "data.root=x", "data.name=mine"], [10, 5]),
    ],
)
def test_small_training_set_has_more_epochs(options, epochs):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        for variant, expected in (("cnn_reg", epochs[0]), ("rcnn_reg", epochs[1])):
            model = plain(compose("config", ["run_dir=x", f"model={variant}", *options]))["model"]
            assert model["epochs"] == expected
        assert model["first_stage"]["epochs"] == epochs[0]


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("data.scale=medium", "data.scale=medium: choose one of small, full"),
        ("data.world=moon", "data.world=moon: choose one of street, indoor"),
        ("data.frames=0", "data.frames=0: must be null or a whole number above 0"),
        ("data.world_seed=abc", "data.world_seed=abc: must be a whole number, not negative"),
        ("data.fresh_worlds=maybe", "data.fresh_worlds=maybe: must be true or false"),
        ("data.realism.tilt=1", "data.realism.tilt=1: must be true or false"),
        ("data.sensor=3", "data.sensor=3: is a group; set its members, for instance data.sensor.reso"),
        ("data.realism=false", "data.realism=False: is a group; set its members"),
        ("+data.passes.small.cnn=3", "data.passes has become model.epochs and model.first_stage.epochs"),
    ],
)
def test_bad_options_of_the_simulation_are_named(configure, option, message):
    with pytest.raises(InputError, match=f"^{message}"):
        plain(configure("data=simulated", option))


@pytest.mark.parametrize("content", ["", "{", "a: 1", "[1]"])
def test_a_foreign_configuration_is_refused(configure, tmp_path, content):
    (tmp_path / "config.yaml").write_text(content)
    with pytest.raises(InputError, match=r"config\.yaml: not the configuration of a run"):
        evaluate(configure(f"run={tmp_path}", name="evaluate", run="evaluation"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        pytest.param(["train.py", "data=kitti"], "data.root is missing", marks=pytest.mark.slow),
        pytest.param(["train.py", "data=kitti", "data.root=nowhere"], "nowhere", marks=pytest.mark.slow),
        (["train.py", "model.kernel=3"], "model.kernel: there is no such option; --help"),
        (["train.py", "data=kiti"], "data=kiti: there is no such choice; there are all_round, blind, carmen"),
        pytest.param(["evaluate.py", "run=nowhere"], "nowhere/config.yaml", marks=pytest.mark.slow),
    ],
)
def test_a_mistake_on_the_command_line_gives_a_line_and_a_status(tmp_path, arguments, message):
    script, *options = arguments
    command = [sys.executable, str(ROOT / script), *options, f"outputs={tmp_path}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert message in done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr


def test_help_prints_the_options():
    command = [sys.executable, str(ROOT / "train.py"), "--help"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert "data: all_round, blind, carmen, half_circle, indoor, kitti" in done.stdout
    assert "kernel_size: 3" in done.stdout


def test_help_is_quick_because_it_does_not_import_torch():
    code = "import sys, train; assert 'torch' not in sys.modules and 'lightning' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, timeout=60)
