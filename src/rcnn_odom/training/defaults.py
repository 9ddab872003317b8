"""Defaults that depend on both the model and the data, for ``${default:...}`` in ``conf/model``."""

from fnmatch import fnmatch

from omegaconf import DictConfig

TABLE: tuple[tuple[str, str, str, str, float], ...] = (
    # option, model, data, data.scale: its default. The first row that fits counts.
    ("beta", "*_cls", "carmen", "*", 0.03),
    ("beta", "*_cls", "indoor", "*", 0.03),
    ("beta", "*_cls", "*", "*", 1.0),
    ("beta", "*", "carmen", "*", 5.0),  # a robot's steps are centimetres
    ("beta", "*", "indoor", "*", 5.0),
    ("beta", "*", "*", "*", 100.0),  # radians are small, classes are not
    ("width_deg", "*", "carmen", "*", 0.5),  # robots turn on the spot
    ("width_deg", "*", "indoor", "*", 0.5),
    ("width_deg", "*", "*", "*", 0.1),
    ("epochs", "rcnn_*", "*", "small", 20),  # an epoch of the small set has few steps
    ("epochs", "*", "*", "small", 50),
    ("epochs", "rcnn_*", "*", "*", 5),
    ("epochs", "*", "*", "*", 10),
)


def default(option: str, *, _parent_: DictConfig, _root_: DictConfig) -> float:
    """The default of a model's option.

    Args:
        option: its name, ``beta``, ``width_deg`` or ``epochs``.
        _parent_: the options that it stands among or one group below, which OmegaConf gives.
        _root_: the whole configuration, which OmegaConf gives.
    """
    group = _parent_ if "variant" in _parent_ else _parent_._get_parent()
    assert isinstance(group, DictConfig)
    data = _root_.get("data") or {}
    wanted = option, str(group["variant"]), str(data.get("name")), str(data.get("scale"))
    return next(value for *row, value in TABLE if all(map(fnmatch, wanted, row)))
