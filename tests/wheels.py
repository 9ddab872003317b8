"""Wheels of this checkout, built as pip builds them."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from conftest import ROOT

IGNORED = shutil.ignore_patterns("*.egg-info", "__pycache__", "build")
PIP = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")


def copy_source(folder: Path) -> Path:
    """What distributions are built from, its links as links, in a new folder."""
    for name in ("src", "conf", "sweeps", "robot"):
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=IGNORED)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    return folder


def build_wheel(project: Path, folder: Path) -> Path:
    """The wheel of a project in a folder, built without any index."""
    pytest.importorskip("setuptools", reason="without setuptools no wheel can be built offline")
    build = ["wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", folder, project]
    subprocess.run([*PIP, *build], check=True, timeout=3600)
    [wheel] = folder.glob("*.whl")
    return wheel
