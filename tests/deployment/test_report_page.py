"""``report.html`` of a run: what it says, that it needs nothing else, and what a terminal shows meanwhile."""

import base64
import io
import json
import logging
import re
import sys
from contextlib import contextmanager, redirect_stderr
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.image import imread

from conftest import ROOT
from data.make_kitti import make_kitti
from rcnn_odom.cli import main
from rcnn_odom.deployment.causes import CAUSES, explain
from rcnn_odom.deployment.odometer import Odometer
from rcnn_odom.deployment.report_page import write_page
from rcnn_odom.deployment.report_pictures import MapScan, as_png, make_pictures
from rcnn_odom.deployment.run import run
from rcnn_odom.deployment.three_lines import three_lines
from rcnn_odom.deployment.timeline import Timeline
from rcnn_odom.evaluation.figures import map_figure
from rcnn_odom.geometry import Step
from rcnn_odom.models.contract import Registered
from rcnn_odom.recordings.scan import Scan
from rcnn_odom.recordings.stream import ScanStream

ANGLES = np.deg2rad(np.arange(-90.0, 91.0))
KNOWN, UNKNOWN = np.diag([0.02, 0.01, 0.003]) ** 2, np.full((3, 3), np.nan)
VOID = {"meta", "img", "br"}


class Tracker:
    """A stand-in for a model: 0.1 m and 0.02 radians a scan, and notes on the scans of these numbers."""

    period = float("nan")

    def __init__(self, notes=None, covariance=KNOWN):
        self.notes, self.step = notes or {}, Step(0.1, 0.0, 0.02, covariance)
        self.reset()

    def reset(self):
        self.has_seen, self._number = False, 0

    def begin(self, scan):
        self.has_seen, self._number = True, self._number + 1
        return self.notes.get(self._number, ())

    def register(self, scan, periods=1, seconds=None):
        self._number += 1
        return Registered(self.step, self.notes.get(self._number, ()))

    def returns(self):
        return np.stack([5 * np.cos(ANGLES), 5 * np.sin(ANGLES)], axis=1)


class Page(HTMLParser):
    """A page as its parts; fails where it is not well-formed."""

    def __init__(self, path):
        super().__init__()
        self.open, self.images, self.links, self.headings, self.rows = [], [], [], [], []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()
        assert not self.open, self.open

    def handle_starttag(self, tag, attributes):
        known = dict(attributes)
        self.links += [value for name, value in attributes if name in ("src", "href", "srcset", "data")]
        if tag == "img":
            self.images.append(known)
        if tag == "tr":
            self.rows.append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("h1", "h2"):
            self.headings.append(data)
        if "tr" in self.open:
            self.rows[-1] += data + " "


def stream_of(count, stamps=True, name="robot.bag"):
    rows = (Scan(np.full(181, 5.0), ANGLES, stamp=0.1 * n if stamps else None) for n in range(count))
    return ScanStream(name, rows)


def page_of(folder, tracker, stream, settings=None):
    summary = run(Odometer(tracker), stream, "toy", folder, settings=settings)
    return Page(folder / "report.html"), summary


def test_a_stream_whose_first_scans_have_no_stamp_has_its_page(tmp_path):
    rows = (Scan(np.full(181, 5.0), ANGLES, stamp=100 + 0.1 * n if n > 2 else None) for n in range(40))
    page, summary = page_of(tmp_path / "out", Tracker({}), ScanStream("late.jsonl", rows))
    assert summary["recording_s"] == pytest.approx(3.6)
    assert len(page.links) >= 4


@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    """A run of 12 seconds with two kinds of trouble, its page and its summary."""
    notes = dict.fromkeys(range(31, 43), ("no returns: nothing",)) | {
        80: ("poor match: people", "odd: <b>it</b>")
    }
    settings = {"--deskew": "on", "--topic": "/a&b"}
    return page_of(tmp_path_factory.mktemp("toy") / "out", Tracker(notes), stream_of(120), settings)


def test_the_page_needs_nothing_else(toy):
    page, _ = toy
    assert page.links
    assert all(link.startswith("data:image/png;base64,") for link in page.links)
    assert not re.search(r"https?:|@import|url\(|<script|<link", page.source)
    assert len(page.source) < 1_000_000
    assert 'name="viewport" content="width=device-width' in page.source
    assert "@media print" in page.source


def test_the_page_has_all_parts_in_order(toy):
    page, _ = toy
    assert page.headings == [
        "Odometry of robot.bag by toy",
        "Map and path",
        "Speed",
        "Turn rate",
        "Deviation of each step",
        "Accumulated deviation",
        "Marked stretches",
        "Settings",
    ]
    for image in page.images:
        content = base64.b64decode(image["src"].partition(",")[2])
        assert min(imread(io.BytesIO(content)).shape[:2]) > 300
        assert len(image["alt"]) > 20
    assert "speed over time: 0.99" in page.images[1]["alt"].lower()
    # 0.02 radians each tenth of a second.
    assert "11.5 to 11.5 degrees/s" in page.images[2]["alt"]
    assert "x 0.02 to 0.02 m, y 0.01 to 0.01 m, heading 0.172 to 0.172 degrees" in page.images[3]["alt"]


