"""Turns estimated steps into scores, figures and reports."""
