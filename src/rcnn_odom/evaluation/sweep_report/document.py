"""A report as files, Markdown with its figures beside it and HTML in one, and tables and text in them."""

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
"""Written into every file of a report, by which it is known as one."""

Row = Sequence[str]
DASH = "-"

_PLAIN = re.compile(r"[\w.,=:/+@%()\[\] -]+")
_SPECIAL = re.compile(r"[&<>\\`*\[\]|~$]|(?<![^\W_])_|_(?![^\W_])")
"""What Markdown or HTML would take for markup; an underscore within a word is none."""

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
    """Markdown of one of the report's figures."""
    return f"![{alt}]({FIGURES}/{name}.png)"


def write_report(directory: Path, title: str, text: str, figures: Mapping[str, bytes]) -> tuple[Path, Path]:
    """Writes ``report.md``, ``report.html`` and ``report_figures``, each file at once or not at all.

    Args:
        directory: the folder of the runs.
        title: plain text.
        text: Markdown.
        figures: PNG files by the names that :func:`image` was given.

    Returns:
        Paths of the Markdown and of the HTML.

    Raises:
        InputError: a file of one of these names was not written by this command.
    """
    contents = {f"{FIGURES}/{name}.png": content for name, content in figures.items()}
    contents[MARKDOWN] = f"<!-- {MARK} -->\n{text}\n".encode()
    contents[HTML] = to_html(title, text, figures).encode()
    for name in contents:
        _need_own(directory / name)
    for name, content in contents.items():
        write_atomically(directory / name, content)
    return directory / MARKDOWN, directory / HTML


def to_html(title: str, text: str, figures: Mapping[str, bytes]) -> str:
    """The report as one page that needs no other file."""
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


def _need_own(path: Path) -> None:
    """A file of this name may be replaced if it is from an earlier report."""
    if path.exists() and MARK.encode() not in path.read_bytes()[:1000]:
        raise InputError(f"{path}: was not written by rcnn-odom report; move it away, then try again")


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
        [DASH if text == DASH else render(text) for render, text in zip(show, row, strict=True)]
        for row in rows
    ]
    rule = ["---" if column < words else "---:" for column in range(len(header))]
    return "\n".join(f"| {' | '.join(line)} |" for line in [list(map(escape, header)), rule, *body])


def text_table(header: Row, rows: Sequence[Row]) -> str:
    """The same for a terminal."""
    return aligned([[" ".join(cell.split()) for cell in row] for row in (header, *rows)])


def number(value: float | None, digits: int = 2) -> str:
    """A number with so many decimals; a dash for None and nan."""
    return DASH if value is None or value != value else f"{value:.{digits}f}"


def duration(seconds: float | None) -> str:
    """A time for people."""
    if seconds is None or seconds != seconds:
        return DASH
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 1:
        return f"{rest} s"
    return f"{minutes} min {rest:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
