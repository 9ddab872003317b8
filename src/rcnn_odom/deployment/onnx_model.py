"""One pair of scans after the other through an exported network; needs ONNX Runtime and no PyTorch."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from rcnn_odom.deployment.odometer import Description
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import STEP_FRACTION, FloatArray
from rcnn_odom.models.encoding import Sensor

METADATA = "rcnn_odom"
"""Key of the file's metadata that holds all that an odometer has to know, as JSON."""


class OnnxStepper:
    """A file of ``rcnn-odom export`` as a :class:`rcnn_odom.deployment.odometer.Stepper`.

    Args:
        file: its path, or what it holds.
        threads: of the computation.

    Attributes:
        metadata: what the file tells of itself; see :func:`rcnn_odom.training.onnx_graph.write`.

    Raises:
        InputError: no such file, or not one of ``rcnn-odom export``.
    """

    def __init__(self, file: str | Path | bytes, threads: int = 1) -> None:
        self._session = open_session(file, threads)
        path = "the graph" if isinstance(file, bytes) else file
        try:
            self.metadata = json.loads(self._session.get_modelmeta().custom_metadata_map[METADATA])
            self.description = _describe(self.metadata)
        except (KeyError, TypeError, ValueError, InputError) as error:
            raise InputError(
                f"{path}: an ONNX file, but not one of rcnn-odom export ({type(error).__name__}: {error}); "
                "export the checkpoint again"
            ) from error
        inputs = {value.name: value.shape for value in self._session.get_inputs()}
        if inputs["scans"][-1] != self.description.sensor.bins:
            raise InputError(f"{path}: its network and its metadata differ in the sensor; export it again")
        self._empty = {name: np.zeros(shape, np.float32) for name, shape in inputs.items() if name != "scans"}
        self.reset()

    def reset(self) -> None:
        """Forgets all earlier pairs."""
        # An array of its own for h and for c: one for both would make them one state.
        self._state = {name: zeros.copy() for name, zeros in self._empty.items()}

    def __call__(self, pair: npt.NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        """Motion (2,) and its standard deviations (2,) from scans (2, bins) in metres, the earlier first."""
        motion, deviation, *state = self._session.run(None, {"scans": pair[None], **self._state})
        self._state = dict(zip(self._state, state, strict=True))
        return motion[0].astype(np.float64), deviation[0].astype(np.float64)


def open_session(file: str | Path | bytes, threads: int = 1) -> Any:
    """An ``onnxruntime.InferenceSession`` on the CPU.

    Raises:
        InputError: the file cannot be read or is no ONNX graph that ONNX Runtime knows.
    """
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Threads that wait by spinning take the cores from whatever else runs on a robot.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    if not isinstance(file, bytes) and not Path(file).is_file():
        raise InputError(f"{file}: no such file; name one that rcnn-odom export has written")
    source = file if isinstance(file, bytes) else str(file)
    try:
        return onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # whatever the bytes of a stranger's file lead to
        reason = str(error).splitlines()[0].replace(f"{source!s} ", "")
        raise InputError(
            f"{file!s:.200}: no ONNX file that can be run ({reason}); export it again"
        ) from error


def _describe(metadata: dict[str, Any]) -> Description:
    distance, turn = map(float, metadata["typical_motion"])
    apply, sensor = metadata["apply"], Sensor(**metadata["sensor"])
    if apply not in STEP_FRACTION:
        raise ValueError(f"apply is {apply!r}")
    known = (metadata[key] for key in ("least_filled", "period"))
    return Description(
        sensor, apply, (distance, turn), *(float("nan") if v is None else float(v) for v in known)
    )
