"""Defaults that depend on the model and on the data, for ``${default:...}`` in ``conf/model``."""

from fnmatch import fnmatch

from omegaconf import DictConfig

INDOORS = "carmen", "half_circle", "indoor", "logs", "mixed"
"""Data of robots, which make steps of a few centimetres and turn on the spot."""

Row = tuple[str, str, str, str, float]
"""Option, model, data, ``data.scale``, and the option's default."""


def _by_place(option: str, model: str, indoors: float, elsewhere: float) -> list[Row]:
    """Rows with one default for the data ``INDOORS`` and one for all other data."""
    rows: list[Row] = [(option, model, data, "*", indoors) for data in INDOORS]
    return [*rows, (option, model, "*", "*", elsewhere)]


TABLE: tuple[Row, ...] = (
    # The first row that matches is used.
    *_by_place("beta", "*_cls", 0.03, 1.0),
    *_by_place("beta", "*", 5.0, 100.0),  # radians are small numbers, class scores are not
    *_by_place("width_deg", "*", 0.5, 0.1),
    # A step of 5 cm is small beside bins of 1 degree. Half of the paper's bins have no return of an HDL-64.
    *_by_place("drawn_deg", "*", 0.25, 0.2),
    ("key_distance", "*", "all_round", "*", 1.0),  # data of robots and cars
    *_by_place("key_distance", "*", 0.5, 2.0),
    *_by_place("settled", "*", 0.01, 0.1),
    *_by_place("radians_a_metre", "*", 0.2, 0.05),  # walls are about 5 m away indoors, and 20 m outdoors
    *_by_place("residual_x", "*", 0.15, 0.5),
    *_by_place("residual_y", "*", 0.1, 0.2),
    ("residual_heading_deg", "*", "all_round", "*", 3.0),
    *_by_place("residual_heading_deg", "*", 5.0, 1.5),
    ("repeat", "*", "*", "small", 8),  # each time with another initial guess
    ("repeat", "*", "*", "*", 1),
    ("epochs", "rcnn_warp", "*", "small", 10),
    ("epochs", "cnn_warp", "*", "small", 12),
    ("epochs", "rcnn_*", "*", "small", 20),  # an epoch of the small data set has few steps
    ("epochs", "*", "*", "small", 50),
    ("epochs", "rcnn_*", "*", "*", 5),
    ("epochs", "*", "*", "*", 10),
)


def default(option: str, *, _parent_: DictConfig, _root_: DictConfig) -> float:
    """The default of an option of a model.

    Args:
        option: name of the option, for instance ``epochs``.
        _parent_: the group of the option, or a group within it; passed by OmegaConf.
        _root_: the whole configuration; passed by OmegaConf.
    """
    group = _parent_ if "variant" in _parent_ else _parent_._get_parent()
    assert isinstance(group, DictConfig)
    data = _root_.get("data") or {}
    wanted = option, str(group["variant"]), str(data.get("name")), str(data.get("scale"))
    return next(value for *row, value in TABLE if all(map(fnmatch, wanted, row)))
