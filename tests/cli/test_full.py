"""`rcnn-odom train` and `evaluate`, and what is said where only the robot's part is installed."""

import os
import subprocess
import sys
from importlib.machinery import ModuleSpec

import pytest

from conftest import ROOT
from rcnn_odom.cli import full, main


def run(folder, *arguments, status=0):
    """A command of its own process in a folder; what it printed."""
    command = [sys.executable, *map(str, arguments)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done


TRAIN, EVALUATE = (("-m", "rcnn_odom.cli", name) for name in ("train", "evaluate"))


@pytest.mark.parametrize(
    ("command", "script"), [(TRAIN, ROOT / "train.py"), (EVALUATE, ROOT / "evaluate.py")]
)
def test_a_command_is_the_same_as_its_script(tmp_path, command, script):
    options = ("--cfg", "all", "data=kitti", 'data.root="~/x"', "run_dir=here", "outputs=there")
    by_command, by_script = run(tmp_path, *command, *options), run(tmp_path, script, *options)
    assert by_command.stdout == by_script.stdout
    assert f"path: {ROOT}/conf\n" in by_command.stdout
    assert f"name: {script.stem}\n" in by_command.stdout


def test_help_is_hydras(tmp_path):
    printed = run(tmp_path, *TRAIN, "--help").stdout
    assert printed.startswith("train is powered by Hydra.")
    assert "table2" in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["model=rcnn"], "model=rcnn: there is no such choice"),
        (["seed"], "seed: is not an option; write NAME=VALUE"),
        (["+sweeps=table2", "--multirun", "--cfg", "job"], "Only one of --run, --multirun, --cfg"),
        (["data.root="], "data.root=: is an empty path"),
    ],
)
def test_mistakes_are_one_line(tmp_path, arguments, message):
    done = run(tmp_path, *TRAIN, *arguments, status=1)
    assert done.stderr.startswith(f"error: {message}")
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""


@pytest.fixture(params=["nothing", "what an uninstalled one left behind"])
def robot(monkeypatch, request):
    """Training is not installed."""
    left = ModuleSpec("rcnn_odom.training", None, is_package=True)
    found = None if request.param == "nothing" else left
    monkeypatch.setattr(full, "find_spec", {"rcnn_odom.training": found}.__getitem__)


@pytest.mark.parametrize("name", ["train", "evaluate", "report", "export"])
@pytest.mark.parametrize("arguments", [[], ["--help"], ["--multirun", "model=rcnn_reg"], ["a", "--json"]])
def test_without_training_commands_say_what_to_install(robot, capsys, name, arguments):
    assert main([name, *arguments]) == 1
    told = f"rcnn-odom {name} needs the full distribution, not only rcnn-odom-robot: pip install rcnn-odom"
    assert capsys.readouterr().err == f"rcnn-odom: error: {told}\n"


def test_without_training_the_help_says_so(robot, capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    assert capsys.readouterr().out.count("needs the full distribution: pip install rcnn-odom") == 4


def test_without_training_a_checkpoint_cannot_run(robot, capsys, tmp_path):
    assert main(["run", "a.bag", "--model", "best.ckpt", "--out", str(tmp_path)]) == 1
    told = (
        "best.ckpt: a checkpoint needs the full distribution, not only rcnn-odom-robot: pip install rcnn-odom"
    )
    assert capsys.readouterr().err == f"rcnn-odom: error: {told}\n"


def test_without_training_simulate_advises_no_scoring(robot, capsys, tmp_path):
    assert main(["simulate", "--out", str(tmp_path / "a"), "--frames", "2"]) == 0
    assert capsys.readouterr().out == f"wrote 00 to {tmp_path}/a\n"
