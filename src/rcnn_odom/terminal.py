"""Printing on terminals that cannot show every character."""

import io
import sys


def show_any_text() -> None:
    r"""Prints characters that the terminal's encoding lacks as ``\xfc``; Python would raise an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
