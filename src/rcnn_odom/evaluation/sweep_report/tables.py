"""Tables, and text from files, as Markdown and as plain text."""

import re
from collections.abc import Sequence

from rcnn_odom.evaluation.scores import aligned

Row = Sequence[str]
DASH = "-"

_PLAIN = re.compile(r"[\w.,=:/+@%()\[\] -]+")
_SPECIAL = re.compile(r"[&<>\\`*\[\]|~$]|(?<![^\W_])_|_(?![^\W_])")
"""What Markdown or HTML would take for markup; an underscore within a word is none."""


def escape(text: object) -> str:
    """Any text so that Markdown and HTML show it as it is, on one line, also in a cell of a table."""
    line = " ".join(str(text).split())
    # An entity means the same to all readers, unlike a backslash before a character that needs none.
    return _SPECIAL.sub(lambda found: f"&#{ord(found[0])};", line)


def code(text: object) -> str:
    """A name or a command as code; escaped text where it holds what could end the code."""
    return f"`{text}`" if _PLAIN.fullmatch(str(text)) and str(text).strip() == str(text) else escape(text)


def markdown_table(header: Row, rows: Sequence[Row], words: int = 1, names: Row = ()) -> str:
    """A table in Markdown; the first ``words`` columns to the left, numbers after them to the right.

    Args:
        header: of the columns, plain text.
        rows: cells, plain text.
        words: how many columns hold words.
        names: headings of columns that hold names, which are shown as code.
    """
    show = [code if name in names else escape for name in header]
    body = [
        [DASH if text == DASH else tell(text) for tell, text in zip(show, row, strict=True)] for row in rows
    ]
    rule = ["---" if column < words else "---:" for column in range(len(header))]
    return "\n".join(f"| {' | '.join(line)} |" for line in [list(map(escape, header)), rule, *body])


def text_table(header: Row, rows: Sequence[Row]) -> str:
    """The same for a terminal."""
    return aligned([[" ".join(cell.split()) for cell in row] for row in (header, *rows)])


def number(value: float | None, digits: int = 2) -> str:
    """A number with so many decimals; a dash for None and nan."""
    return DASH if value is None or value != value else f"{value:.{digits}f}"


def spread(mean: float | None, sd: float | None, digits: int = 2) -> str:
    """Mean and standard deviation; the mean alone where there is no deviation."""
    return number(mean, digits) if sd is None else f"{number(mean, digits)} ± {number(sd, digits)}"


def duration(seconds: float | None) -> str:
    """A time for people."""
    if seconds is None or seconds != seconds:
        return DASH
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 1:
        return f"{rest} s"
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
