"""Shipped networks and exported files, scored like any model."""

import numpy as np
import pytest

from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.errors import InputError
from rcnn_odom.models.contract import find_model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.recordings.recording import Drive
from rcnn_odom.recordings.simulated import load


def test_its_steps_are_those_of_an_odometer():
    drive = Drive.unencoded(load("05", frames=6))
    steps = find_model("exported")({"network": "rcnn_small"}, Sensor()).estimate(drive)
    odometer = Odometer.from_onnx("rcnn_small")
    poses = [odometer.step(scan.ranges, stamp=scan.stamp, angles=scan.bearings) for scan in drive.raw_scans()]
    assert np.allclose(steps.values, [pose.step.array() for pose in poses[1:]])
    assert np.isfinite(steps.covariances).all()
    assert steps.values[-1, 0] > 0.1


def test_a_missing_network_is_told():
    with pytest.raises(InputError, match=r"nowhere\.onnx: no such file"):
        find_model("exported")({"network": "nowhere.onnx"}, Sensor())
