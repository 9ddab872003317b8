"""Exports a trained model to ONNX: the graph computes one step from one pair of scans and the state."""

import json
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from rcnn_odom import __version__
from rcnn_odom.errors import InputError
from rcnn_odom.files import write_atomically
from rcnn_odom.geometry import FloatArray
from rcnn_odom.models.contract import Stepper
from rcnn_odom.models.onnx_stepper import FORMAT, METADATA, OnnxStepper
from rcnn_odom.models.trained import TorchStepper, TrainedModel

if TYPE_CHECKING:
    import onnx

CHANNEL_BLOCK = 16
"""Channels that ONNX Runtime's convolutions process at once with AVX-512; with other processors fewer."""
SCALE_BLOCK = 128
"""Number of int8 weights with a common scale."""
CHECKED_STEPS = 20
"""Number of consecutive steps that are compared; an error in the state does not show in the first step."""
TOLERANCE = {"fp32": 1e-4, "int8": 0.05}
"""Largest difference from the checkpoint, in units of a typical step and a typical turn of the training. For
int8 it only detects broken files; the drift shows the accuracy."""

ABOUT = """Odometry from a 2D laser: the step between two consecutive scans.
Inputs: scans (1, 2, {bins}) float32, the depth vectors of the earlier and the later scan in metres{state_in}.
Outputs: step (1, 3), where the later scan was taken, in the frame of the earlier one: x ahead and y to the
left in metres and the counter-clockwise change of heading in radians; covariance (1, 3, 3), that of step, nan
where unknown{state_out}.
Depth vector: bin i of {bins} is centred on i * {resolution_deg} + {first_deg} degrees from straight ahead,
counter-clockwise, and {resolution_deg} degrees wide; it holds the mean range of the returns in it in metres,
0 where there is none. Readings of {max_range} m or more, not positive or not finite are no returns.{circle}
Poses, from x = y = heading = 0: x += cos(heading) * step_x - sin(heading) * step_y;
y += sin(heading) * step_x + cos(heading) * step_y; heading += step_heading.
int8 files need ONNX Runtime, which has the operator MatMulNBits.
The metadata "{key}" holds the sensor and what else an odometer needs, as JSON."""


RESIDUAL = """
This network measures residual motions. Its two depth vectors are drawn: their bins hold the range at which
the middle of each meets the surfaces of a scan, and the earlier scan is seen from where the later one is
expected. step is then where the later scan was taken, seen from there. rcnn_odom.models.warping does so."""


