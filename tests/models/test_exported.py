"""Shipped networks and exported files, scored like any model."""

import numpy as np
import pytest

from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.errors import InputError
from rcnn_odom.models.contract import find_model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.exported import ExportedOptions
from rcnn_odom.models.shipped_files import find_file
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.simulated import load


@pytest.mark.parametrize(("network", "world"), [("all_round", "street"), ("half_circle", "indoor")])
def test_its_steps_are_those_of_an_odometer(network, world):
    drive = Drive.unencoded(load("05", world=world, frames=6))
    steps = find_model("exported")({"network": network}, Sensor()).estimate(drive)
    odometer = Odometer.from_onnx(network)
    poses = [odometer.step(scan.ranges, stamp=scan.stamp, angles=scan.bearings) for scan in drive.raw_scans()]
    assert np.allclose(steps.values, [pose.step.array() for pose in poses[1:]])
    assert np.isfinite(steps.covariances).all()
    assert np.abs(steps.values[-1]).max() > 1e-3


def test_the_default_ships_along():
    assert find_file(ExportedOptions().network).name == "all_round.onnx"


def test_a_missing_network_is_told():
    with pytest.raises(InputError, match=r"nowhere\.onnx: no such file"):
        find_model("exported")({"network": "nowhere.onnx"}, Sensor())
