"""Small untrained modules and scans for the tests of streaming odometry."""

import numpy as np
import torch

from rcnn_odom.models.encoding import Sensor
from rcnn_odom.training.modules import VARIANTS

SENSOR = Sensor(1.0, 180.0, 40.0)
ANGLES = np.deg2rad(np.arange(181) - 90.0)
NAMES = ["cnn_reg", "cnn_cls", "rcnn_reg", "rcnn_cls"]


def build(variant="rcnn_reg", projection=None, sensor=SENSOR, fitted=True):
    """A module with random weights and large enough outputs to tell motions apart."""
    torch.manual_seed(0)
    model = {
        "kernel_size": 3,
        "pooling": "avg",
        "angle": "expectation",
        "dropout": 0.0,
        "rotation_classes": {"count": 112, "width_deg": 0.1},
        "hidden_size": 16,
        "layers": 2,
        "projection": projection,
        "freeze": False,
    }
    module = VARIANTS[variant](model, sensor.as_dict(), {"lengths": [5.0], "apply": "middle"})
    module.set_motion_statistics(np.array([0.5, 0.01]), np.array([0.2, 0.03]))
    if fitted:
        width = module.uncertainty.weights.shape[1]
        module.uncertainty.weights.copy_(0.01 * torch.arange(1, 2 * width + 1).reshape(2, width))
        module.uncertainty.least_filled.fill_(0.1)
        module.uncertainty.period.fill_(0.1)
    return module.eval()


def random_scans(frames, seed=0, bins=181):
    """Depth vectors (frames, bins), float32, a tenth of the bins empty."""
    rng = np.random.default_rng(seed)
    scans = rng.uniform(1, 39, (frames, bins)).astype(np.float32)
    scans[rng.random(scans.shape) < 0.1] = 0
    return scans
