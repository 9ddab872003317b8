"""Shared pieces of the tests that run whole experiments."""

import random
import sys
from pathlib import Path

import hypothesis
import numpy as np
import pytest
from hydra import compose, initialize_config_dir

from data.make_kitti import make_kitti

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
"""Real recordings; tests that need them skip where they are absent."""
sys.path.insert(0, str(ROOT))

# Damaged files are read from disk, which knows no deadline. The short mode tries the same cases every time.
hypothesis.settings.register_profile(
    "short",
    max_examples=150,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[hypothesis.HealthCheck.too_slow],
)
hypothesis.settings.register_profile(
    "long", hypothesis.settings.get_profile("short"), max_examples=2500, derandomize=False, print_blob=True
)
hypothesis.settings.load_profile("short")

SMALL = [
    "data.sensor.resolution_deg=1.0",
    "data.workers=1",
    "model.epochs=2",
    "model.batch_size=8",
    "trainer.accelerator=cpu",
]
SMALL_RECURRENT = [
    "model.hidden_size=16",
    "model.window=8",
    "model.first_stage.epochs=1",
    "model.first_stage.batch_size=8",
]


LENGTHS = "data.lengths=[10.0,20.0]"


def pytest_collection_modifyitems(items):
    """Files with slow tests come first, so that at the end no process is alone with a long one."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(scope="session")
def kitti(tmp_path_factory):
    """Options for three tiny drives in KITTI's layout."""
    root = tmp_path_factory.mktemp("kitti")
    make_kitti(root, ["00", "10", "05"], frames=60)
    return [f"data.root={root}", "data=kitti", "data.train=['00']", "data.test=['05']", LENGTHS]


@pytest.fixture(autouse=True)
def seeds():
    """Whoever draws at random draws the same every time, alone and among other tests."""
    random.seed(0)
    np.random.seed(0)  # noqa: NPY002 - of libraries that use it
    if torch := sys.modules.get("torch"):
        torch.manual_seed(0)


@pytest.fixture
def configure(tmp_path):
    """A configuration as ``train.py`` gets it, of a size for tests, writing below ``tmp_path``."""
    return configure_in(tmp_path)


def configure_in(folder):
    """What the fixture ``configure`` is, writing below a folder."""

    def configure(*overrides, name="config", run="run"):
        small = [] if name == "evaluate" else SMALL
        if any(f"model={variant}" in overrides for variant in ("rcnn_reg", "rcnn_cls")):
            small = small + SMALL_RECURRENT
        folders = [f"outputs={folder}/outputs", f"run_dir={folder}/outputs/{run}"]
        with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
            return compose(name, [*small, *folders, *overrides])

    return configure


def pytest_terminal_summary(terminalreporter):
    """Says how much random input was tried."""
    fuzz = sys.modules.get("test_fuzz")
    if fuzz and fuzz.CASES:
        each = ", ".join(f"{count} {what}" for what, count in sorted(fuzz.CASES.items()))
        terminalreporter.write_line(f"fuzz: {sum(fuzz.CASES.values())} cases ({each})")
