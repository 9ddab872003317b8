"""Where a result comes from: the commit of the code and the processor."""

import platform
import re
import subprocess
from pathlib import Path

from rcnn_odom.training.machine import CPU_INFO
from rcnn_odom.training.run_state import PACKAGE

FEATURES = {"avx512f": "AVX-512", "avx512_bf16": "bf16"}
"""Features of a processor that decide how fast networks are: flags of Linux and what they are called."""


def find_commit(package: Path = PACKAGE) -> str | None:
    """The Git commit of a checkout, and whether its files have changed since, except for pages and tests.

    Args:
        package: folder of a Python package in the checkout.

    Returns:
        For instance ``75c17ba, with local changes``. None if Git does not track the package, for instance
        that of an installed distribution.
    """
    tracked = _run_git(package, "ls-files", "--error-unmatch", "__init__.py")
    commit = tracked and _run_git(package, "rev-parse", "--short=7", "HEAD")
    if not commit:
        return None
    others = ":(top)", ":(top,exclude)*.md", ":(top,exclude)tests"
    changed = _run_git(package, "status", "--porcelain", "--", *others)
    return commit if changed == "" else f"{commit}, {'with' if changed else 'perhaps with'} local changes"


def _run_git(folder: Path, *arguments: str) -> str | None:
    """The output of a Git command that only reads; None if it fails."""
    command = ["git", "--no-optional-locks", "-C", str(folder), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def read_processor_name(info: Path = CPU_INFO) -> str:
    """The name of the processor and its features; ``processor not recorded`` if the system gives none."""
    text = info.read_text("utf-8") if info.exists() else ""
    found = re.search(r"^model name\s*:\s*(.*)$", text, re.MULTILINE)
    name = re.sub(r"\((R|TM)\)|\bCPU\b.*|\bProcessor\b", " ", found[1] if found else platform.processor())
    features = [shown for flag, shown in FEATURES.items() if re.search(rf"\b{flag}\b", text)]
    name = " ".join(name.split()) or "processor not recorded"
    return f"{name} ({', '.join(features)})" if features else name
