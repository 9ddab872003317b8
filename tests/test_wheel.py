"""An installed wheel, without the checkout: nothing that a command needs may be missing from it."""

import json
import os
import subprocess
import sys
import tarfile
from zipfile import ZipFile

import numpy as np
import pytest

from conftest import LENGTHS, ROOT, SMALL, SMALL_RECURRENT
from data.make_kitti import make_kitti
from wheels import PIP, build_wheel, copy_source

pytestmark = pytest.mark.slow
FINE = "data.sensor.resolution_deg=0.2"
"""As a Velodyne's beams, of which only a network with such bins can make use."""


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of what the wheel is built from."""
    return copy_source(tmp_path_factory.mktemp("checkout") / "source")


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory):
    return build_wheel(source, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """The folder into which pip has installed the wheel."""
    target = tmp_path_factory.mktemp("target") / "installed"
    subprocess.run([*PIP, "install", "--no-deps", "--no-index", "--target", target, wheel], check=True)
    return target


@pytest.fixture(scope="module")
def call(installed, tmp_path_factory):
    """Runs Python with the installed package from a folder of its own, or another; what it printed."""
    elsewhere = tmp_path_factory.mktemp("elsewhere")

    def call(*arguments, folder=elsewhere):
        environment = os.environ | {"PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, *map(str, arguments)]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
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


def contents(wheel):
    with ZipFile(wheel) as file:
        return {name: file.read(name) for name in file.namelist() if not name.endswith("/RECORD")}


def test_the_wheel_holds_what_hydra_reads(wheel):
    prefix = "rcnn_odom/conf/"
    packed = {name: text for name, text in contents(wheel).items() if name.startswith(prefix)}
    groups = {path.relative_to(ROOT / "conf"): path for path in (ROOT / "conf").rglob("*.yaml")}
    sweeps = {path.relative_to(ROOT): path for path in (ROOT / "sweeps").glob("*.yaml")}
    assert len(sweeps) > 5
    assert packed == {f"{prefix}{name}": path.read_bytes() for name, path in (groups | sweeps).items()}


def test_a_source_distribution_makes_the_same_wheel(source, wheel, tmp_path):
    code = f"from setuptools import build_meta; print(build_meta.build_sdist({str(tmp_path)!r}))"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True, timeout=3600)
    [packed] = tmp_path.glob("*.tar.gz")
    with tarfile.open(packed) as file:
        file.extractall(tmp_path, filter="data")
    [unpacked] = (path for path in tmp_path.iterdir() if path.is_dir())
    again = build_wheel(unpacked, tmp_path)
    assert contents(again) == contents(wheel)


def test_the_commands_of_a_checkout_work_in_any_folder(call, drives, tmp_path):
    data = [f"data.root={drives}", "data=kitti", "data.train=['00']", "data.test=['05']", LENGTHS]
    call(*command("train", "model=rcnn_reg", *SMALL, *SMALL_RECURRENT, *data), folder=tmp_path)
    run = tmp_path / "outputs" / "latest"
    assert "drift" in (run / "train.log").read_text()
    call(*command("evaluate", "run=outputs/latest", "run_dir=again"), folder=tmp_path)
    first, second = (json.loads((each / "metrics.json").read_text()) for each in (run, tmp_path / "again"))
    assert first["variant"] == "rcnn_reg"
    assert first["test"] == second["test"]
    assert (tmp_path / "again" / "evaluate.log").exists()


def test_a_sweep_of_the_project_is_found_and_reported(call, drives, tmp_path):
    data = [f"data.root={drives}", "data=kitti", "data.train=['00']", "data.test=['05']", LENGTHS]
    models = ("model=cnn_reg,cnn_cls", "seed=0")
    call(*command("train", "--multirun", "+sweeps=table2", *models, *SMALL, *data), folder=tmp_path)
    assert len(list((tmp_path / "outputs" / "table2").glob("*/metrics.json"))) == 2
    call(*command("report", "outputs/table2"), folder=tmp_path)
    report = (tmp_path / "outputs" / "table2" / "report.md").read_text()
    assert "    rcnn-odom train -m +sweeps=table2 model=cnn_reg,cnn_cls" in report


def test_the_shipped_network_runs_and_is_scored(call, drives, tmp_path):
    call(*command("run", drives / "sequences" / "05", "--model", "all_round", "--out", tmp_path / "out"))
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
