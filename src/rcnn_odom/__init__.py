"""Odometry from a 2D laser by a trained recurrent convolutional network."""

__version__ = "0.1.0"
