"""Small untrained models and scans for the tests of models and of streaming odometry."""

import numpy as np
import torch

from rcnn_odom.models.contract import find_model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.two_numbers import steps_of

SENSOR = Sensor(1.0, 180.0, 40.0)
ANGLES = np.deg2rad(np.arange(181) - 90.0)
NAMES = ["cnn_reg", "cnn_cls", "rcnn_reg", "rcnn_cls"]
MEAN, DEVIATION = np.array([0.5, 0.01]), np.array([0.2, 0.03])
"""Of the training motions that the small models were told of: metres and radians."""


def options(variant="rcnn_reg", **changes):
    """Options of a small model, as ``conf/model`` gives them."""
    model = {
        "kernel_size": 3,
        "pooling": "avg",
        "angle": "expectation",
        "dropout": 0.0,
        "rotation_classes": {"count": 112, "width_deg": 0.1},
        "apply": "middle",
        "beta": 1.0 if variant.endswith("cls") else 100.0,
        "per_sample_norm": False,
        "epochs": 2,
        "learning_rate": 1e-3,
        "window": 1,
        "batch_size": 8,
    }
    if variant.startswith("rcnn"):
        model |= {"first_stage": {**model, "variant": "cnn_cls"}, "pretrained": None, "freeze": False}
        model |= {"hidden_size": 16, "layers": 2, "projection": None, "window": 5, "batch_size": 4}
    return {**model, **changes}


def motions_like(mean, deviation):
    """Two motions (2, 2) with this mean and deviation."""
    return np.array([np.add(mean, deviation), np.subtract(mean, deviation)])


def build(variant="rcnn_reg", projection=None, sensor=SENSOR, fitted=True, seed=0, **changes):
    """A model with random weights and large enough outputs to tell motions apart."""
    torch.manual_seed(seed)
    if variant.startswith("rcnn"):
        changes["projection"] = projection
    model = find_model(variant)(options(variant, **changes), sensor)
    model.set_units([steps_of(motions_like(MEAN, DEVIATION), "middle")])
    if fitted:
        width = model.uncertainty.weights.shape[1]
        model.uncertainty.weights.copy_(0.01 * torch.arange(1, 2 * width + 1).reshape(2, width))
        model.uncertainty.lateral.fill_(0.02)
        model.least_filled.fill_(0.1)
        model.period.fill_(0.1)
    return model.eval()


def random_scans(frames, seed=0, bins=181):
    """Depth vectors (frames, bins), float32, a tenth of the bins empty."""
    rng = np.random.default_rng(seed)
    scans = rng.uniform(1, 39, (frames, bins)).astype(np.float32)
    scans[rng.random(scans.shape) < 0.1] = 0
    return scans
