"""Odometry from a 2D laser: scan matching without training, and trained recurrent convolutional networks."""

__version__ = "0.1.0"
