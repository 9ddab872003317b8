"""Finds the files of the networks that ship with the project."""

from pathlib import Path

from rcnn_odom.errors import InputError

FOLDER = Path(__file__).parents[1] / "deployment" / "shipped"
"""Folder of the files and their model cards; see :mod:`rcnn_odom.deployment.shipped`."""


def shipped_models() -> list[str]:
    """Names of the shipped networks.

    Example:
        >>> "all_round" in shipped_models()
        True
    """
    return sorted(path.stem for path in FOLDER.glob("*.onnx"))


def find_file(path: str | Path) -> Path:
    """The file of a network.

    Args:
        path: path of a file, or name of a network that ships with the project.

    Raises:
        InputError: there is neither such a file nor such a network.

    Example:
        >>> find_file("all_round").name
        'all_round.onnx'
    """
    if Path(path).is_file():
        return Path(path)
    names = shipped_models()
    if str(path) in names:
        return FOLDER / f"{path}.onnx"
    raise InputError(f"{path}: no such file, nor a model that ships with rcnn-odom ({', '.join(names)})")
