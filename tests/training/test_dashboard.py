"""What TensorBoard shows of a sweep: its event files, its server's answers, its pages in a real browser."""

import json
import re
import shutil
import subprocess
import sys
import time
from urllib.request import Request, urlopen

import pytest
import yaml
from selenium import webdriver
from selenium.common.exceptions import JavascriptException
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar.layout_pb2 import Layout
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from conftest import ROOT, SMALL
from data.make_kitti import make_kitti
from train import train

KERNELS = [3, 5]
TEST_DRIFT = "Best checkpoint: drift/test drift in %, all drives"
VALIDATION_DRIFT = "Best checkpoint: drift/validation drift in %, all drives"
PATIENCE = 60  # seconds until a page must have come


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    root = tmp_path_factory.mktemp("kitti")
    make_kitti(root, ["00", "10", "05"], frames=40)
    return [
        "data=kitti",
        f"data.root={root}",
        "data.train=['00']",
        "data.test=['05']",
        "data.lengths=[10,20]",
    ]


@pytest.fixture(scope="module")
def sweep(kitti, tmp_path_factory):
    """Folder of a multirun with one job for each width of the kernels."""
    folder = tmp_path_factory.mktemp("outputs")
    swept = f"model.kernel_size={','.join(map(str, KERNELS))}"
    options = ["model=cnn_reg", swept, *SMALL, *kitti, f"outputs={folder}", f"hydra.sweep.dir={folder}/sweep"]
    command = [sys.executable, str(ROOT / "train.py"), "-m", *options]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "sweep"


@pytest.fixture(scope="module")
def scores(sweep):
    """``metrics.json`` of each run by the width of its kernels."""
    found = {}
    for path in sweep.glob("*/config.yaml"):
        kernel = yaml.safe_load(path.read_text())["model"]["kernel_size"]
        found[kernel] = json.loads(path.with_name("metrics.json").read_text())
    assert sorted(found) == KERNELS
    return found


# --- event files ---------------------------------------------------------------------------------


def events_of(run):
    events = EventAccumulator(str(run / "tensorboard"), {"tensors": 0})
    events.Reload()
    return events


def patterns_of(events):
    """Patterns of all charts, by group and chart."""
    (event,) = events.Tensors("custom_scalars__config__")
    layout = Layout.FromString(event.tensor_proto.string_val[0])
    return {
        (group.title, chart.title): list(chart.multiline.tag)
        for group in layout.category
        for chart in group.chart
    }


def assert_every_chart_has_scalars(run):
    events = events_of(run)
    charts = patterns_of(events)
    assert len(charts) >= 4
    for chart, patterns in charts.items():
        for pattern in patterns:
            # As TensorBoard's plugin does it: from the beginning of the tag, not to its end.
            assert any(re.match(pattern, tag) for tag in events.Tags()["scalars"]), (chart, pattern)


@pytest.mark.slow
def test_every_chart_of_a_sweeps_runs_has_scalars(sweep):
    for run in sweep.glob("*/tensorboard"):
        assert_every_chart_has_scalars(run.parent)


def test_every_chart_of_a_recurrent_run_and_its_first_stage_has_scalars(configure, kitti, tmp_path):
    train(configure("model=rcnn_reg", *kitti))
    assert_every_chart_has_scalars(tmp_path / "outputs" / "run")
    assert_every_chart_has_scalars(tmp_path / "outputs" / "run" / "first_stage")


@pytest.mark.slow
def test_the_row_of_a_run_has_its_settings_and_drift(sweep, scores):
    found = set()
    for run in sweep.glob("*/tensorboard"):
        events = events_of(run.parent)
        content = events.summary_metadata["_hparams_/session_start_info"].plugin_data.content
        row = HParamsPluginData.FromString(content).session_start_info.hparams
        kernel = int(row["model.kernel_size"].number_value)
        assert row["model"].string_value == "cnn_reg"
        assert row["data"].string_value == "kitti"
        assert not any(name.startswith(("run_dir", "outputs", "data.root")) for name in row)
        for tag, split in ((TEST_DRIFT, "test"), (VALIDATION_DRIFT, "val")):
            (event,) = events.Scalars(tag)
            assert event.value == pytest.approx(100 * scores[kernel][split]["drift"], rel=1e-6)
        found.add(kernel)
    assert found == set(KERNELS)


# --- TensorBoard's server ------------------------------------------------------------------------


def wait_for(what, look):
    """What ``look()`` returns as soon as it is something; fails after a while."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if found := look():
            return found
        time.sleep(0.2)
    pytest.fail(f"no {what} after {PATIENCE} s")


def ask_experiment(url):
    """Columns of the HParams tab, as the page asks for them."""
    question = json.dumps({"experimentName": "", "includeMetrics": True}).encode()
    address, header = f"{url}data/plugin/hparams/experiment", {"Content-Type": "application/json"}
    with urlopen(Request(address, question, header), timeout=PATIENCE) as answer:
        return json.load(answer)


@pytest.fixture(scope="module")
def tensorboard(sweep, tmp_path_factory):
    """Address of a TensorBoard that has loaded both runs of the sweep."""
    log = tmp_path_factory.mktemp("tensorboard") / "log.txt"
    command = [sys.executable, "-m", "tensorboard.main", "--logdir", str(sweep), "--port", "0"]
    with log.open("w") as output:
        server = subprocess.Popen([*command, "--host", "127.0.0.1"], stdout=output, stderr=output)
    try:
        address = re.compile(r"TensorBoard \S+ at (http://\S+)")
        url = wait_for("address of TensorBoard", lambda: address.search(log.read_text()))[1]
        wait_for(
            "loaded runs", lambda: any(c.get("differs") for c in ask_experiment(url).get("hparamInfos", []))
        )
        yield url
    finally:
        server.terminate()
        server.wait(timeout=30)


@pytest.mark.slow
def test_the_server_finds_the_setting_that_differs(tensorboard):
    columns = ask_experiment(tensorboard)["hparamInfos"]
    assert [column["name"] for column in columns if column.get("differs")] == ["model.kernel_size"]
    assert columns[0]["name"] == "model.kernel_size"
    metrics = {metric["name"]["tag"] for metric in ask_experiment(tensorboard)["metricInfos"]}
    assert {TEST_DRIFT, TEST_DRIFT.replace("all drives", "drive 05"), VALIDATION_DRIFT} <= metrics


# --- a real browser ------------------------------------------------------------------------------

# TensorBoard's pages are web components, whose content plain selectors do not reach.
DEEP = """
const all = (root, selector) => [...root.querySelectorAll('*')].flatMap(e => [
  ...(e.matches(selector) ? [e] : []), ...(e.shadowRoot ? all(e.shadowRoot, selector) : [])]);
