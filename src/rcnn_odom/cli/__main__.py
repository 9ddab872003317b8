"""Runs the command line by ``python -m rcnn_odom.cli``."""

import sys

from rcnn_odom.cli import main

sys.exit(main())
