"""Training and evaluation runs: the only package that uses Lightning and Hydra."""
