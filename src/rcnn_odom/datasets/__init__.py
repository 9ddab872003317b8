"""Recordings on disk: one file, one format; each gives the same `Sequence`."""
