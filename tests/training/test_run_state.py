"""What a run's folder holds, who may enter it, and whether finished weights are still what they were."""

import json
import logging
import shutil
import signal
import subprocess
import sys
from multiprocessing import get_context

import pytest
import yaml
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from torch.utils.tensorboard import SummaryWriter

from conftest import ROOT
from rcnn_odom.errors import InputError
from rcnn_odom.evaluation.run_folder import BEST, CONFIG, METRICS, RUNNING, home_of
from rcnn_odom.files import lock_if_free
from rcnn_odom.training import job, run_state
from rcnn_odom.training.run_state import (
    DECIDING,
    PACKAGE,
    Fingerprints,
    State,
    check_checkpoint,
    code_fingerprint,
    find_stopped,
    link_latest,
    open_run,
    state_of,
    write_config,
    write_json,
)

SETTINGS = {"data": {"name": "kitti"}, "model": {"variant": "cnn_reg"}, "trainer": {}, "seed": 0}
WANTED = Fingerprints("settings", "code")


@pytest.fixture
def run(tmp_path):
    return tmp_path / "outputs" / "run"


def finish(run, settings=SETTINGS, fingerprint="settings", code="code"):
    write_config(run, settings)
    write_json(run / METRICS, {"fingerprint": fingerprint, "code": code})
    (run / BEST).parent.mkdir()
    (run / BEST).touch()


# --- states --------------------------------------------------------------------------------------


def test_a_run_goes_from_new_to_stopped_to_finished(run):
    assert state_of(run, SETTINGS).state is State.NEW
    with open_run(run, SETTINGS):
        pass
    assert state_of(run, SETTINGS) == (State.STOPPED, run)
    assert state_of(run, SETTINGS | {"seed": 1}).state is State.OTHER
    assert state_of(run, SETTINGS | {"run_dir": "elsewhere"}).state is State.STOPPED
    write_json(run / METRICS, {"fingerprint": "settings"})
    assert state_of(run, SETTINGS) == state_of(run, SETTINGS, WANTED) == (State.FINISHED, run)
    assert state_of(run, SETTINGS, Fingerprints("other recordings", "code")).state is State.OTHER
    assert state_of(run, SETTINGS, Fingerprints("settings", "edited")).state is State.FINISHED
    (run / METRICS).write_text("{")
    assert state_of(run, SETTINGS).state is State.OTHER
    with pytest.raises(InputError, match="holds a finished run"), open_run(run, SETTINGS):
        pass


def test_a_run_of_another_process_is_locked(run):
    write_config(run, SETTINGS)
    with lock_if_free(run / RUNNING):
        assert state_of(run, SETTINGS).state is State.LOCKED
        with pytest.raises(InputError, match="another process is training this run"), open_run(run, SETTINGS):
            pass
    with open_run(run, SETTINGS):
        assert state_of(run, SETTINGS).state is State.STOPPED, "its own process may look too"


def test_a_twin_has_the_same_recordings_settings_and_code(run, tmp_path):
    outputs = tmp_path / "outputs"
    write_config(run, SETTINGS)
    finish(outputs / "recordings", fingerprint="other")
    finish(outputs / "edited", code="other")
    assert state_of(run, SETTINGS, WANTED, twins_in=outputs).state is State.STOPPED
    finish(outputs / "twin")
    link_latest(outputs, outputs / "twin")
    assert state_of(run, SETTINGS, WANTED, twins_in=outputs) == (State.TWIN, outputs / "twin")
    assert state_of(run, SETTINGS, WANTED).state is State.STOPPED


# --- two equal commands --------------------------------------------------------------------------


def test_a_stopped_run_is_taken_from_the_look_on(tmp_path, run, monkeypatch):
    write_config(run, SETTINGS)
    seen = []

    def look_again(*arguments):
        seen.append(state_of(*arguments))
        if len(seen) == 1:  # another process enters between the first look and the lock
            monkeypatch.setattr(run_state, "_claim", lambda run: False)
        return seen[-1]

    with monkeypatch.context():
        monkeypatch.setattr(run_state, "state_of", look_again)
        assert find_stopped(run.parent, SETTINGS) is None
    assert [found.state for found in seen] == [State.STOPPED]


FIND = """
import sys
from pathlib import Path
from rcnn_odom.training.run_state import open_run, find_stopped
settings = {settings!r}
found = find_stopped(Path({folder!r}), settings) or Path({folder!r}) / sys.argv[1]
print(found.name, flush=True)
sys.stdin.readline()
with open_run(found, settings):
    print("entered", flush=True)
"""


def test_the_second_of_two_equal_commands_gets_a_folder_of_its_own(run):
    write_config(run, SETTINGS)
    script = FIND.format(settings=SETTINGS, folder=str(run.parent))
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    processes = [subprocess.Popen([sys.executable, "-c", script, f"new{i}"], **pipes) for i in range(2)]
    found = [process.stdout.readline().strip() for process in processes]
    # Both have looked before the first one begins.
    assert [process.communicate("\n", timeout=60)[0] for process in processes] == ["entered\n"] * 2
    assert found.count("run") == 1


def _hold(run, events):
    with open_run(run, SETTINGS):
        events.put("entered")
        events.get()


