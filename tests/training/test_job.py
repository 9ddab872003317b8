"""What stands around a job: mistakes become one line and a status, in one process and in several."""

import errno
import logging
import signal
from types import SimpleNamespace

import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import InterpolationKeyError
from torch.multiprocessing import ProcessExitedException, ProcessRaisedException
from yaml import YAMLError

from conftest import ROOT
from rcnn_odom.errors import InputError
from rcnn_odom.training import job, processes
from rcnn_odom.training.saving import Stopped


@pytest.fixture(autouse=True)
def alone(monkeypatch):
    """What a command sets in its process is for that alone."""
    monkeypatch.setattr(signal, "signal", lambda number, handler: signal.getsignal(number))
    monkeypatch.setattr(logging, "raiseExceptions", logging.raiseExceptions)
    monkeypatch.setattr(job, "_failed", [])


def raising(error):
    def run(*_):
        raise error

    return run


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (InterpolationKeyError("no 'model.variant'"), 1, "error: no 'model.variant'\n"),
        (YAMLError("expected ']'"), 1, "error: expected ']'\n"),
        (ValueError("Config group override must be"), 1, "error: Config group override must be\n"),
        (KeyboardInterrupt(), 130, ""),
        (InputError("model.beta=0"), 1, ""),
        (HydraException("no such group\n    full_key: data"), 1, "error: no such group\n"),
        (PermissionError(13, "denied"), 1, "error: [Errno 13] denied; choose another outputs= or run_dir=\n"),
    ],
)
def test_a_command_ends_with_a_status_and_a_line(capsys, error, status, line):
    assert job.run_command(raising(error)) == status
    assert capsys.readouterr().err == line


def test_a_choice_of_an_earlier_version_is_answered(capsys):
    """With Hydra's own complaint about a choice that is no longer there."""
    with (
        initialize_config_dir(str(ROOT / "conf"), version_base="1.3"),
        pytest.raises(HydraException) as found,
    ):
        compose("evaluate", ["model=icpp"])
    error = type(found.value)(str(found.value).replace("model/icpp", "model/icp"))
    assert job.run_command(raising(error)) == 1
    assert capsys.readouterr().err == "error: model=icp has become model=matcher; set that\n"


def test_a_command_without_a_mistake_is_a_success():
    assert job.run_command(lambda: None) == 0


@pytest.fixture
def hydra(monkeypatch, tmp_path):
    """A function that makes Hydra tell of a job: what it gives to ``run_job``."""

    def hydra(number="???", overrides=(), chdir=None, **choices):
        told = {
            "job": {"num": number, "chdir": chdir},
            "runtime": {"output_dir": str(tmp_path), "choices": choices},
            "overrides": {"task": list(overrides)},
        }
        monkeypatch.setattr(job, "HydraConfig", SimpleNamespace(get=lambda: OmegaConf.create(told)))
        return OmegaConf.create({"run_dir": ""})

    return hydra


def test_a_job_gets_its_folder(hydra, tmp_path):
    assert job.run_job(lambda cfg: cfg.run_dir, hydra()) == str(tmp_path)


def test_a_mistake_is_told_and_remembered(hydra, caplog):
    assert job.run_job(raising(InputError("model.beta=0")), hydra()) is None
    assert job.run_job(raising(OSError(errno.ENOSPC, "full")), hydra()) is None
    assert "error: model.beta=0" in caplog.text
    assert "full; make room, then repeat the command" in caplog.text
    assert job.run_command(lambda: None) == 1


def test_in_a_sweep_a_mistake_is_also_written_down_and_raised(hydra, tmp_path):
    with pytest.raises(InputError):
        job.run_job(raising(InputError("model.beta=0")), hydra(number=3))
    assert (tmp_path / "error.txt").read_text() == "InputError: model.beta=0\n"
    assert job.run_job(lambda cfg: 5, hydra(number=3)) == 5
    assert not (tmp_path / "error.txt").exists()


def test_options_of_a_sweep_and_of_a_run_are_not_for_the_other(hydra, caplog):
    with pytest.raises(InputError, match="run_dir= is the folder of a single run"):
        job.run_job(lambda cfg: 5, hydra(number=0, overrides=["run_dir=here"]))
    assert job.run_job(lambda cfg: 5, hydra(sweeps="table2")) is None
    assert "+sweeps= needs -m" in caplog.text


def test_faults_of_the_program_and_stops_go_on(hydra):
    with pytest.raises(KeyError):
        job.run_job(raising(KeyError("fault")), hydra())
    with pytest.raises(KeyboardInterrupt):
        job.run_job(raising(SystemExit(1)), hydra())


# --- several processes ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("traceback", "expected", "message"),
    [
        ("Traceback\nrcnn_odom.errors.InputError: 00: cut off", InputError, "^00: cut off$"),
        ("Traceback\nOSError: no space", InputError, "^no space; make room, then repeat the command$"),
        ("Traceback\nrcnn_odom.training.saving.Stopped", Stopped, "^$"),
        ("Traceback\nKeyError: 'fault'", ProcessRaisedException, "fault"),
    ],
)
def test_an_error_of_another_process_is_as_of_this_one(traceback, expected, message):
    error = ProcessRaisedException(traceback, 0, 1234)
    with pytest.raises(expected, match=message), processes.one_line_errors(SimpleNamespace(world_size=1)):
        raise error


def test_a_process_that_was_killed_is_told():
    trainer = SimpleNamespace(world_size=1)
    with pytest.raises(InputError, match="was killed"), processes.one_line_errors(trainer):
        raise ProcessExitedException("killed", 0, 1234, -9)


def test_a_signal_is_passed_on_once(monkeypatch):
    handlers, ended = {}, []
    monkeypatch.setattr(signal, "signal", handlers.__setitem__)
    child = SimpleNamespace(terminate=lambda: ended.append("child"))
    monkeypatch.setattr(processes.multiprocessing, "active_children", lambda: [child])

    def train():
        with processes.one_line_errors(SimpleNamespace(world_size=2)):
            handlers[signal.SIGTERM](signal.SIGTERM, None)
            assert ended == ["child"]
            with pytest.raises(KeyboardInterrupt):
                handlers[signal.SIGTERM](signal.SIGTERM, None)
            raise ProcessExitedException("stopped", 0, 1234, 143)

    with pytest.raises(Stopped):
        train()


def test_paths_are_relative_to_where_the_command_was_started(hydra, caplog):
    assert job.run_job(lambda cfg: 5, hydra(chdir=True)) is None
    assert (
        "hydra.job.chdir=true: paths must be relative to the folder of the command; leave it out"
        in caplog.text
    )
