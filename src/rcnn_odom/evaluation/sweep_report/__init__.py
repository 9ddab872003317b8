"""Compares the runs of a sweep: a table of all runs, and a report with the differences between settings."""

from rcnn_odom.evaluation.sweep_report.runs_table import load_runs

__all__ = ["load_runs"]
