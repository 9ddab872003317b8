"""Scores a finished run again, also on other data: ``python evaluate.py run=outputs/latest``.

Or a model that does not train and so has no run: ``python evaluate.py model=matcher data=simulated``.
Or many methods beside each other: ``python evaluate.py -m +sweeps=peers``.

The same as ``rcnn-odom evaluate``, which is also there without a checkout.
"""

import sys

from rcnn_odom.training.entry import evaluate as evaluate
from rcnn_odom.training.entry import run_evaluate

if __name__ == "__main__":
    sys.exit(run_evaluate(sys.argv[1:]))
