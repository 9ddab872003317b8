"""Estimators, which convert scans into steps. Importing this package loads no large libraries."""
