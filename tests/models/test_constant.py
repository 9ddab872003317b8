"""Estimators that look at no scan."""

import logging

import numpy as np

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import FORWARD_CAMERA, compose
from rcnn_odom.models.constant import ConstantStep, held_motion, mean_step
from rcnn_odom.recordings.recording import Drive, Recording

STEPS = {
    name: np.random.default_rng(seed).normal([0.5, 0.01, 0.02], 0.1, (40, 3))
    for seed, name in enumerate("ab")
}


def open_recording(name):
    if name not in STEPS:
        raise InputError(f"{name}: no such recording")
    return Recording(name, compose(STEPS[name]), np.arange(41.0), None, name)


def test_the_same_step_for_every_pair():
    drive = Drive("a", "k", np.zeros((5, 3)), compose(STEPS["a"][:4]), np.arange(5.0), FORWARD_CAMERA)
    found = ConstantStep(np.array([1.0, 0.0, 0.1])).estimate(drive)
    np.testing.assert_array_equal(found.values, [[1.0, 0.0, 0.1]] * 4)
    assert np.isnan(found.covariances).all()
    assert (held_motion().estimate(drive).values == 0).all()


def test_mean_step_is_that_of_all_training_drives_and_parts():
    found = mean_step(open_recording, ["a", "b[0.0:0.5]"])
    # 41 frames: half of them, rounded to even, are 20, with 19 steps between them.
    np.testing.assert_allclose(found, np.concatenate([STEPS["a"], STEPS["b"][:19]]).mean(0), atol=1e-9)


def test_mean_step_is_left_out_where_a_drive_cannot_be_read(caplog):
    with caplog.at_level(logging.INFO):
        assert mean_step(open_recording, ["a", "c"]) is None
    assert caplog.messages == [
        "mean_motion is left out, because not all of data.train can be read: c: no such recording"
    ]
