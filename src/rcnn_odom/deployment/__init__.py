"""Odometry in a stream, one pose for each scan; needs neither PyTorch nor Lightning.

>>> from rcnn_odom.deployment import Odometer
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rcnn_odom.deployment.odometer import Odometer as Odometer
    from rcnn_odom.deployment.odometer import Pose as Pose

LAZY = ("Odometer", "Pose")
"""Imported at first use, because they need numpy, which the package itself does not need."""


def __getattr__(name: str) -> Any:
    if name not in LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from rcnn_odom.deployment import odometer

    return getattr(odometer, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *LAZY])
