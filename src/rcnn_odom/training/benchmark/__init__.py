"""Every method on every set of recordings, beside each other: ``python evaluate.py -m +sweeps=peers``."""
