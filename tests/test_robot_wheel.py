"""The distribution for robots: all that `rcnn-odom run` needs, and no PyTorch."""

import os
import re
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from zipfile import ZipFile

import grimp
import numpy as np
import pytest

from conftest import ROOT
from data.make_bag import make_bag
from matching.rooms import cast, circle, loop
from rcnn_odom import __version__
from rcnn_odom.cli import main
from rcnn_odom.deployment.shipped import shipped_models
from wheels import build_wheel, copy_source

FULL, ROBOT = (
    tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8")) for folder in (".", "robot")
)
NEEDS_ALL = ("train", "evaluate", "report", "export")
ASK_FIRST = {f"rcnn_odom.cli.{name}" for name in (*NEEDS_ALL, "run", "simulate")}
"""Modules that ask whether all of the project is there before they import more of it than a robot has."""


def names(dependencies):
    return {re.match(r"[\w.-]+", each)[0] for each in dependencies}


ONLY_FULL = names(FULL["project"]["dependencies"]) - names(ROBOT["project"]["dependencies"]) - {"matplotlib"}
MODULES = {"hydra-core": "hydra"}
"""What is imported under another name."""


def is_robots(module):
    """Whether a module is in the robot's distribution."""
    left_out = ROBOT["tool"]["rcnn-odom-robot"]["left-out"]
    packages = ROBOT["tool"]["setuptools"]["packages"]["find"]["exclude"]
    return module not in left_out and not any(fnmatch(module, pattern) for pattern in packages)


def test_both_distributions_want_the_same_versions():
    extras = ROBOT["project"]["optional-dependencies"]
    wanted = {*FULL["project"]["dependencies"], *FULL["project"]["optional-dependencies"]["view"]}
    assert {*ROBOT["project"]["dependencies"], *extras["pictures"], *extras["view"]} < wanted
    assert {"torch", "lightning", "hydra-core", "omegaconf", "pandas", "onnx"} < ONLY_FULL
    for key in ("requires-python", "scripts"):
        assert ROBOT["project"][key] == FULL["project"][key]


def test_what_a_robot_has_needs_nothing_that_it_has_not():
    graph = grimp.build_graph("rcnn_odom", include_external_packages=True, cache_dir=None)
    own = {module for module in graph.modules if module.split(".")[0] == "rcnn_odom"}
    assert set(ROBOT["tool"]["rcnn-odom-robot"]["left-out"]) < own, "a module that is gone is left out"
    heavy = {MODULES.get(name, name) for name in ONLY_FULL}
    for module in sorted(filter(is_robots, own)):
        imported = graph.find_modules_directly_imported_by(module)
        missing = {each for each in imported & own if not is_robots(each)} | imported & heavy
        if module not in ASK_FIRST:
            assert not missing, f"{module}: leave it out in robot/pyproject.toml, or these in it"


# --- installed -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("robot_wheel")
    source = copy_source(folder / "source")
    return build_wheel(source / "robot", folder)


@pytest.fixture(scope="module")
def robot(wheel, tmp_path_factory):
    """The folder of commands of a new environment with the wheel and what it needs."""
    folder = tmp_path_factory.mktemp("robot")
    subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True, timeout=3600)
    commands = folder / "venv" / "bin"
    pip = [commands / "python", "-m", "pip", "--quiet", "--disable-pip-version-check"]
    constrained = ["--constraint", ROOT / "constraints.txt"]
    probe = [*pip, "--retries", "0", "download", "--no-deps", *constrained, "--dest", folder, "tqdm"]
    probed = subprocess.run(probe, capture_output=True, text=True, timeout=3600, check=False)
    if probed.returncode:
        reason = f"pip reaches no index: {(probed.stderr.strip().splitlines() or ['?'])[-1]}"
        print(reason)
        pytest.skip(reason)
    subprocess.run([*pip, "install", *constrained, wheel], check=True, timeout=3600)
    return commands


