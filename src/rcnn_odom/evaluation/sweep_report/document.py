"""Writes a report as Markdown with separate figures and as one HTML file; formats its tables and texts."""

import base64
import html
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.scores import aligned
from rcnn_odom.files import write_atomically

MARKDOWN, HTML, FIGURES = "report.md", "report.html", "report_figures"
MARK = "rcnn-odom report"
"""Text in every file of a report, by which a later report recognises the file and may overwrite it."""

Row = Sequence[str]
DASH = "-"

_CODE_TEXT = re.compile(r"[\w.,=:/+@%()\[\] -]+")
_MARKUP = re.compile(r"[&<>\\`*\[\]|~$]|(?<![^\W_])_|_(?![^\W_])")
"""Characters that Markdown or HTML read as markup; an underscore within a word is not one of them."""

STYLE = """
:root { color-scheme: light dark; --ink: #1c1f23; --paper: #ffffff; --line: #d5d9de; --soft: #f4f6f8;
  --warn: #fff4d6; --edge: #d99a00; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e7ea; --paper: #16191d; --line: #3a4048; --soft: #20252b; --warn: #3a3014; }
}
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 72rem;
  margin: 2rem auto; padding: 0 1.2rem; }
h1, h2 { line-height: 1.25; overflow-wrap: anywhere; }
h2 { margin-top: 2.4rem; border-bottom: 1px solid var(--line); padding-bottom: 0.2rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.92rem; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid var(--line); padding: 0.3rem 0.7rem; vertical-align: top; }
td { white-space: nowrap; }
th { background: var(--soft); text-align: left; vertical-align: bottom; }
blockquote { background: var(--warn); border-left: 5px solid var(--edge); margin: 1.2rem 0;
  padding: 0.4rem 1rem; overflow-wrap: anywhere; }
code { background: var(--soft); padding: 0.1em 0.3em; border-radius: 3px; font-size: 0.9em; }
pre { background: var(--soft); padding: 0.7rem 1rem; overflow-x: auto; border-radius: 4px; }
pre code { padding: 0; }
img { max-width: 100%; height: auto; background: #ffffff; border-radius: 4px; }
"""


def image(name: str, alt: str) -> str:
    """Markdown that shows one of the report's figures."""
    return f"![{alt}]({FIGURES}/{name}.png)"


def write_report(directory: Path, title: str, text: str, figures: Mapping[str, bytes]) -> tuple[Path, Path]:
    """Writes ``report.md``, ``report.html`` and ``report_figures``, each file atomically.

    Args:
        directory: the folder of the runs.
        title: title of the HTML page, plain text.
        text: the report as Markdown.
        figures: contents of the PNG files by the names that :func:`image` got.

    Returns:
        Paths of the Markdown file and of the HTML file.

    Raises:
        InputError: a file with one of these names exists and was not written by this command.
    """
    contents = {f"{FIGURES}/{name}.png": content for name, content in figures.items()}
    contents[MARKDOWN] = f"<!-- {MARK} -->\n{text}\n".encode()
    contents[HTML] = to_html(title, text, figures).encode()
    for name in contents:
        _check_replaceable(directory / name)
    for name, content in contents.items():
        write_atomically(directory / name, content)
    return directory / MARKDOWN, directory / HTML


def to_html(title: str, text: str, figures: Mapping[str, bytes]) -> str:
    """Converts the report to a single HTML page that contains its figures."""
    from markdown import markdown

    body = markdown(text, extensions=["tables", "sane_lists"])
    body = body.replace("<table>", '<div class="wide"><table>').replace("</table>", "</table></div>")
    for name, content in figures.items():
        data = base64.b64encode(content).decode()
        body = body.replace(f'src="{FIGURES}/{name}.png"', f'src="data:image/png;base64,{data}"')
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="generator" content="{MARK}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _check_replaceable(path: Path) -> None:
    """Checks that a file does not exist or belongs to an earlier report, so that it may be replaced.

    Raises:
        InputError: it is another file.
    """
    if path.exists() and MARK.encode() not in path.read_bytes()[:1000]:
        raise InputError(f"{path}: was not written by rcnn-odom report; move it away and try again")


def escape(text: object) -> str:
    """Escapes a text so that Markdown and HTML show it unchanged, on one line, also in a table cell.

    Example:
        >>> escape("a_b *c*")
        'a_b &#42;c&#42;'
    """
    line = " ".join(str(text).split())
    # All Markdown readers agree on entities, but not on a backslash before a character that needs none.
    return _MARKUP.sub(lambda found: f"&#{ord(found[0])};", line)


def code(text: object) -> str:
    """Formats a name or a command as code; escaped text if a character could end the code.

    Example:
        >>> code("model.beta=1"), code("a`b")
        ('`model.beta=1`', 'a&#96;b')
    """
    return f"`{text}`" if _CODE_TEXT.fullmatch(str(text)) and str(text).strip() == str(text) else escape(text)


def markdown_table(header: Row, rows: Sequence[Row], words: int = 1, names: Row = ()) -> str:
    """Formats a table in Markdown: columns of words to the left, columns of numbers to the right.

    Args:
        header: headings of the columns, plain text.
        rows: cells of each row, plain text.
        words: number of columns with words; they come first.
        names: headings of the columns with names, which are shown as code.
    """
    show = [code if name in names else escape for name in header]
    body = [
        [DASH if text == DASH else render(text) for render, text in zip(show, row, strict=True)]
        for row in rows
    ]
    rule = ["---" if column < words else "---:" for column in range(len(header))]
    return "\n".join(f"| {' | '.join(line)} |" for line in [list(map(escape, header)), rule, *body])


def text_table(header: Row, rows: Sequence[Row]) -> str:
    """Formats a table for a terminal."""
    return aligned([[" ".join(cell.split()) for cell in row] for row in (header, *rows)])


def number(value: float | None, digits: int = 2) -> str:
    """Formats a number with ``digits`` decimals; a dash for None and nan.

    Example:
        >>> number(0.1234), number(None)
        ('0.12', '-')
    """
    return DASH if value is None or value != value else f"{value:.{digits}f}"


def duration(seconds: float | None) -> str:
    """Formats a time in seconds, minutes or hours; a dash for None and nan.

    Example:
        >>> duration(3725)
        '1 h 02 min'
    """
    if seconds is None or seconds != seconds:
        return DASH
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 1:
        return f"{rest} s"
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
