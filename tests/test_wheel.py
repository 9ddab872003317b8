"""An installed wheel, without the checkout: nothing that a command needs may be missing from it."""

import json
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from conftest import LENGTHS, ROOT, SMALL
from data.make_kitti import make_kitti

pytestmark = pytest.mark.slow
FINE = "data.sensor.resolution_deg=0.2"
"""As a Velodyne's beams, of which only a network with such bins can make use."""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder into which pip has installed the wheel."""
    pytest.importorskip("setuptools", reason="without setuptools no wheel can be built offline")
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    shutil.copytree(ROOT / "src", source / "src", ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
    for name in ("pyproject.toml", "README.md"):
        shutil.copy(ROOT / name, source)
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = ["wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", folder, source]
    subprocess.run([*pip, *build], check=True, timeout=300)
    [wheel] = folder.glob("*.whl")
    target = folder / "installed"
    subprocess.run([*pip, "install", "--no-deps", "--no-index", "--target", target, wheel], check=True)
    return target


@pytest.fixture(scope="module")
def call(installed, tmp_path_factory):
    """Runs Python with the installed package from a folder of its own; what it printed."""
    elsewhere = tmp_path_factory.mktemp("elsewhere")

    def call(*arguments):
        environment = os.environ | {"PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, *map(str, arguments)]
        done = subprocess.run(command, cwd=elsewhere, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return call


@pytest.fixture(scope="module")
def drives(tmp_path_factory):
    root = tmp_path_factory.mktemp("drives")
    make_kitti(root, ["00", "10", "05"], frames=60)
    return root


def command(name, *arguments):
    return ("-m", "rcnn_odom.cli", name, *arguments)


def test_the_package_is_the_installed_one(call, installed):
    printed = call("-c", "import rcnn_odom, rcnn_odom.cli as cli; print(rcnn_odom.__file__, cli.__file__)")
    assert all(path.startswith(str(installed)) for path in printed.split())
    assert (installed / "bin" / "rcnn-odom").exists()


def test_the_shipped_network_runs_and_is_scored(call, drives, tmp_path):
    call(*command("run", drives / "sequences" / "05", "--model", "rcnn_small", "--out", tmp_path / "out"))
    trajectory = tmp_path / "out" / "trajectory.txt"
    assert np.loadtxt(trajectory).shape == (60, 12)
    options = ("--planar", "--lengths", "10,20", "--json")
    told = json.loads(call(*command("drift", drives / "poses" / "05.txt", trajectory, *options)))
    assert told["segments"] > 0
    assert 0 < told["t_err"] < 2


def test_a_run_is_exported_and_the_file_runs(call, drives, tmp_path):
    run = tmp_path / "outputs" / "run"
    data = [f"data.root={drives}", "data=kitti", "data.train=['00']", "data.test=['05']", LENGTHS]
    call(ROOT / "train.py", "model=cnn_reg", *SMALL, FINE, *data, f"outputs={run.parent}", f"run_dir={run}")
    call(*command("export", run))
    call(
        *command("run", drives / "sequences" / "05", "--model", run / "model.onnx", "--out", tmp_path / "out")
    )
    offline = np.loadtxt(run / "trajectories" / "05.txt")
    np.testing.assert_allclose(np.loadtxt(tmp_path / "out" / "trajectory.txt"), offline, atol=1e-3)