def test_the_page_says_what_the_terminal_says(toy):
    page, summary = toy
    for line in three_lines(summary).values():
        assert line in page.source
    assert summary["recording_s"] == pytest.approx(11.9)
    assert summary["speed"]["mean_m_s"] == pytest.approx(1.0)
    assert summary["speed"]["top_m_s"] == pytest.approx(1.0, rel=0.01)


def test_marked_stretches_are_listed_with_what_to_do(toy):
    page, summary = toy
    rows = [" ".join(row.split()) for row in page.rows]
    first = rows.index("3.0 s (scan 31) 4.1 s (scan 42) 12")
    assert rows[first - 1].startswith("no returns , 12 scans: the scan had no returns")
    assert "What to do: check whether something covered the laser" in rows[first - 1]
    assert "7.9 s (scan 80) 7.9 s (scan 80) 1" in rows
    assert "odd , 1 scan: <b>it</b>. What to do: see the documentation of the model." in rows
    assert summary["marked"]["no returns"] == [
        {
            "from_s": pytest.approx(3.0),
            "to_s": pytest.approx(4.1),
            "first_scan": 31,
            "last_scan": 42,
            "scans": 12,
        }
    ]


def test_the_settings_are_listed(toy):
    page, _ = toy
    rows = [" ".join(row.split()) for row in page.rows]
    assert "--deskew on" in rows
    assert "--topic /a&b" in rows
    assert "laser 181 beams from -90 to 90 degrees, one every 1" in rows
    assert "time between scans 100 ms on average" in rows
    assert any(re.fullmatch(r"rcnn-odom \d.*", row) for row in rows)


def test_names_that_are_markup_or_no_text(tmp_path):
    page, _ = page_of(tmp_path / "out", Tracker(), stream_of(3, name="a<b>&$x$\udcff.bag"))
    assert page.headings[0] == "Odometry of a<b>&$x$?.bag by toy"


def test_without_a_clock_the_axis_counts_scans(tmp_path):
    page, summary = page_of(tmp_path / "out", Tracker({5: ("gap: 3",)}), stream_of(9, stamps=False))
    assert "Speed" not in page.headings
    assert "Numbers along the path: number of the scan" in page.source
    assert "scan 5 scan 5 1" in [" ".join(row.split()) for row in page.rows]
    assert (summary["recording_s"], summary["speed"]) == (None, None)


def test_a_model_that_knows_no_covariance(tmp_path):
    page, _ = page_of(tmp_path / "out", Tracker(covariance=UNKNOWN), stream_of(4))
    assert "The model does not estimate the deviation of x." in page.source
    assert "x unknown, y unknown, heading unknown" in page.images[3]["alt"]


def test_a_run_of_one_scan(tmp_path):
    page, summary = page_of(tmp_path / "out", Tracker(), stream_of(1))
    assert (summary["scans"], summary["speed"]) == (1, None)
    assert "None: no scan was marked." in page.source


def test_without_matplotlib_words_and_tables_remain(monkeypatch, tmp_path, caplog):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    page, summary = page_of(tmp_path / "out", Tracker({3: ("held: so",)}), stream_of(5))
    assert page.images == []
    assert "they need matplotlib (pip install matplotlib)" in page.source
    assert page.headings == ["Odometry of robot.bag by toy", "Marked stretches", "Settings"]
    assert three_lines(summary)["path"] in page.source
    assert [record.getMessage() for record in caplog.records] == [
        "report.html has no pictures: they need matplotlib (pip install matplotlib)"
    ]


@pytest.mark.slow
def test_a_long_drive_stays_small(tmp_path):
    """13,000 scans that see something else each time: the page is not made of them all."""
    rng, timeline, seen = np.random.default_rng(0), Timeline(), []
    odometer = Odometer(Tracker({n: (f"kind {n % 9}: x",) for n in range(1, 13_000, 7)}))
    scan = np.full(181, 5.0)
    for number in range(13_000):
        pose = odometer.step(Scan(scan, ANGLES, stamp=0.1 * number))
        timeline.add(pose)
        if number % 8 == 0:
            points = rng.uniform(-60, 60, (181, 2)).astype(np.float32)
            seen.append(MapScan((pose.x, pose.y, pose.heading), points, number, 0.1 * number))
    end = {"x": pose.x, "y": pose.y, "heading": pose.heading}
    summary = {"input": "long", "model": "toy", "laser_pose": None, "scans": 13_000, "path_m": 1300.0}
    summary |= {"latency": {"median_ms": 1.0}, "recording_s": 1300.0, "end": end, "skipped": {}}
    summary |= {"speed": {"mean_m_s": 1.0, "top_m_s": 1.0}, "marked": timeline.marks.as_dict()}
    write_page(tmp_path / "report.html", summary, timeline, seen, {})
    assert len(timeline.curves.column("x")) <= 2400
    assert len(Page(tmp_path / "report.html").source) < 1_000_000


