"""What is printed, on terminals that cannot show every letter."""

import io
import sys


def show_any_text() -> None:
    r"""Shows letters that the terminal's encoding lacks as ``\xfc``, where Python would raise."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