@pytest.fixture(scope="module")
def call(robot, tmp_path_factory):
    """Runs a command of the new environment in a folder of its own; how it ended."""
    elsewhere = tmp_path_factory.mktemp("elsewhere")

    def call(name, *arguments, status=0):
        environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
        done = subprocess.run(
            [robot / name, *map(str, arguments)],
            cwd=elsewhere,
            env=environment | {"OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            timeout=3600,
            check=False,
        )
        assert done.returncode == status, done.stdout + done.stderr
        return done

    return call


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A bend through a room, by a laser as the shipped network half_circle knows them."""
    bearings = circle(0.25, 270.0)
    bearings -= bearings.mean()
    ranges = np.array([cast(pose, bearings) for pose in loop(40)])
    view = float(np.rad2deg(np.ptp(bearings)))
    return make_bag(tmp_path_factory.mktemp("bag"), "mcap", ranges, field_of_view_deg=view)


@pytest.mark.slow
def test_the_wheel_holds_the_networks_and_no_training(wheel):
    assert wheel.name == f"rcnn_odom_robot-{__version__}-py3-none-any.whl"
    with ZipFile(wheel) as file:
        modules = [name[: -len(".py")].replace("/", ".") for name in file.namelist() if name.endswith(".py")]
        others = {name for name in file.namelist() if not name.endswith(".py")}
    assert all(is_robots(module.removesuffix(".__init__")) for module in modules)
    assert "rcnn_odom.deployment.run" in modules
    networks = {f"rcnn_odom/deployment/shipped/{name}.onnx" for name in shipped_models()}
    assert networks
    assert networks < others
    assert not any("conf/" in name for name in others)


@pytest.mark.slow
def test_there_is_no_pytorch(call):
    assert "No module named 'torch'" in call("python", "-c", "import torch", status=1).stderr
    modules = sorted(MODULES.get(name, name.replace("-", "_")) for name in ONLY_FULL)
    code = f"from importlib.util import find_spec; print([name for name in {modules} if find_spec(name)])"
    assert call("python", "-c", code).stdout == "[]\n"
    assert call("rcnn-odom", "--version").stdout == f"rcnn-odom {__version__}\n"


@pytest.mark.slow
@pytest.mark.parametrize("words", [(), ("--model", "half_circle")])
def test_a_bag_becomes_the_trajectory_that_it_does_here(call, bag, tmp_path, words):
    assert main(["run", str(bag), *words, "--out", str(tmp_path / "here")]) == 0
    done = call("rcnn-odom", "run", bag, *words, "--out", tmp_path / "out")
    assert done.stderr.count("\n") == 1
    assert "they need matplotlib (pip install matplotlib)" in done.stderr
    assert "40 scans" in done.stdout
    files = {path.name for path in (tmp_path / "out").iterdir()}
    assert files == {"trajectory.txt", "trajectory.tum", "steps.jsonl", "summary.json", "report.html"}
    here, there = (np.loadtxt(tmp_path / folder / "trajectory.txt") for folder in ("here", "out"))
    assert there.shape == (40, 12)
    np.testing.assert_allclose(there, here, atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", NEEDS_ALL)
@pytest.mark.parametrize("arguments", [(), ("--help",), ("-m", "model=rcnn_reg", "+sweeps=table2")])
def test_what_needs_more_says_in_a_line_what_to_install(call, name, arguments):
    done = call("rcnn-odom", name, *arguments, status=1)
    told = f"rcnn-odom {name} needs the full distribution, not only rcnn-odom-robot: pip install rcnn-odom"
    assert (done.stdout, done.stderr) == ("", f"rcnn-odom: error: {told}\n")


@pytest.mark.slow
def test_other_commands_run_or_say_what_to_install(call, bag, tmp_path):
    checkpoint = call("rcnn-odom", "run", bag, "--model", "best.ckpt", "--out", tmp_path / "out", status=1)
    told = (
        "best.ckpt: a checkpoint needs the full distribution, not only rcnn-odom-robot: pip install rcnn-odom"
    )
    assert checkpoint.stderr == f"rcnn-odom: error: {told}\n"
    made = call("rcnn-odom", "simulate", "--out", tmp_path / "drives", "--frames", "4")
    assert made.stdout == f"wrote 00 to {tmp_path}/drives\n"
    poses = tmp_path / "drives" / "poses" / "00.txt"
    assert "null" in call("rcnn-odom", "drift", poses, poses, "--json").stdout
    code = "from rcnn_odom.deployment import Odometer; print(type(Odometer().tracker).__name__)"
    assert call("python", "-c", code).stdout == "MatcherTracker\n"
