"""A model, a recording format and a metric from outside the package: those that docs/extending.md shows."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest

from conftest import ROOT
from rcnn_odom.evaluation.sweep_report import load_runs
from rcnn_odom.geometry import compose, poses_to_planar

DOCS = ROOT / "docs" / "extending.md"
OPTIONS = ["model=small_net", "data=csv_scans", "data.workers=1", "trainer.accelerator=cpu", "model.epochs=3"]


def code_blocks():
    """The files that the page shows, by their names, which stand in their first line."""
    blocks = re.findall(r"```(?:python|yaml|toml)\n# (\S+)\n(.*?)```", DOCS.read_text(), re.DOTALL)
    return dict(blocks)


def write_package(folder):
    """The page's package, installed as pip would: its modules, its YAML files and its entry points."""
    blocks = code_blocks()
    for name, text in blocks.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    metadata = folder / "my_lasers-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: my-lasers\nVersion: 1.0\n")
    groups = re.findall(
        r'\[project\.entry-points\."(\S+)"\]\n((?:\w+ = .*\n)+)', blocks["pyproject.toml"] + "\n"
    )
    lines = [f"[{group}]\n{entries.replace(chr(34), '')}" for group, entries in groups]
    (metadata / "entry_points.txt").write_text("\n".join(lines))
    return folder


def write_drives(folder):
    """A robot in a rectangular room, seen by 181 beams."""
    bearings = np.deg2rad(np.arange(181) - 90.0)
    for seed, name in enumerate(("train", "val", "test")):
        rng = np.random.default_rng(seed)
        steps = np.stack([rng.uniform(0.05, 0.3, 79), np.zeros(79), rng.normal(0.05, 0.05, 79)], axis=1)
        rows = []
        for stamp, (x, y, heading) in enumerate(poses_to_planar(compose(steps))):
            directions = bearings + heading
            with np.errstate(divide="ignore", invalid="ignore"):
                to_x = (np.sign(np.cos(directions)) * 12 - x) / np.cos(directions)
                to_y = (np.sign(np.sin(directions)) * 9 - y) / np.sin(directions)
            rows.append([0.1 * stamp, x, y, heading, *np.fmin(np.abs(to_x), np.abs(to_y))])
        np.savetxt(folder / f"{name}.scans", rows, delimiter=",")


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("extending")
    write_package(folder / "my_lasers")
    (folder / "drives").mkdir()
    write_drives(folder / "drives")
    return folder


