"""Sweeps: their folders, what their jobs share, and that the same command goes on."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from multiprocessing import get_context
from pathlib import Path

import pytest
import torch
import yaml
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from conftest import ROOT
from rcnn_odom.evaluation.run_folder import BEST, LAST
from rcnn_odom.files import one_at_a_time
from rcnn_odom.training.sweep import LONGEST_NAME, expected_folders, folder_name
from train import train


@pytest.fixture
def command(kitti, tmp_path):
    def command(*overrides):
        small = ["data.sensor.resolution_deg=1.0", "data.workers=1", "model.batch_size=8"]
        script = [sys.executable, str(ROOT / "train.py"), "-m"]
        return [*script, *kitti, *small, "trainer.accelerator=cpu", f"outputs={tmp_path}", *overrides]

    return command


@pytest.fixture
def sweep(command):
    def sweep(*overrides, status=0):
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            command(*overrides), capture_output=True, text=True, timeout=300, env=environment
        )
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout + done.stderr

    return sweep


def runs_of(folder):
    return sorted(path.parent for path in folder.glob("*/config.yaml"))


def test_names_are_those_of_the_overrides():
    assert folder_name("model-cnn_cls__seed-0") == "model-cnn_cls__seed-0"
    assert folder_name("") == "defaults"
    # What tells the jobs apart comes first, and survives the cut.
    long = "__".join(["data.root-" + "x" * 200, "model.kernel_size-3", "seed-0"])
    assert re.fullmatch(r"model.kernel_size-3__seed-0__data.root-x+-[0-9a-f]{8}", folder_name(long))
    assert len(folder_name(long)) <= LONGEST_NAME + 9


def test_what_a_folder_may_not_be_called_still_tells_jobs_apart():
    names = {folder_name(f"data.train-[{names}]") for names in ("00", "00,02", "00/02")}
    assert len(names) == 3
    assert all(re.fullmatch(r"[\w.~+-]+", name) for name in names)


@pytest.mark.slow
def test_a_killed_sweep_goes_on_where_it_was(command, sweep, tmp_path):
    options = ["+sweeps=kernel_size", "model.kernel_size=3,5", "seed=0", "model.epochs=3"]
    process = subprocess.Popen(command(*options), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    second = tmp_path / "kernel_size" / "{}"
    deadline = time.monotonic() + 200
    try:
        while not list((tmp_path / "kernel_size").glob(f"*kernel_size-5*/{LAST}")):
            assert time.monotonic() < deadline
            assert process.poll() is None, "it ended before it could be killed"
            time.sleep(0.02)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    first, second = runs_of(tmp_path / "kernel_size")
    scores = (first / "metrics.json").read_text()
    assert not (second / "metrics.json").exists()
    printed = sweep(*options)
    assert f"run {first} is already finished" in printed
    assert f"continuing from {second / LAST}" in printed
    assert (first / "metrics.json").read_text() == scores
    assert (second / "metrics.json").exists()
    assert expected_folders(tmp_path / "kernel_size") == [first.name, second.name]


def test_all_expected_jobs_are_named_also_those_that_never_ran(tmp_path, command):
    # Hydra checks all jobs before the first one starts; by then the folder says what was asked for.
    process = subprocess.Popen(
        command("+sweeps=pooling"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while not (tmp_path / "pooling" / "multirun.yaml").exists():
        assert process.poll() is None
        time.sleep(0.02)
    process.kill()
    process.wait()
    names = expected_folders(tmp_path / "pooling")
    assert len(set(names)) == 6
    assert all("model.pooling-avg" in name or "model.pooling-max" in name for name in names)


def test_nothing_is_expected_of_what_is_no_grid(tmp_path):
    assert expected_folders(tmp_path) is None
    settings = {
        "hydra": {"sweeper": {"_target_": "hydra_plugins.some.RandomSweeper", "params": {"a": "1,2"}}}
    }
    (tmp_path / "multirun.yaml").write_text(yaml.safe_dump(settings))
    assert expected_folders(tmp_path) is None


@pytest.mark.slow
def test_a_failed_job_does_not_end_the_sweep_but_its_status(sweep, tmp_path):
    printed = sweep(
        "model=cnn_reg",
        "model.epochs=1",
        "model.kernel_size=4,3",
        "hydra.sweep.dir=" + str(tmp_path / "s"),
        status=1,
    )
    assert "model.kernel_size=4: must be odd" in printed
    assert "Traceback" not in printed
    three, four = sorted((tmp_path / "s").glob("model*"))
    assert (three / "metrics.json").exists()
    assert not (three / "error.txt").exists()
    assert "must be odd" in (four / "error.txt").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["+sweeps=nothing"], "sweeps=nothing: there is no such choice; there are beta"),
        (["model.kernel_size=3,5", "run_dir=here"], "run_dir= is the folder of a single run"),
    ],
)
def test_mistakes_are_told_in_a_line(sweep, options, message):
    printed = sweep(*options, status=1)
    assert message in printed
    assert "Traceback" not in printed


def test_a_sweep_file_with_an_unknown_key_is_told_before_anything_runs(sweep, tmp_path):
    (tmp_path / "mine" / "sweeps").mkdir(parents=True)
    lines = ["# @package _global_", "hydra: {sweeper: {params: {model.kernal_size: '3,5'}}}"]
    (tmp_path / "mine" / "sweeps" / "typo.yaml").write_text("\n".join(lines))
    printed = sweep("+sweeps=typo", "--config-dir", str(tmp_path / "mine"), status=1)
    assert "model.kernal_size" in printed
    assert "Traceback" not in printed
    assert not runs_of(tmp_path)


def test_a_sweep_without_multirun_is_refused(kitti, tmp_path):
    script = [sys.executable, str(ROOT / "train.py"), *kitti, f"outputs={tmp_path}", "+sweeps=kernel_size"]
    done = subprocess.run(script, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert "+sweeps= needs -m" in done.stdout + done.stderr


@pytest.mark.slow
def test_a_moved_sweep_is_known_again(sweep, tmp_path):
    options = ["model=cnn_reg", "model.epochs=1", "seed=0"]
    sweep(*options, f"hydra.sweep.dir={tmp_path}/here")
    (tmp_path / "here").rename(tmp_path / "there")
    printed = sweep(*options, f"hydra.sweep.dir={tmp_path}/there", f"outputs={tmp_path}/new")
    assert "is already finished" in printed


@pytest.mark.slow
def test_sampling_sweepers_draw_once_for_all_processes(sweep, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="the extra 'sweeps' is not installed")
    small = ["model=cnn_reg", "model.epochs=1", "trainer=ddp", f"hydra.sweep.dir={tmp_path}/drawn"]
    sweep("hydra/sweeper=optuna", "hydra.sweeper.n_trials=1", "model.beta=interval(1,100)", *small)
    [run] = runs_of(tmp_path / "drawn")
    drawn = yaml.safe_load((run / "config.yaml").read_text())["model"]["beta"]
    used = torch.load(run / BEST, weights_only=True)["hyper_parameters"]["model"]["beta"]
    assert used == drawn


@pytest.mark.slow
def test_optuna_minimises_validation_drift_and_goes_on(sweep, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_optuna_sweeper", reason="the extra 'sweeps' is not installed")
    small = ["model.hidden_size=16", "model.epochs=1", "model.first_stage.epochs=1"]
    options = ["+sweeps=optuna", *small, "hydra.sweeper.n_trials=2"]
    sweep(*options)
    runs = runs_of(tmp_path / "optuna")
    drifts = [json.loads((run / "metrics.json").read_text())["val"]["drift"] for run in runs]
    found = yaml.safe_load((tmp_path / "optuna" / "optimization_results.yaml").read_text())
    assert found["best_value"] == min(drifts)
    assert set(found["best_params"]) == {"model.beta", "model.learning_rate", "model.dropout", "model.window"}
    # Both trials start from the same CNN, and the same command draws the same trials.
    assert len(list(tmp_path.rglob("first_stage/metrics.json"))) == 1
    assert sweep(*options).count("is already finished") == 2


@pytest.mark.slow
def test_jobs_of_joblib_train_their_first_stage_once(sweep, tmp_path):
    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="the extra 'sweeps' is not installed")
    small = ["model.epochs=1", "model.hidden_size=16", "model.first_stage.epochs=1", "seed=0"]
    parallel = ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    sweep("+sweeps=table2", "model=rcnn_reg,rcnn_cls", *small, *parallel)
    stages = {
        json.loads((run / "metrics.json").read_text())["first_stage"] for run in runs_of(tmp_path / "table2")
    }
    assert len(stages) == 1
    assert len(list(tmp_path.rglob("first_stage/metrics.json"))) == 1


def test_the_same_training_is_not_done_twice(configure, kitti, tmp_path, caplog):
    caplog.set_level("INFO")
    first = train(configure("model=cnn_reg", *kitti), reuse=True)
    assert "same_as" not in first
    second = train(configure("model=cnn_reg", *kitti, run="second"), reuse=True)
    assert "its weights are used" in caplog.text
    assert second["same_as"] == str(tmp_path / "outputs" / "run")
    assert second["test"] == first["test"]
    assert second["val"] == first["val"]
    assert (tmp_path / "outputs" / "second" / BEST).exists()
    events = EventAccumulator(str(tmp_path / "outputs" / "second" / "tensorboard"))
    events.Reload()
    (card,) = events.Tensors("About this run")
    text = card.tensor_proto.string_val[0].decode()
    assert f"- **Weights:** those of `{tmp_path}/outputs/run`, which has finished the same training" in text
    third = train(configure("model=cnn_reg", *kitti, "seed=1", run="third"), reuse=True)
    assert "same_as" not in third
    # Outside a sweep a user who asks for a training gets one.
    assert "same_as" not in train(configure("model=cnn_reg", *kitti, run="fourth"))


def test_a_finished_run_of_other_settings_is_not_taken_for_this_one(configure, kitti):
    first = train(configure("model=cnn_reg", *kitti), reuse=True)
    assert train(configure("model=cnn_reg", *kitti), reuse=True) == first
    with pytest.raises(Exception, match="holds a finished run"):
        train(configure("model=cnn_reg", *kitti, "seed=1"), reuse=True)


def _hold(folder, events):
    with one_at_a_time(Path(folder), "work", "working"):
        events.append(("in", os.getpid()))
        time.sleep(0.3)
        events.append(("out", os.getpid()))


@pytest.mark.slow
def test_one_process_at_a_time(tmp_path):
    context = get_context("spawn")
    with context.Manager() as manager:
        events = manager.list()
        processes = [context.Process(target=_hold, args=(tmp_path, events)) for _ in range(2)]
        for process in processes:
            process.start()
        for process in processes:
            process.join(60)
        kinds, owners = zip(*events, strict=True)
    assert kinds == ("in", "out", "in", "out")
    assert owners[0] == owners[1] != owners[2] == owners[3]
