"""Runs an exported network on one pair of scans after the other, with ONNX Runtime and without PyTorch."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.errors import InputError
from rcnn_odom.geometry import Step
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.streaming import Description, Warping

METADATA = "rcnn_odom"
"""Key in the file's metadata for the network's description, in JSON."""
FORMAT = 2
"""Version of the files: 1 had the paper's two numbers as output and no ``format`` in its metadata."""


class OnnxStepper:
    """A :class:`rcnn_odom.models.contract.Stepper` for a file that ``rcnn-odom export`` has written.

    Args:
        file: path of the file, or its content.
        threads: number of threads for the computation.

    Attributes:
        metadata: metadata of the file; see :func:`rcnn_odom.training.onnx_graph.write`.
        description: description of the network, from the metadata.

    Raises:
        InputError: the file does not exist, or ``rcnn-odom export`` of this version has not written it.
    """

    def __init__(self, file: str | Path | bytes, threads: int = 1) -> None:
        self._session = open_session(file, threads)
        path = "the graph" if isinstance(file, bytes) else file
        inputs = {value.name: value.shape for value in self._session.get_inputs()}
        try:
            self.metadata = dict(json.loads(self._session.get_modelmeta().custom_metadata_map[METADATA]))
            current = self.metadata.get("format") == FORMAT
            if current:
                self.description, bins = _describe(self.metadata), inputs.pop("scans")[-1]
        except (KeyError, TypeError, ValueError, InputError) as error:
            raise InputError(
                f"{path}: an ONNX file, but not one of rcnn-odom export ({type(error).__name__}: {error}); "
                "export the checkpoint again"
            ) from error
        if not current:
            raise InputError(f"{path}: written by an older version; export the checkpoint again")
        if bins != self.description.input_sensor.bins:
            raise InputError(f"{path}: its network and its metadata differ in the sensor; export it again")
        self._outputs = ["step", "covariance", *(f"{name}_out" for name in inputs)]
        self._initial = {name: np.zeros(shape, np.float32) for name, shape in inputs.items()}
        self.reset()

    def reset(self) -> None:
        """Forgets all earlier pairs."""
        # Each state needs its own array: h and c must not share one.
        self._state = {name: zeros.copy() for name, zeros in self._initial.items()}
        self._before = self._state

    def forget_last(self) -> None:
        """Restores the state before the last pair, which the next pair replaces."""
        self._state = self._before

    def __call__(self, pair: npt.NDArray[np.float32]) -> Step:
        """The step between two encoded scans (2, bins), the earlier first."""
        self._before = self._state
        step, covariance, *state = self._session.run(self._outputs, {"scans": pair[None], **self._state})
        self._state = dict(zip(self._state, state, strict=True))
        x, y, heading = step[0].tolist()
        return Step(x, y, heading, covariance[0].astype(np.float64))


def open_session(file: str | Path | bytes, threads: int = 1) -> Any:
    """Opens an ``onnxruntime.InferenceSession`` on the CPU.

    Args:
        file: path of the file, or its content.
        threads: number of threads for the computation.

    Raises:
        InputError: the file cannot be read, or ONNX Runtime cannot run it.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Threads that wait by spinning would occupy the cores that other programs of the robot need.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    if not isinstance(file, bytes) and not Path(file).is_file():
        raise InputError(f"{file}: no such file; name one that rcnn-odom export has written")
    source = file if isinstance(file, bytes) else str(file)
    try:
        return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # the content of an unknown file can cause any error
        reason = str(error).splitlines()[0].replace(f"{source!s} ", "")
        raise InputError(
            f"{file!s:.200}: not an ONNX file that can be run ({reason}); export it again"
        ) from error


def _describe(metadata: dict[str, Any]) -> Description:
    """The description of the network from the file's metadata, in which null stands for nan.

    Raises:
        KeyError, TypeError, ValueError, InputError: the metadata are incomplete or wrong.
    """
    values = [*metadata["typical_step"], metadata["least_filled"], metadata["period"]]
    x, y, heading, filled, period = (np.nan if value is None else float(value) for value in values)
    warping = Warping(**metadata["warping"]) if metadata.get("warping") else None
    change = [
        np.nan if value is None else float(value) for value in metadata.get("typical_change", [None] * 3)
    ]
    return Description(
        Sensor(**metadata["sensor"]),
        (x, y, heading),
        filled,
        period,
        warping,
        (change[0], change[1], change[2]),
    )