@pytest.fixture(scope="module")
def call(place):
    """Runs a command with the package installed; what it printed."""

    def call(*command, status=0):
        environment = os.environ | {"PYTHONPATH": str(place / "my_lasers"), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [sys.executable, *map(str, command)],
            cwd=place,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == status, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        return done.stdout + done.stderr

    return call


@pytest.fixture(scope="module")
def run(place, call):
    """The folder of a trained run of the page's network on the page's recordings."""
    conf = ("--config-dir", place / "my_lasers" / "conf")
    call(ROOT / "train.py", *conf, *OPTIONS, f"data.root={place}/drives", f"run_dir={place}/outputs/a")
    return place / "outputs" / "a"


def test_the_page_shows_all_of_its_package():
    assert set(code_blocks()) == {
        "pyproject.toml",
        "small_net.py",
        "csv_scans.py",
        "end_point.py",
        "conf/model/small_net.yaml",
        "conf/data/csv_scans.yaml",
    }


def test_training_scores_by_the_metric(run):
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["variant"] == "small_net"
    assert 0 < metrics["test"]["metrics"]["end_point_m"] < 30
    assert metrics["test"]["sequences"]["test"]["end_point_m"] == metrics["test"]["metrics"]["end_point_m"]
    assert set(metrics["coverage"]["test"]) >= {"distance", "heading"}  # the network's own covariances


@pytest.mark.slow
def test_evaluating_again_gives_the_same(place, call, run):
    again = place / "outputs" / "again"
    conf = ("--config-dir", place / "my_lasers" / "conf")
    call(ROOT / "evaluate.py", *conf, f"run={run}", f"run_dir={again}", f"outputs={place}/outputs")
    first, second = (json.loads((each / "metrics.json").read_text())["test"] for each in (run, again))
    assert first["metrics"] == pytest.approx(second["metrics"])


@pytest.mark.slow
def test_the_report_has_a_column_for_the_metric(place, call, run):
    call("-m", "rcnn_odom.cli", "report", place / "outputs")
    report = (place / "outputs" / "report.md").read_text()
    assert "small_net" in report
    assert "end point" in report
    code = f"import rcnn_odom.evaluation.sweep_report as r; print(*r.load_runs({str(place / 'outputs')!r}))"
    assert "end_point_m" in call("-c", code)
    assert "drift" in load_runs(place / "outputs")  # known without the package as well


@pytest.mark.slow
def test_exported_it_runs_on_a_recording_of_the_format(place, call, run):
    call("-m", "rcnn_odom.cli", "export", run)
    out = place / "poses"
    printed = call(
        "-m",
        "rcnn_odom.cli",
        "run",
        place / "drives" / "test.scans",
        "--model",
        run / "model.onnx",
        "--out",
        out,
    )
    assert "80 scans" in printed
    steps = [json.loads(line) for line in (out / "steps.jsonl").read_text().splitlines()]
    assert len(steps) == 80
    covariances = np.array([step["covariance"] for step in steps[1:]])
    assert (np.linalg.eigvalsh(covariances) > 0).all()
    offline = np.loadtxt(run / "trajectories" / "test.txt")
    np.testing.assert_allclose(np.loadtxt(out / "trajectory.txt"), offline, atol=1e-3)


@pytest.mark.parametrize(
    ("edit", "problem"),
    [
        (("    def loss(self", "    def cost(self"), "model small_net: lacks loss"),
        (('name = "small_net"', 'name = "smaller_net"'), "its class is named smaller_net"),
        (("import torch\n", "import torch\nimport no_such_package\n"), "cannot be imported"),
        (
            ("    class Options(Recipe):", "    class Options:"),
            "lacks the option batch_size, the option epochs",
        ),
        (
            ("    @dataclass\n    class Options(Recipe):", "    class Options:"),
            "Options that are no dataclass",
        ),
    ],
)
@pytest.mark.slow
def test_a_model_without_a_part_is_refused_in_a_line(place, call, run, edit, problem):
    path = place / "my_lasers" / "small_net.py"
    text = path.read_text()
    try:
        path.write_text(text.replace(*edit))
        conf = ("--config-dir", place / "my_lasers" / "conf")
        printed = call(ROOT / "train.py", *conf, *OPTIONS, f"data.root={place}/drives", status=1)
    finally:
        path.write_text(text)
    assert problem in printed
    assert printed.count("error") == 1


@pytest.mark.slow
def test_two_models_of_one_name_are_refused(place, call, run):
    path = place / "my_lasers" / "my_lasers-1.0.dist-info" / "entry_points.txt"
    text = path.read_text()
    try:
        path.write_text(text.replace("small_net = ", "matcher = "))
        printed = call(ROOT / "train.py", "model=cnn_reg", "data.frames=20", status=1)
    finally:
        path.write_text(text)
    assert "two models are called matcher" in printed


@pytest.mark.slow
def test_an_option_that_no_group_has_is_refused(place, call, run):
    conf = ("--config-dir", place / "my_lasers" / "conf")
    arguments = [*conf, *OPTIONS, f"data.root={place}/drives"]
    assert "model.widht" in call(ROOT / "train.py", *arguments, "model.widht=3", status=1)
    assert "there is no such option" in call(ROOT / "train.py", *arguments, "+model.depth=3", status=1)
    assert "must be" in call(ROOT / "train.py", *arguments, "model.width=0", status=1)
