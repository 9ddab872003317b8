"""What is better where scans were dropped: comparing over the gap, or holding the last motion."""

from types import SimpleNamespace

import numpy as np
import torch

from odometry import random_scans
from rcnn_odom.comparison.gaps import EVERY, gap_errors
from rcnn_odom.geometry import FORWARD_CAMERA, compose
from rcnn_odom.models.networks import Estimate
from rcnn_odom.recordings.cache import EncodedSequence


class Constant:
    """A network that always says the same, and counts in its state the pairs it has seen."""

    def __init__(self):
        self.seen = []

    def __call__(self, pairs, state):
        self.seen.append(state)
        return Estimate(torch.tensor([[[0.5, 0.0]]]), None), (state or 0) + 1


def test_errors_of_both_ways_on_a_straight_drive():
    frames, network = 100, Constant()
    poses = compose(np.tile([0.5, 0.0], (frames - 1, 1)))
    drive = EncodedSequence("a", "k", random_scans(frames), poses, np.arange(100.0), FORWARD_CAMERA)
    errors = gap_errors(SimpleNamespace(network=network), drive, periods=3)
    assert errors.shape == (96 // EVERY, 2, 2)
    # Compared, one motion is said for three; held, there are three.
    np.testing.assert_allclose(errors[:, 0], [[-1.0, 0.0]] * 4, atol=1e-6)
    np.testing.assert_allclose(errors[:, 1], 0, atol=1e-6)
    assert network.seen[EVERY - 1] == network.seen[EVERY], "the look over the gap leaves the state alone"
