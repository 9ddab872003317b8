"""Leaves single modules out of the robot's distribution, which pyproject.toml alone cannot do."""

import tomllib
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SETTINGS = tomllib.loads(Path(__file__).with_name("pyproject.toml").read_text(encoding="utf-8"))
LEFT_OUT = SETTINGS["tool"]["rcnn-odom-robot"]["left-out"]


class BuildWithoutModules(build_py):
    """Builds the distribution without the modules in ``LEFT_OUT``."""

    def find_package_modules(self, package: str, package_dir: str) -> list[tuple[str, str, str]]:
        """Finds the package, name and file of each module that is built."""
        modules = super().find_package_modules(package, package_dir)
        return [each for each in modules if f"{each[0]}.{each[1]}" not in LEFT_OUT]


setup(cmdclass={"build_py": BuildWithoutModules})
