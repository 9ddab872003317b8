"""Drift: a functional in numpy and a torchmetrics class that calls it."""
