"""What a user sets on the command line: Hydra reads what is advised, and the advice is one line."""

import os
import shlex
import subprocess
import sys

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st

from conftest import ROOT
from rcnn_odom.errors import InputError
from rcnn_odom.training.overrides import explain_override, quote_for_hydra, read_paths, written
from rcnn_odom.training.settings import plain

PATHS = [
    "~/x",
    "/tmp/ü",
    "a=b",
    "a,b",
    "a (b)",
    "a{b}",
    "[a]",
    "{a}",
    "a'b",
    'a"b',
    "a#b;c&d",
    "C:\\Users\\me (x)\\",
    'a\\"b',
]
READABLE = ["outputs/a", "a b", "C:\\data\\new", "..", "2011-09-26", "$HOME/x", "a|b"]


def parse(override):
    return OverridesParser.create().parse_override(override)


def advised(sentence):
    """The override that a shell hands over when a user types what a sentence advises."""
    assert "\n" not in sentence
    [override] = shlex.split(sentence.split("; write ", 1)[1])
    return override


@pytest.mark.parametrize("name", ["data.root", "run", "outputs", "+model.pretrained"])
@pytest.mark.parametrize("path", PATHS)
def test_hydra_reads_what_is_advised(name, path):
    sentence = explain_override(f"{name}={path}")
    assert sentence.startswith(f"{name}={path}: Hydra cannot read ")
    assert parse(advised(sentence)).value() == path


def test_the_sentence_names_the_character_and_how_to_write_it():
    assert explain_override("data.root=~/x") == (
        "data.root=~/x: Hydra cannot read '~' in a value without quotes; write 'data.root=\"~/x\"'"
    )


@given(st.text(st.sampled_from("ab~ü =,(){}[]'\"\\#:$%/1_."), min_size=1))
def test_whatever_is_quoted_is_read_as_it_was(path):
    assert str(parse(f"data.root={quote_for_hydra(path)}").value()) == path
    assert str(parse(shlex.split(written("data.root", path))[0]).value()) == path


@pytest.mark.parametrize("path", READABLE)
def test_what_hydra_reads_stays_as_it_is(path):
    assert read_paths([f"data.root={path}"]) == [f"data.root={path}"]
    assert parse(shlex.split(written("run", path))[0]).value() == path


def test_names_in_a_list():
    assert parse(advised(explain_override("data.train=[ü,00[0.5:]]"))).value() == ["ü", "00[0.5:]"]
    assert "data.train=[a,b]" in explain_override("data.train=[a(b)")
    assert (
        explain_override("kitti") == "kitti: is not an option; write NAME=VALUE, for instance model=cnn_reg"
    )


def test_the_home_of_the_user(monkeypatch, configure):
    monkeypatch.setenv("HOME", "/home/me (x)")
    for argument in ('data.root="~/x"', "run='~/x'", 'hydra.sweep.dir="~/x"'):
        [read] = read_paths([argument])
        assert parse(read).value() == "/home/me (x)/x"
    assert read_paths(["data.name=~", "~data.root", "-m", "data.root=~/x"])[0] == "data.name=~"
    settings = plain(configure("data=kitti", 'data.root="~/x"', 'model.pretrained="~/y"'))
    assert settings["data"]["root"] == settings["data"]["reader"]["root"] == "/home/me (x)/x"
    assert settings["model"]["pretrained"] == "/home/me (x)/y"


@pytest.mark.parametrize(
    "argument", ["data.root=", "outputs=''", 'run=""', "+model.pretrained=", "run_dir=' '"]
)
def test_an_empty_path_is_refused(argument):
    with pytest.raises(InputError, match="is an empty path; give one, or leave"):
        read_paths([argument])


@pytest.mark.parametrize("path", ["2011_09_26", "1e3", "TRUE"])
def test_a_path_that_hydra_takes_for_something_else(path):
    with pytest.raises(InputError, match=f"^data.root={path}: Hydra reads ") as refused:
        read_paths([f"data.root={path}"])
    assert parse(advised(str(refused.value))).value() == path
    assert read_paths([f'data.root="{path}"', "data.root=2011", "seed=1e3"])