class _Step(nn.Module):
    """The computation of the exported graph."""

    def __init__(self, model: TrainedModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, scans: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Step (1, 3), its covariance (1, 3, 3) and the next state, from scans (1, 2, bins) and the state."""
        steps, covariances, after = self.model(scans[None], state)
        return steps[0], covariances[0], *after


def to_onnx(model: TrainedModel, precision: str) -> "onnx.ModelProto":
    """Converts one step of a trained model to an ONNX graph, with the metadata that its users need.

    Args:
        model: a model in evaluation mode on the CPU.
        precision: ``fp32`` or ``int8``. With ``int8`` the weights of all matrix products have 8 bits, with
            one scale for ``SCALE_BLOCK`` inputs. The convolutions have few weights and stay in fp32.
    """
    graph = _trace(model)
    if precision == "int8":
        graph = _quantize(graph)
    else:
        _matmul_to_convolution(graph)
    _describe(graph, model)
    write_metadata(graph, _metadata(model) | {"precision": precision})
    return graph


def write(graph: "onnx.ModelProto", path: Path) -> None:
    """Writes the file completely or not at all.

    Raises:
        InputError: the file cannot be written.
    """
    try:
        write_atomically(path, graph.SerializeToString())
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from error


def write_metadata(model: "onnx.ModelProto", content: dict[str, Any]) -> None:
    """Stores plain values in the metadata of the file."""
    from onnx import helper

    helper.set_model_props(model, {METADATA: json.dumps(content), "about": model.doc_string})


def compare_with_model(stepper: OnnxStepper, model: TrainedModel) -> None:
    """Compares a graph with its model over consecutive random scans: steps and covariances.

    Raises:
        InputError: the difference is above ``TOLERANCE``.
    """
    rng = np.random.default_rng(0)
    sensor = model.describe().input_sensor
    scans = rng.uniform(0, sensor.max_range, (CHECKED_STEPS + 1, sensor.bins))
    scans[rng.random(scans.shape) < 0.5] = 0
    pairs = [scans[frame : frame + 2].astype(np.float32) for frame in range(CHECKED_STEPS)]
    got, expected = (_stream(each, pairs) for each in (stepper, TorchStepper(model)))
    difference = _difference(got, expected, np.array(model.describe().typical_step))
    precision = stepper.metadata["precision"]
    if not difference <= TOLERANCE[precision]:
        raise InputError(
            f"the {precision} graph differs from its checkpoint by {difference:.2g} of a typical step of the "
            f"training, more than {TOLERANCE[precision]:g}; it is not written"
        )


def _difference(got: FloatArray, expected: FloatArray, typical: FloatArray) -> float:
    """The largest difference between steps (N, 3, 4) of :func:`_stream`, relative to typical steps (3,).

    It is inf if a value is known (not nan) in only one of them.
    """
    known = np.isfinite(expected)
    known[..., 0] = True  # A step must not be nan.
    if (np.isfinite(got) != known).any():
        return float("inf")
    # x and y have a common scale, since a robot may hardly move sideways.
    metres = np.sqrt(np.nansum(np.square(typical[:2])))
    units = np.array([metres, metres, typical[2]])
    units = np.where(units > 0, units, 1.0)
    # An error e of a standard deviation s changes the variance by about 2 s e.
    deviations = np.sqrt(np.abs(np.nan_to_num(np.diagonal(expected[..., 1:], axis1=1, axis2=2))))
    scales = np.empty_like(expected)
    scales[..., 0] = units
    scales[..., 1:] = np.outer(units, units) + deviations[:, :, None] * deviations[:, None, :]
    return float(np.max((np.abs(got - expected) / scales)[known]))


def _stream(stepper: Stepper, pairs: list[Any]) -> FloatArray:
    """Streams pairs of scans; returns (N, 3, 4): x, y, heading in the first column, then the covariance."""
    stepper.reset()
    steps = [stepper(pair) for pair in pairs]
    return np.array([np.column_stack([step.array(), step.covariance]) for step in steps])


def _trace(model: TrainedModel) -> "onnx.ModelProto":
    """Traces the graph in fp32; every matrix product becomes a ``MatMul`` with constant weights."""
    # Cloned, since two states that share one tensor of zeros would become one input.
    state = {name: value.clone() for name, value in model.initial_state().items()}
    arguments = torch.zeros(1, 2, model.describe().input_sensor.bins), *state.values()
    outputs = ["step", "covariance", *(f"{name}_out" for name in state)]
    with _suppress_output(), torch.no_grad():
        program = torch.onnx.export(
            _Step(model).eval(), arguments, dynamo=True, input_names=["scans", *state], output_names=outputs
        )
    assert program is not None
    graph = program.model_proto
    _gemm_to_matmul(graph)
    return graph


def _quantize(model: "onnx.ModelProto") -> "onnx.ModelProto":
    """Converts the weights of all matrix products to 8 bits."""
    # Quantizing the few weights of the uncertainty has no benefit.
    small = {
        weight.name for weight in model.graph.initializer if weight.dims and weight.dims[0] < CHANNEL_BLOCK
    }
    with _suppress_output():
        from onnxruntime.quantization.matmul_nbits_quantizer import MatMulNBitsQuantizer

        quantizer = MatMulNBitsQuantizer(
            model,
            block_size=SCALE_BLOCK,
            is_symmetric=True,
            accuracy_level=4,  # Products are computed in int8, too.
            nodes_to_exclude=[node.name for node in model.graph.node if small & set(node.input)],
            bits=8,
        )
        quantizer.process()
    return quantizer.model.model


def _gemm_to_matmul(model: "onnx.ModelProto") -> None:
    """Converts ``Gemm(x, W transposed)`` to ``MatMul``, the only operator whose weights can be quantized."""
    from onnx import numpy_helper

    weights = {weight.name: weight for weight in model.graph.initializer}
    for node in model.graph.node:
        if node.op_type == "Gemm" and len(node.input) == 2:
            assert any(each.name == "transB" and each.i for each in node.attribute), node.name
            weight = weights[node.input[1]]
            turned = np.ascontiguousarray(numpy_helper.to_array(weight).T)
            weight.CopyFrom(numpy_helper.from_array(turned, weight.name))
            node.op_type = "MatMul"
            del node.attribute[:]


def _matmul_to_convolution(model: "onnx.ModelProto") -> None:
    """Converts large matrix-vector products to convolutions with kernels of size 1.

    The result is the same, but ONNX Runtime reads the weights faster: 9.3 instead of 11.0 ms for 14,464 x
    4,096 weights on two cores of an AMD EPYC, where reading alone takes 8.2 ms.
    """
    graph = model.graph
    weights = {weight.name: weight for weight in graph.initializer}
    ranks = {value.name: len(value.type.tensor_type.shape.dim) for value in graph.value_info}
    nodes = []
    for node in graph.node:
        weight = weights.get(node.input[1]) if node.op_type == "MatMul" else None
        if weight is None or len(weight.dims) != 2 or weight.dims[1] % CHANNEL_BLOCK:
            nodes.append(node)
            continue
        nodes += _point_convolution(node, weight, graph.initializer, ranks[node.output[0]])
    del graph.node[:]
    graph.node.extend(nodes)


def _point_convolution(node: Any, weight: Any, constants: Any, rank: int) -> list[Any]:
    """The nodes that replace one product, whose weights (inputs, outputs) become a kernel.

    Args:
        node: the ``MatMul`` node.
        weight: its weights in the graph; changed in place.
        constants: the constants of the graph, to which some are added.
        rank: number of dimensions of the product.
    """
    from onnx import helper, numpy_helper

    (inputs, outputs), name = weight.dims, weight.name
    padding = -inputs % CHANNEL_BLOCK
    kernel = np.pad(numpy_helper.to_array(weight), ((0, padding), (0, 0))).T[..., None, None]
    weight.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(kernel), name))
    shapes = {"image": np.array([1, inputs, 1, 1]), "row": np.array([1] * (rank - 1) + [outputs])}
    constants.extend(numpy_helper.from_array(value, f"{name}_{key}") for key, value in shapes.items())
    image = f"{name}_x"
    nodes = [helper.make_node("Reshape", [node.input[0], f"{name}_image"], [image])]
    if padding:
        zeros = np.zeros((1, padding, 1, 1), np.float32)
        constants.append(numpy_helper.from_array(zeros, f"{name}_zeros"))
        nodes.append(helper.make_node("Concat", [image, f"{name}_zeros"], [f"{name}_padded"], axis=1))
        image = f"{name}_padded"
    nodes.append(helper.make_node("Conv", [image, name], [f"{name}_y"]))
    nodes.append(helper.make_node("Reshape", [f"{name}_y", f"{name}_row"], list(node.output)))
    return nodes


def _describe(graph: "onnx.ModelProto", model: TrainedModel) -> None:
    """Writes a description of inputs and outputs into the graph."""
    described = model.describe()
    sensor, state = described.input_sensor, model.initial_state()
    names = " and ".join(f"{name} {tuple(value.shape)}" for name, value in state.items())
    after = " and ".join(f"{name}_out" for name in state)
    graph.doc_string = ABOUT.format(
        **sensor.as_dict(),
        bins=sensor.bins,
        first_deg=sensor.first_bin_deg,
        state_in=f"; {names}, the network's state, zeros at first" if state else "",
        state_out=f"; {after}, the state for the next step" if state else "",
        circle=" The last bin repeats the first." if sensor.field_of_view_deg == 360 else "",
        key=METADATA,
    )
    if described.warping is not None:
        graph.doc_string += RESIDUAL
    graph.producer_name, graph.producer_version = "rcnn-odom", __version__
    for node in graph.graph.node:  # Places in the source code of this project.
        del node.metadata_props[:]


def _metadata(model: TrainedModel) -> dict[str, Any]:
    """The metadata of a model as plain values."""
    # JSON has no nan, so it becomes null.
    description = json.loads(json.dumps(asdict(model.describe())), parse_constant=lambda _: None)
    return {"version": __version__, "variant": model.name, "format": FORMAT, **description}


@contextmanager
def _suppress_output() -> Iterator[None]:
    """Suppresses messages of the exporter and the quantizer."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)
        # Importing the quantizer changes the logging of the whole program.
        root.handlers[:] = handlers
        root.setLevel(level)