const text = node => node.nodeType === Node.TEXT_NODE ? [node.textContent.trim()]
  : /STYLE|SCRIPT|TEMPLATE/.test(node.nodeName) ? []
  : [...(node.shadowRoot ? text(node.shadowRoot) : []), ...[...node.childNodes].flatMap(text)];
"""
LINES = f"{DEEP} return text(document.body).filter(line => line);"
# Points that each chart has drawn.
DRAWN = f"""{DEEP}
const drawn = card => all(card.shadowRoot, 'path.symbol').filter(point => point.getAttribute('d'));
return all(document, 'tf-custom-scalar-multi-line-chart-card').map(card => drawn(card).length);
"""
IMAGE_WIDTHS = f"{DEEP} return all(document, 'img').map(image => image.naturalWidth);"
# The grid puts the content of its cells elsewhere in the page, in no order: a cell has a slot for it.
TABLE = f"""{DEEP}
const [grid] = all(document, 'vaadin-grid');
const parts = cell => all(cell, 'slot').flatMap(slot => slot.assignedNodes());
const content = cell => parts(cell).map(node => node.textContent.trim()).join('');
return [...grid.shadowRoot.querySelectorAll('tr')].filter(row => row.offsetHeight).map(
  row => [...row.children].filter(cell => cell.offsetWidth).map(content));
"""


@pytest.fixture(scope="module")
def browser():
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if not (chromium and driver):
        pytest.skip("needs Chromium and its driver: apt-get install chromium chromium-driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=2400,1400"):
        options.add_argument(argument)
    # With both paths given selenium looks for no browser, and downloads none.
    page = webdriver.Chrome(options, webdriver.ChromeService(driver))
    yield page
    page.quit()


@pytest.fixture
def open_tab(browser, tensorboard):
    """Opens a tab of TensorBoard and waits for what a script finds on it to be as wanted."""

    def open_tab(tab, script, is_there):
        def look():
            try:
                found = browser.execute_script(script)
            except JavascriptException:  # a component is not there yet
                return None
            return found if is_there(found) else None

        browser.get("about:blank")  # another tab alone would not load the page anew
        browser.get(f"{tensorboard}#{tab}")
        return wait_for(f"finished page {tab}", look)

    return open_tab


@pytest.mark.slow
def test_the_table_of_the_hparams_tab_has_swept_values_and_drift(open_tab, scores):
    header, *rows = open_tab(
        "hparams", TABLE, lambda table: len(table) == 1 + len(KERNELS) and all(table[-1][2:])
    )
    assert header[:3] == ["Trial ID", "Show Metrics", "model.kernel_size"]
    shown = {}
    for row in rows:
        values = dict(zip(header, row, strict=True))
        shown[float(values["model.kernel_size"])] = float(values[TEST_DRIFT])
    # Five digits are shown.
    assert shown == {k: pytest.approx(100 * s["test"]["drift"], rel=1e-4) for k, s in scores.items()}


@pytest.mark.slow
def test_the_custom_scalars_have_groups_and_lines(open_tab, sweep):
    charts = patterns_of(events_of(next(sweep.glob("*/tensorboard")).parent))
    titles = {title for chart in charts for title in chart}

    def is_there(lines):
        matches = [int(found[1]) for line in lines if (found := re.fullmatch(r"Matches \((\d+)\)", line))]
        # Each chart has at least one line of each run.
        return titles <= set(lines) and len(matches) == len(charts) and min(matches) >= len(KERNELS)

    open_tab("custom_scalars", LINES, is_there)


@pytest.mark.slow
def test_the_scalars_and_the_figures_are_shown(open_tab):
    groups = {"Best checkpoint: drift", "Training: mean of each epoch", "Validation: after each epoch"}
    open_tab("scalars", LINES, lambda lines: groups | {TEST_DRIFT} <= set(lines))
    # Trajectory, motions, coverage and drift by length of each run, loaded to their pixels.
    open_tab("images", IMAGE_WIDTHS, lambda widths: len(widths) == 4 * len(KERNELS) and min(widths) > 300)


@pytest.mark.slow
def test_the_curves_of_the_custom_scalars_are_drawn(open_tab, sweep):
    # A name with parentheses has a match and a chart, but no line.
    charts = len(patterns_of(events_of(next(sweep.glob("*/tensorboard")).parent)))
    open_tab("custom_scalars", DRAWN, lambda counts: len(counts) == charts and min(counts) >= len(KERNELS))


@pytest.mark.slow
def test_the_text_cards_are_shown(open_tab):
    command = "python train.py model=cnn_reg "
    cards = {"What this run is", "How good the best checkpoint is", "Test drift in % by drive", "mean_motion"}
    lines = open_tab("text", LINES, lambda lines: cards <= set(lines))
    assert any(line.startswith(command) for line in lines)