def test_letters_that_the_terminal_does_not_know():
    with pytest.raises(InputError, match="set PYTHONUTF8=1"):
        read_paths(["data.test=[t\udcc3\udca9st]"])


# --- as commands ---------------------------------------------------------------------------------


def command(tmp_path, script, *options, **environment):
    done = subprocess.run(
        [sys.executable, str(ROOT / script), *options],
        cwd=tmp_path,
        capture_output=True,
        timeout=120,
        env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
    )
    printed = (done.stdout + done.stderr).decode("utf-8", "replace")
    assert "Traceback" not in printed
    assert "Logging error" not in printed
    return done.returncode, printed


@pytest.mark.parametrize(
    ("script", "option", "message"),
    [
        ("train.py", "data.root=~/x", "write 'data.root=\"~/x\"'"),
        ("train.py", "data.root=a,b", "write 'data.root=\"a,b\"'"),
        ("train.py", "data.train=00,05", "write 'data.train=[00,05]' for a list, or add -m"),
        ("train.py", "trainer=nope", "trainer=nope: there is no such choice; there are ddp, default"),
        ("train.py", "+sweeps=nope", "sweeps=nope: there is no such choice; there are beta"),
        ("train.py", "trainer.max_time=00:00:01:00", "write +trainer.max_time=..."),
        ("train.py", "trainer.max_epochs=3", "set model.epochs"),
        ("train.py", "outputs=", "is an empty path"),
        ("train.py", "hydra.job.chdir=true", "paths must be relative to the folder of the command"),
        ("train.py", "+data.foo=1", "data.foo: there is no such option; there are apply"),
        ("evaluate.py", "run=a(b)", "write 'run=\"a(b)\"'"),
        ("evaluate.py", "data=nope", "data=nope: there is no such choice"),
    ],
)
def test_a_slip_gives_one_line_that_helps(tmp_path, script, option, message):
    status, printed = command(tmp_path, script, option)
    assert status == 1
    [line] = [line for line in printed.splitlines() if line.startswith("error: ")]
    assert message in line


@pytest.mark.parametrize(
    "environment",
    [
        {"PYTHONIOENCODING": "ascii"},
        pytest.param({"LC_ALL": "C"}, marks=pytest.mark.slow),
        pytest.param({"LANG": "POSIX", "PYTHONIOENCODING": "ascii"}, marks=pytest.mark.slow),
    ],
)
def test_a_terminal_that_knows_ascii_alone(tmp_path, environment):
    options = ["model=cnn_reg", "data=simulated", "data.frames=20", "model.epochs=1", "data.workers=1"]
    options += ["data.sensor.resolution_deg=1.0", "data.fresh_worlds=false", "data.lengths=[2.0]"]
    options += ['data.train=["ä"]', 'data.test=["tést"]', 'outputs="ö ut"', 'run_dir="ö ut/rün"']
    status, printed = command(tmp_path, "train.py", *options, **environment)
    assert status == 0
    assert "look at them with: tensorboard --logdir '" in printed
    run = tmp_path / "ö ut" / "rün"
    assert "tést" in (run / "train.log").read_text(encoding="utf-8")
    assert "all results are in 'ö ut/rün'" in (run / "train.log").read_text(encoding="utf-8")
    assert (run / "trajectories" / "tést.txt").exists()
    status, printed = command(tmp_path, "evaluate.py", 'run="ö ut/rün"', 'outputs="ö ut"', **environment)
    assert status == 0
    status, printed = command(tmp_path, "evaluate.py", 'run="ü"', **environment)
    assert status == 1


def test_where_python_cannot_read_the_letters_it_says_so(tmp_path):
    environment = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    status, printed = command(tmp_path, "train.py", 'outputs="ö"', **environment)
    assert status == 1
    assert "set PYTHONUTF8=1" in printed