def test_the_lock_ends_with_its_process(run):
    write_config(run, SETTINGS)
    context = get_context("spawn")
    events = context.Queue()
    process = context.Process(target=_hold, args=(run, events))
    process.start()
    assert events.get(timeout=60) == "entered"
    assert find_stopped(run.parent, SETTINGS) is None
    process.kill()
    process.join()
    assert find_stopped(run.parent, SETTINGS) == run
    run_state._release(run)


# --- edited code ---------------------------------------------------------------------------------


@pytest.fixture
def package(tmp_path):
    folder = tmp_path / "package"
    (folder / "models").mkdir(parents=True)
    shutil.copy(PACKAGE / "models" / "losses.py", folder / "models")
    return folder


def test_comments_docstrings_and_layout_do_not_count_but_statements_do(package):
    path = package / "models" / "losses.py"
    text, before = path.read_text(), code_fingerprint(package)
    path.write_text(f'"""Other words."""\n# and a comment\n\n{text.split(chr(34) * 3, 2)[2]}')
    assert code_fingerprint(package) == before
    path.write_text(text + "\n\nEDITED = True\n")
    assert code_fingerprint(package) != before


def test_the_file_of_a_model_from_another_package_counts(package, tmp_path):
    (tmp_path / "mine.py").write_text("def forward(x):\n    return x\n")
    before = code_fingerprint(package, [tmp_path / "mine.py"])
    assert before != code_fingerprint(package)
    (tmp_path / "mine.py").write_text('def forward(x):\n    """As it was."""\n    return x\n')
    assert code_fingerprint(package, [tmp_path / "mine.py"]) == before
    (tmp_path / "mine.py").write_text("def forward(x):\n    return 2 * x\n")
    assert code_fingerprint(package, [tmp_path / "mine.py"]) != before


def test_every_pattern_of_deciding_sources_finds_some():
    assert all(list(PACKAGE.glob(pattern)) for pattern in DECIDING)


def test_a_stopped_run_goes_on_with_edited_code_and_says_so(caplog, tmp_path):
    caplog.set_level("INFO")
    check_checkpoint(tmp_path, {"fingerprint": "settings", "code": "code"}, WANTED)
    assert caplog.text == ""
    check_checkpoint(tmp_path, {"fingerprint": "settings", "code": "before"}, WANTED)
    assert "the code has changed since this run was started" in caplog.text
    with pytest.raises(InputError, match="on other recordings or with another version"):
        check_checkpoint(tmp_path, {"fingerprint": "other", "code": "code"}, WANTED)


# --- outputs/latest ------------------------------------------------------------------------------


def test_latest_as_the_folder_of_a_run_is_the_run_that_it_shows(run, tmp_path):
    write_config(run, {"data": {}, "model": {}, "trainer": {}})
    link_latest(tmp_path, run)
    assert home_of(tmp_path / "latest").resolve() == run.resolve()
    assert home_of(run) == run
    assert home_of(tmp_path / "new") == tmp_path / "new"


def test_latest_shows_the_run_but_tensorboard_sees_it_once(run, tmp_path):
    outputs = tmp_path / "outputs"
    for folder in (run, run / "first_stage"):
        with SummaryWriter(folder / "tensorboard") as writer:
            writer.add_scalar("loss", 1.0, 1)
    (outputs / "latest").symlink_to("before")
    for each in (outputs / "before", run):
        link_latest(outputs, each)
    events = EventMultiplexer()
    events.AddRunsFromDirectory(str(outputs))
    events.Reload()
    assert sorted(events.Runs()) == ["run/first_stage/tensorboard", "run/tensorboard"]
    # What is made later is there too.
    write_config(run, SETTINGS)
    write_json(run / METRICS, {"drift": 1})
    (run / "trajectories").mkdir()
    latest = outputs / "latest"
    assert yaml.safe_load((latest / CONFIG).read_text()) == SETTINGS
    assert json.loads((latest / METRICS).read_text()) == {"drift": 1}
    assert (latest / "trajectories").resolve() == run / "trajectories"


# --- the command line ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "option", ["data.beta.regression=3", pytest.param("+data.beta.regression=3", marks=pytest.mark.slow)]
)
def test_an_option_that_was_renamed_is_refused_with_its_new_name(tmp_path, option):
    command = [sys.executable, str(ROOT / "train.py"), option, f"outputs={tmp_path}"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert "data.beta has become model.beta; set that" in (done.stdout + done.stderr).splitlines()[-1]
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("message", "is_raised"), [("No trials are completed yet.", False), ("a fault of the program", True)]
)
def test_only_the_sweepers_own_error_after_failed_jobs_is_a_users(monkeypatch, message, is_raised):
    def main():
        raise ValueError(message)

    # What it sets in its process is for that alone.
    monkeypatch.setattr(signal, "signal", lambda number, handler: None)
    monkeypatch.setattr(logging, "raiseExceptions", logging.raiseExceptions)
    monkeypatch.setattr(job, "_failed", [InputError("model.kernel_size=4: must be odd")])
    if is_raised:
        with pytest.raises(ValueError, match=message):
            job.run_command(main)
    else:
        assert job.run_command(main) == 1
