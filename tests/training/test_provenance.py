"""The commit and the processor that a result comes from."""

import re
import subprocess

import pytest

from rcnn_odom.training.provenance import find_commit, read_processor_name


@pytest.mark.parametrize(
    ("name", "flags", "shown"),
    [
        ("Intel(R) Xeon(R) Processor", "sse avx512f avx512_bf16", "Intel Xeon (AVX-512, bf16)"),
        ("Intel(R) Core(TM) i7-8550U CPU @ 1.80GHz", "sse avx2", "Intel Core i7-8550U"),
        ("AMD EPYC 9R14 96-Core Processor", "avx512f avx512_bf16x", "AMD EPYC 9R14 96-Core (AVX-512)"),
    ],
)
def test_names_of_processors(tmp_path, name, flags, shown):
    info = tmp_path / "cpuinfo"
    info.write_text(f"processor\t: 0\nmodel name\t: {name}\nflags\t\t: {flags}\n")
    assert read_processor_name(info) == shown


def test_an_unknown_processor_is_not_made_up(monkeypatch, tmp_path):
    monkeypatch.setattr("platform.processor", lambda: "")
    assert read_processor_name(tmp_path / "none") == "processor not recorded"


def test_the_commit_and_whether_there_are_changes_beside_it(tmp_path):
    package = tmp_path / "src" / "package"
    for folder in (package, tmp_path / "conf", tmp_path / "tests"):
        folder.mkdir(parents=True)
    files = [package / "__init__.py", tmp_path / "conf" / "a.yaml", tmp_path / "tests" / "a.py"]
    for file in (*files, page := tmp_path / "page.md"):
        file.write_text("")
    assert find_commit(package) is None
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init"], ["add", "."], ["commit", "--message=first"]):
        subprocess.run([*git, *command], check=True, capture_output=True)
    commit = find_commit(package)
    assert re.fullmatch("[0-9a-f]{7,}", commit)
    page.write_text("changed")
    files[2].write_text("changed = True")
    assert find_commit(package) == commit
    for file in files[:2]:
        file.write_text("changed: true")
        assert find_commit(package) == f"{commit}, with local changes"
        file.write_text("")
        assert find_commit(package) == commit
    (package / "new.py").write_text("")
    assert find_commit(package) == f"{commit}, with local changes"