def test_the_map_colours_the_path_by_time():
    """The line's pieces have the times of the poses they lead to, from the first time to the last."""
    poses = np.array([[0.0, 0, 0], [1, 0, 0], [1, 2, 0]])
    figure = map_figure(poses, [np.zeros((1, 2), np.float32)] * 3, np.array([0.0, 10, 40]), "seconds")
    (pieces,) = figure.axes[0].collections
    np.testing.assert_allclose(pieces.get_array(), [10, 40])
    assert pieces.get_clim() == (0, 40)
    np.testing.assert_allclose(pieces.get_segments(), [[[0, 0], [0, 1]], [[0, 1], [-2, 1]]])
    assert {text.get_text() for text in figure.legends[0].get_texts()} == {
        "start",
        "end",
        "returns of the laser",
    }


def test_stretches_are_shaded_where_they_are(toy, monkeypatch):
    timeline = Timeline()
    odometer = Odometer(Tracker({21: ("held: x",), 22: ("held: x",), 60: ("gap: x",)}))
    for number in range(100):
        timeline.add(odometer.step(Scan(np.full(181, 5.0), ANGLES, stamp=0.1 * number)))
    for picture in [each for each in make_pictures(timeline, [], "") if each.heading != "Map and path"]:
        figure = picture.draw()
        for axes in figure.axes:
            spans = {
                patch.get_label(): (patch.get_x(), patch.get_x() + patch.get_width())
                for patch in axes.patches
            }
            assert spans["held"] == pytest.approx((2.0, 2.1))
            low, high = spans["gap"]
            assert (low + high) / 2 == pytest.approx(5.9)
            assert high > low, "a single scan is seen"
        assert {"held", "gap"} <= {text.get_text() for text in figure.legends[0].get_texts()}
        assert as_png(figure).startswith(b"\x89PNG")


def kinds_in(page, start, end):
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    table = text[text.index(start) : text.index(end)]
    first_cells = re.findall(r"^\| (.+?) \|", table, re.MULTILINE)
    return {kind for cell in first_cells for kind in re.findall(r"\*([a-z ]+)\*", cell)}


def test_every_kind_of_trouble_has_an_advice():
    kinds = kinds_in("matcher.md", "## What a pose suffers from", "## Covariance")
    kinds |= kinds_in("deployment.md", "## In your own program", "## How far off a step may be")
    assert len(kinds) > 15
    assert kinds <= CAUSES.keys()
    for cause in CAUSES:
        assert all(explain(cause))
    assert explain("new one", "gap: x; new one: it was odd").happened == "it was odd"


# --- what a terminal shows meanwhile -------------------------------------------------------------


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def toys(monkeypatch):
    """The command with a stand-in for the matcher, and without pages."""
    monkeypatch.setattr("rcnn_odom.models.matcher.MatcherTracker", lambda **options: Tracker())
    monkeypatch.setattr("rcnn_odom.deployment.run.write_page", lambda *arguments: None)


@contextmanager
def terminal():
    """Standard error that is a terminal, to which is logged; what it shows."""
    shown, root = Terminal(), logging.getLogger()
    with redirect_stderr(shown):
        handler = logging.StreamHandler()
        root.addHandler(handler)
        yield shown
        assert root.handlers[-1] is handler
        root.removeHandler(handler)


def test_the_bar_knows_how_many_scans_there_are(toys, tmp_path):
    make_kitti(tmp_path, ["05"], frames=12)
    drive = str(tmp_path / "sequences" / "05")
    with terminal() as shown:
        assert main(["run", drive, "--out", str(tmp_path / "out")]) == 0
        assert main(["run", f"{drive}[::5]", "--out", str(tmp_path / "out5")]) == 0
    assert re.search(r"05: 100%.* 12/12 ", shown.getvalue())
    assert "3/3 " in shown.getvalue()


def test_what_is_logged_stands_on_a_line_of_its_own(toys, tmp_path):
    row = {"ranges": [5.0] * 181, "angle_min": -1.57, "angle_increment": 0.01745}
    lines = [json.dumps(row | {"stamp": 0.1 * n}) for n in range(20)]
    (tmp_path / "scans.jsonl").write_text("\n".join([*lines[:10], "broken", *lines[10:]]))
    with terminal() as shown:
        assert main(["run", str(tmp_path / "scans.jsonl"), "--out", str(tmp_path / "out")]) == 0
    [line] = [line for line in shown.getvalue().split("\n") if "no scan" in line]
    # What stood there is wiped out before.
    assert line.rpartition("\r")[2].startswith("scans.jsonl:11: no scan")
    assert "scans.jsonl: 20scan [" in shown.getvalue()


def test_a_live_laser_has_no_bar(toys, tmp_path):
    with terminal() as shown:
        run(Odometer(Tracker()), stream_of(5), "toy", tmp_path / "out", on_pose=lambda pose: None)
    assert shown.getvalue() == ""
