"""The documents: links lead somewhere, and the settings that they print are those of the code."""

import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "src").rglob("deployment/shipped/*.md")),
]


def anchors(page: Path) -> set[str]:
    """Those that GitHub makes of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        path, _, anchor = link.partition("#")
        if re.match(r"https?:", path):
            continue
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_the_matchers_settings_are_those_of_its_page():
    page = (ROOT / "docs" / "matcher.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)\.([A-Z_]+)` \| ([\d.]+)( degrees)?", page, re.MULTILINE)
    assert len(rows) > 10
    for module, name, value, degrees in rows:
        found = getattr(import_module(f"rcnn_odom.matching.{module}"), name)
        assert (np.rad2deg(found) if degrees else found) == pytest.approx(float(value)), name


def test_every_note_of_the_matcher_is_explained():
    page = (ROOT / "docs" / "matcher.md").read_text(encoding="utf-8")
    table = page[page.index("## What a pose suffers from") : page.index("## Covariance")]
    source = (ROOT / "src" / "rcnn_odom" / "models" / "matcher.py").read_text(encoding="utf-8")
    notes = re.search(r"Notes are of these kinds:(.*?)Args:", source, re.DOTALL)
    kinds = set(re.findall(r"\*([a-z ]+)\*", notes[1]))
    assert len(kinds) > 5
    assert kinds <= set(re.findall(r"\*([a-z ]+)\*", table))
