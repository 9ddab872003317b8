"""Where the networks that ship with the project are, for models and for robots alike."""

from pathlib import Path

from rcnn_odom.errors import InputError

FOLDER = Path(__file__).parents[1] / "deployment" / "shipped"
"""Files beside their model cards; see :mod:`rcnn_odom.deployment.shipped`."""


def shipped_models() -> list[str]:
    """Names of the models."""
    return sorted(path.stem for path in FOLDER.glob("*.onnx"))


def find_file(path: str | Path) -> Path:
    """A file by its path, or a model that ships with the project by its name.

    Raises:
        InputError: neither is there.
    """
    if Path(path).is_file():
        return Path(path)
    names = shipped_models()
    if str(path) in names:
        return FOLDER / f"{path}.onnx"
    raise InputError(f"{path}: no such file, nor a model that ships with rcnn-odom ({', '.join(names)})")
