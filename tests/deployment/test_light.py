"""What a robot loads, and when."""

import subprocess
import sys

import pytest

import rcnn_odom.deployment
from conftest import ROOT
from rcnn_odom.deployment import odometer

HEAVY = {"torch", "numba", "llvmlite", "scipy", "onnxruntime", "matplotlib", "rosbags", "yaml", "hydra"}
SECONDS = 0.5
"""Of the processor's time; what the clock shows depends on what else the machine does."""


@pytest.mark.parametrize(
    "code",
    [
        "import rcnn_odom.deployment",
        "import rcnn_odom.deployment.odometer",
        "from rcnn_odom.deployment import Odometer",
        "from rcnn_odom.cli import main\ntry:\n    main(['run', '--help'])\nexcept SystemExit:\n    pass",
    ],
)
def test_an_import_and_the_help_load_nothing_heavy(code):
    code += f"\nimport resource, sys\nassert not sys.modules.keys() & {HEAVY}, sys.modules.keys() & {HEAVY}"
    code += "\nprint(resource.getrusage(resource.RUSAGE_SELF).ru_utime)"
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, cwd=ROOT, capture_output=True, text=True, timeout=600
    )
    assert float(done.stdout.splitlines()[-1]) < SECONDS


def test_the_package_gives_the_odometer():
    assert rcnn_odom.deployment.Odometer is odometer.Odometer
    assert rcnn_odom.deployment.Pose is odometer.Pose
    assert {"Odometer", "Pose"} < set(dir(rcnn_odom.deployment))
    with pytest.raises(AttributeError, match=r"module 'rcnn_odom\.deployment' has no attribute 'Odometre'"):
        rcnn_odom.deployment.Odometre  # noqa: B018
