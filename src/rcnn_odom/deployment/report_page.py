"""``report.html`` of a run: its result for people, on one page that needs no other file."""

import base64
import html
import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rcnn_odom.deployment.causes import explain
from rcnn_odom.deployment.report_pictures import MapScan, as_png, assign_colours, make_pictures
from rcnn_odom.deployment.three_lines import three_lines
from rcnn_odom.deployment.timeline import Timeline
from rcnn_odom.files import write_atomically

log = logging.getLogger(__name__)

Summary = Mapping[str, Any]
NO_PICTURES = "report.html has no pictures: they need matplotlib (pip install matplotlib)"
STYLE = """
:root { color-scheme: light dark; --ink: #1c1f23; --paper: #ffffff; --line: #d5d9de; --soft: #f4f6f8;
  --warn: #fff4d6; --edge: #d99a00; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e7ea; --paper: #16191d; --line: #3a4048; --soft: #20252b; --warn: #3a3014; }
}
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 46rem;
  margin: 1.5rem auto; padding: 0 1rem; overflow-wrap: anywhere; }
h1, h2 { line-height: 1.25; }
h2 { margin-top: 2.2rem; border-bottom: 1px solid var(--line); padding-bottom: 0.2rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: 0.5rem 1rem; background: var(--soft);
  border-radius: 4px; padding: 0.8rem 1rem; }
dt { font-weight: 600; }
dd { margin: 0; }
figure { margin: 1rem 0; break-inside: avoid; }
figcaption { font-size: 0.9rem; }
img { width: 100%; height: auto; background: #ffffff; border-radius: 4px; }
table { border-collapse: collapse; width: 100%; font-size: 0.92rem; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid var(--line); padding: 0.3rem 0.6rem; vertical-align: top;
  text-align: left; }
th.cause { background: var(--soft); font-weight: normal; padding-top: 0.7rem; }
tbody, tr { break-inside: avoid; }
.key { display: inline-block; width: 0.8em; height: 0.8em; margin-right: 0.4em; border-radius: 2px;
  print-color-adjust: exact; -webkit-print-color-adjust: exact; }
.warning { background: var(--warn); border-left: 5px solid var(--edge); padding: 0.4rem 1rem; }
@media print {
  :root { --ink: #000000; --paper: #ffffff; --line: #bbbbbb; --soft: #ffffff; --warn: #ffffff; }
  body { font-size: 11pt; max-width: none; margin: 0; }
  h2 { break-after: avoid; margin-top: 1rem; }
  figure img { max-height: 13cm; object-fit: contain; object-position: left; }
}
"""


def write_page(
    path: Path,
    summary: Summary,
    timeline: Timeline,
    map_scans: Sequence[MapScan],
    settings: Mapping[str, str],
) -> None:
    """Writes the page completely or not at all.

    Args:
        path: of the file.
        summary: of the run.
        timeline: of the run.
        map_scans: some of its scans, in order, for the map.
        settings: options of the run and properties of the recording, by name, as text.

    Raises:
        OSError: the file cannot be written.
    """
    title = f"Odometry of {summary['input']} by {summary['model']}"
    parts = [f"<h1>{html.escape(title)}</h1>", _summary_list(summary)]
    if stopped := summary.get("stopped"):
        parts.append(_warning(f"The run ended before the recording did: {stopped}"))
    parts += _pictures(summary, timeline, map_scans)
    parts += [_stretch_table(summary, timeline.marks.first_notes), _settings_table(settings)]
    page = _as_page(title, "\n".join(parts))
    write_atomically(path, page.encode("utf-8", "replace"))  # file names may hold invalid text


def _as_page(title: str, body: str) -> str:
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="generator" content="rcnn-odom run">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n{body}\n"
        "</body>\n</html>\n"
    )


def _summary_list(summary: Summary) -> str:
    rows = [f"<dt>{name}</dt><dd>{html.escape(line)}</dd>" for name, line in three_lines(summary).items()]
    return "\n".join(["<dl>", *rows, "</dl>"])


def _warning(text: str) -> str:
    return f'<p class="warning">{html.escape(text)}</p>'


def _pictures(summary: Summary, timeline: Timeline, map_scans: Sequence[MapScan]) -> Iterator[str]:
    """All pictures, or one line if they cannot be drawn."""
    try:
        import matplotlib  # noqa: F401 - may not be installed on a robot
    except ImportError:
        log.warning(NO_PICTURES)
        yield _warning(NO_PICTURES)
        return
    for picture in make_pictures(timeline, map_scans, three_lines(summary)["path"]):
        data = base64.b64encode(as_png(picture.draw())).decode()
        yield (
            f"<h2>{html.escape(picture.heading)}</h2>\n<figure>\n"
            f'<img src="data:image/png;base64,{data}" alt="{html.escape(picture.alt)}">\n'
            f"<figcaption>{html.escape(picture.caption)}</figcaption>\n</figure>"
        )


def _stretch_table(summary: Summary, first_notes: Mapping[str, str]) -> str:
    """A table of all marked stretches by cause, with advice.

    Args:
        summary: of the run.
        first_notes: by cause, the notes of the first pose that is marked for it.
    """
    marked = summary["marked"]
    if not marked:
        return "<h2>Marked stretches</h2>\n<p>None: no scan was marked.</p>"
    bodies = [
        _cause_rows(cause, marked[cause], first_notes[cause], colour)
        for cause, colour in assign_colours(list(marked)).items()
    ]
    about = (
        "Times are seconds of the recording; scans are numbered from 1, as the lines of steps.jsonl. Marked "
        "scans that are close to each other form one stretch."
    )
    head = "<thead><tr><th>from</th><th>to</th><th>scans</th></tr></thead>"
    return "\n".join(["<h2>Marked stretches</h2>", f"<p>{about}</p>", "<table>", head, *bodies, "</table>"])


def _cause_rows(cause: str, stretches: Sequence[Mapping[str, Any]], notes: str, colour: str) -> str:
    """One cause with its explanation and advice, and a row for each of its stretches."""
    happened, advice = explain(cause, notes)
    count = sum(one["scans"] for one in stretches)
    rows = [
        f"<tr><td>{_format_time(one['from_s'], one['first_scan'])}</td>"
        f"<td>{_format_time(one['to_s'], one['last_scan'])}</td><td>{one['scans']}</td></tr>"
        for one in stretches
    ]
    head = (
        f'<tr><th class="cause" colspan="3"><span class="key" style="background:{colour}"></span>'
        f"<b>{html.escape(cause)}</b>, {count} scan{'s' if count != 1 else ''}: {html.escape(happened)}."
        f"<br><b>What to do:</b> {html.escape(advice)}.</th></tr>"
    )
    return "\n".join(["<tbody>", head, *rows, "</tbody>"])


def _format_time(seconds: float | None, scan: int) -> str:
    return f"scan {scan}" if seconds is None else f"{seconds:.1f} s (scan {scan})"


def _settings_table(settings: Mapping[str, str]) -> str:
    rows = [
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(value)}</td></tr>"
        for name, value in settings.items()
    ]
    return "\n".join(["<h2>Settings</h2>", "<table>", *rows, "</table>"])
