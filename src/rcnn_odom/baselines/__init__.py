"""Estimators that are not trained networks, behind the same interface."""
