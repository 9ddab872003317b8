"""Compares odometry methods on sets of recordings: ``python evaluate.py -m +sweeps=peers``."""
