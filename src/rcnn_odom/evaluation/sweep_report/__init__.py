"""What a sweep's runs say together: a table of them all, and a report that says what differs."""

from rcnn_odom.evaluation.sweep_report.runs_table import load_runs

__all__ = ["load_runs"]
