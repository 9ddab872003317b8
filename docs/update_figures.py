"""Measures the tables of the pages anew: ``make figures``, or ``python docs/update_figures.py [PAGE ...]``.

HTML comments round a table in a page name the commands of bash that print it::

    <!-- figures: python -m rcnn_odom.training.bench -->
    ...
    <!-- end of figures -->

The commands may take several lines; they run in the project's folder. What they print takes the place of what
stands between the comments: Markdown as it is, other text as a block of code. ``figures, table 2:`` takes the
second table alone. Below each table a line says at which commit, on which processor, when and in what time it
was measured. Where a command fails, its page stays as it was.
"""

import argparse
import os
import re
import subprocess
import sys
import textwrap
import time
from dataclasses import dataclass
from datetime import date
from itertools import groupby
from pathlib import Path

from rcnn_odom.errors import InputError
from rcnn_odom.files import write_atomically
from rcnn_odom.training.provenance import find_commit, read_processor_name

ROOT = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- figures", "<!-- end of figures -->"
BLOCK = re.compile(
    rf"(?P<begin>{BEGIN}(?:, table (?P<number>\d+))?:(?P<commands>.*?)-->)(?P<content>.*?){END}", re.DOTALL
)
TAKEN = re.compile(r"^Commit .*, in ([^,]+)\.$", re.MULTILINE)
"""The time that a measurement took, in the line below a table."""
WIDTH = 119
"""Most characters of a line of a page, tables excepted."""


@dataclass(frozen=True)
class Measured:
    """What commands printed, and the line that says where it comes from."""

    output: str
    source: str


def find_blocks(text: str) -> list[re.Match[str]]:
    """The blocks of a page, with the groups of ``BLOCK``.

    Raises:
        InputError: a comment that begins a block has none that ends it, or the other way round.
    """
    blocks = list(BLOCK.finditer(text))
    nested = any(BEGIN in block["content"] for block in blocks)
    if nested or not text.count(BEGIN) == text.count(END) == len(blocks):
        raise InputError(f"each '{BEGIN}: COMMANDS -->' needs its '{END}'")
    return blocks


def commands_of(block: re.Match[str]) -> str:
    """The commands of a block, without white space around them."""
    return block["commands"].strip()


def update_page(page: Path, measured: dict[str, Measured]) -> None:
    """Runs the commands of a page and puts what they print into it.

    Args:
        page: of Markdown.
        measured: what commands have printed already, which are not run again; gets what this page's print.

    Raises:
        InputError: see its message; the page is as it was.
    """
    for block in find_blocks(page.read_text("utf-8")):
        if (commands := commands_of(block)) not in measured:
            print_commands(page, block)
            measured[commands] = measure(commands)
    text = page.read_text("utf-8")  # again, since somebody may have changed the page in the meantime
    find_blocks(text)
    write_atomically(page, BLOCK.sub(lambda block: renewed(block, measured), text))


def renewed(block: re.Match[str], measured: dict[str, Measured]) -> str:
    """A block with what its commands have printed; as it is where they were not run."""
    if (found := measured.get(commands_of(block))) is None:
        return block[0]
    number = int(block["number"]) if block["number"] else None
    return f"{block['begin']}\n\n{as_markdown(found, number)}\n\n{END}"


def measure(commands: str) -> Measured:
    """Runs commands.

    Raises:
        InputError: one of them failed, or the commit cannot be told.
    """
    if (commit := find_commit()) is None:
        raise InputError(f"{ROOT}: git does not tell its commit; run this in a checkout")
    start = time.monotonic()
    output = run(commands)
    minutes, seconds = divmod(round(time.monotonic() - start), 60)
    taken = f"{minutes} min {seconds} s" if minutes else f"{seconds} s"
    return Measured(output, f"Commit {commit}, {read_processor_name()}, {date.today()}, in {taken}.")


def run(commands: str) -> str:
    """What commands of bash print on standard output; the first one that fails ends them.

    Raises:
        InputError: one of them failed.
    """
    binaries = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", commands],
        cwd=ROOT,
        env=os.environ | {"PATH": binaries},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        printed = [*done.stdout.splitlines(), *done.stderr.splitlines()]
        last = next(filter(str.strip, reversed(printed)), "no message").strip()
        raise InputError(f"the commands of a table failed with exit status {done.returncode}: {last}")
    return done.stdout


def as_markdown(measured: Measured, number: int | None) -> str:
    """What stands in a page of what was printed, with its source below each table.

    Args:
        measured: the output and its source.
        number: of the table that is taken alone, from 1; None: everything that was printed.

    Raises:
        InputError: nothing was printed, or not so many tables.
    """
    lines = measured.output.strip("\n").splitlines()
    if not lines:
        raise InputError("the commands of a table printed nothing")
    parts = [(kind, "\n".join(part)) for kind, part in groupby(lines, key=lambda line: line.startswith("|"))]
    tables = [text for is_table, text in parts if is_table]
    if number:
        if number > len(tables):
            raise InputError(
                f"table {number} of {len(tables)} is asked for, of those that the commands printed"
            )
        return f"{tables[number - 1]}\n\n{measured.source}"
    if not tables:
        return "\n".join(["```", *lines, "```", "", measured.source])
    shown = [f"{text}\n\n{measured.source}" if is_table else wrapped(text) for is_table, text in parts]
    return "\n\n".join(filter(None, shown))


def wrapped(text: str) -> str:
    """Text with its long lines broken, as those of a list."""
    lines = text.strip("\n").splitlines()
    return "\n".join(
        textwrap.fill(line, WIDTH, subsequent_indent="  ", break_on_hyphens=False) for line in lines
    )


def print_commands(page: Path, block: re.Match[str]) -> None:
    """Prints the commands of a block, its page, and how long they took when they were run last."""
    found = TAKEN.search(block["content"])
    taken = f"took {found[1]} the last time" if found else "not timed yet"
    print(f"{os.path.relpath(page)}, {taken}:\n{textwrap.indent(commands_of(block), '    ')}", flush=True)


def list_page(page: Path) -> None:
    """Prints the commands of a page, each once.

    Raises:
        InputError: see :func:`find_blocks`.
    """
    listed = set[str]()
    for block in find_blocks(page.read_text("utf-8")):
        if (commands := commands_of(block)) not in listed:
            print_commands(page, block)
        listed.add(commands)


def main(arguments: list[str] | None = None) -> int:
    """Measures the tables of all pages or of some; the exit status, 1 where one could not be measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("pages", type=Path, nargs="*", metavar="PAGE", help="all pages of docs/ unless given")
    parser.add_argument("--list", action="store_true", help="print the commands and their times, run nothing")
    given = parser.parse_args(arguments)
    status, measured = 0, dict[str, Measured]()
    for page in given.pages or sorted((ROOT / "docs").glob("*.md")):
        try:
            list_page(page) if given.list else update_page(page, measured)
        except (InputError, OSError) as error:
            print(f"{page} is left as it was: {error}", file=sys.stderr)
            status = 1
        except KeyboardInterrupt:
            return 130
    return status


if __name__ == "__main__":
    sys.exit(main())
