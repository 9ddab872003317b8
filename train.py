"""Trains and scores one model: ``python train.py model=rcnn_reg data=kitti data.root=DIR``.

The same as ``rcnn-odom train``, which is also there without a checkout.
"""

import sys

from rcnn_odom.training.entry import run_train
from rcnn_odom.training.entry import train as train

if __name__ == "__main__":
    sys.exit(run_train(sys.argv[1:]))
