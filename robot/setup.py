"""Leaves single modules out of the robot's distribution, which pyproject.toml alone cannot."""

import tomllib
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SETTINGS = tomllib.loads(Path(__file__).with_name("pyproject.toml").read_text(encoding="utf-8"))
LEFT_OUT = SETTINGS["tool"]["rcnn-odom-robot"]["left-out"]


class BuildWithout(build_py):
    """Takes all modules but those that are left out."""

    def find_package_modules(self, package: str, package_dir: str) -> list[tuple[str, str, str]]:
        """Package, name and file of each module."""
        found = super().find_package_modules(package, package_dir)
        return [each for each in found if f"{each[0]}.{each[1]}" not in LEFT_OUT]


setup(cmdclass={"build_py": BuildWithout})
