"""Estimators: scans in, steps out. Importing the package loads nothing heavy."""
