"""A trained network as an ONNX file: one pair of scans in, one motion out, the LSTM's state explicit."""

import json
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from rcnn_odom import __version__
from rcnn_odom.deployment.onnx_model import METADATA, OnnxStepper
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import STEP_FRACTION
from rcnn_odom.models.networks import RCNN
from rcnn_odom.training.checkpoint_stepper import CheckpointStepper, describe
from rcnn_odom.training.modules import OdometryModule

if TYPE_CHECKING:
    import onnx

LANES = 16
"""Channels that ONNX Runtime's convolutions take at once with AVX-512, a multiple of other processors'."""
BLOCK = 128
"""Weights that share a scale in int8."""
CHECKED_STEPS = 20
"""Streamed steps that are compared: states that are mixed up agree on the first one."""
TOLERANCE = {"fp32": 1e-4, "int8": 0.05}
"""Largest difference from the checkpoint, in standard deviations of the training motions. That of int8 is
there to notice broken files; what int8 costs is told by the drift."""

ABOUT = """Odometry from a 2D laser: the motion between two consecutive scans.
Inputs: scans (1, 2, {bins}) float32, the depth vectors of the earlier and the later scan in metres{state_in}.
Outputs: motion (1, 2), the distance in metres (negative: backwards) and the counter-clockwise change of
heading in radians from the earlier to the later scan; deviation (1, 2), their standard deviations, nan where
unknown{state_out}.
Depth vector: bin i of {bins} is centred on i * {resolution_deg} - {half_deg} degrees from straight ahead,
counter-clockwise, and {resolution_deg} degrees wide; it holds the mean range of the returns in it in metres,
0 where there is none. Readings of {max_range} m or more, not positive or not finite are no returns.{circle}
Poses, from x = y = heading = 0: direction = heading + {fraction} * turn; x += distance * cos(direction);
y += distance * sin(direction); heading += turn.
int8 files need ONNX Runtime, which has the operator MatMulNBits.
The metadata "{key}" holds the sensor and what else an odometer needs, as JSON."""


class _Step(nn.Module):
    """What the file computes."""

    def __init__(self, module: OdometryModule) -> None:
        super().__init__()
        self.network, self.uncertainty = module.network, module.uncertainty

    def forward(self, scans: Tensor, *states: Tensor) -> tuple[Tensor, ...]:
        """Motion and deviation (1, 2) of scans (1, 2, bins); with h and c (layers, 1, hidden) these too."""
        before = tuple(zip(*states, strict=True)) if states else None
        estimate, after = self.network(scans[None], before)
        deviation = self.uncertainty(estimate, self.network.head)
        outputs = estimate.motion[0], deviation[0]
        return outputs if after is None else (*outputs, *map(torch.stack, zip(*after, strict=True)))


def to_onnx(module: OdometryModule, precision: str) -> "onnx.ModelProto":
    """The graph of one step of a trained module, with all that its user has to know.

    Args:
        module: in evaluation mode.
        precision: ``fp32``, or ``int8``: the weights of all products in 8 bits, those of ``BLOCK`` inputs
            under one scale; the convolutions, whose weights are few, stay in fp32.
    """
    model = _trace(module)
    if precision == "int8":
        model = _quantize(model)
    else:
        _matmul_to_convolution(model)
    _describe(model, module)
    write_metadata(model, _metadata(module) | {"precision": precision})
    return model


def write(model: "onnx.ModelProto", path: Path) -> None:
    """Writes the file, whole or not at all.

    Raises:
        InputError: it cannot be written.
    """
    partial = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(model.SerializeToString())
        partial.replace(path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from error


def write_metadata(model: "onnx.ModelProto", content: dict[str, Any]) -> None:
    """Plain values as what the file tells of itself."""
    from onnx import helper

    helper.set_model_props(model, {METADATA: json.dumps(content), "about": model.doc_string})


def check(stepper: OnnxStepper, module: OdometryModule) -> None:
    """Compares a graph with its module over steps of random scans with a carried state, deviations too.

    Raises:
        InputError: it does not do what the module does.
    """
    rng = np.random.default_rng(0)
    scans = rng.uniform(0, module.sensor.max_range, (CHECKED_STEPS + 1, module.sensor.bins))
    scans[rng.random(scans.shape) < 0.5] = 0
    pairs = [scans[frame : frame + 2].astype(np.float32) for frame in range(CHECKED_STEPS)]
    reference, precision = CheckpointStepper(module), stepper.metadata["precision"]
    stepper.reset()
    got, expected = (np.array([step(pair) for pair in pairs]) for step in (stepper, reference))
    stepper.reset()
    if not module.uncertainty.fitted:
        got, expected = got[:, :1], expected[:, :1]
    difference = float(np.max(np.abs(got - expected) / module.network.head.deviation.numpy()))
    if not difference <= TOLERANCE[precision]:
        raise InputError(
            f"the {precision} graph differs from its checkpoint by {difference:.2g} deviations of the "
            f"training motions, more than {TOLERANCE[precision]:g}; it is not written"
        )


def _trace(module: OdometryModule) -> "onnx.ModelProto":
    """The graph in fp32, every product a ``MatMul`` with its weights."""
    names, arguments = ["scans"], [torch.zeros(1, 2, module.sensor.bins)]
    if isinstance(module.network, RCNN):
        lstm = module.network.lstm
        shape = len(lstm.weight_ih), 1, lstm.hidden
        names, arguments = [*names, "h", "c"], [*arguments, torch.zeros(shape), torch.ones(shape)]
    outputs = ["motion", "deviation", *(f"{name}_out" for name in names[1:])]
    with _quiet(), torch.no_grad():
        program = torch.onnx.export(
            _Step(module).eval(), tuple(arguments), dynamo=True, input_names=names, output_names=outputs
        )
    assert program is not None
    model = program.model_proto
    _gemm_to_matmul(model)
    return model


def _quantize(model: "onnx.ModelProto") -> "onnx.ModelProto":
    """The same graph with the weights of all products in 8 bits."""
    # The uncertainty's few weights would be quantized for nothing.
    few = {weight.name for weight in model.graph.initializer if weight.dims and weight.dims[0] < LANES}
    with _quiet():
        from onnxruntime.quantization.matmul_nbits_quantizer import MatMulNBitsQuantizer

        quantizer = MatMulNBitsQuantizer(
            model,
            block_size=BLOCK,
            is_symmetric=True,
            accuracy_level=4,  # multiplies in int8 as well
            nodes_to_exclude=[node.name for node in model.graph.node if few & set(node.input)],
            bits=8,
        )
        quantizer.process()
    return quantizer.model.model


def _gemm_to_matmul(model: "onnx.ModelProto") -> None:
    """Turns ``Gemm(x, W transposed)`` into ``MatMul``, the only one whose weights can be quantized."""
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
    """Turns products of one row with many weights into convolutions of one point.

    They are the same, but ONNX Runtime's kernel for them reads the weights faster: 9.3 against 11.0 ms for
    14,464 x 4,096 on two cores of an AMD EPYC, where reading alone takes 8.2.
    """
    graph = model.graph
    weights = {weight.name: weight for weight in graph.initializer}
    ranks = {value.name: len(value.type.tensor_type.shape.dim) for value in graph.value_info}
    nodes = []
    for node in graph.node:
        weight = weights.get(node.input[1]) if node.op_type == "MatMul" else None
        if weight is None or len(weight.dims) != 2 or weight.dims[1] % LANES:
            nodes.append(node)
            continue
        nodes += _point_convolution(node, weight, graph.initializer, ranks[node.output[0]])
    del graph.node[:]
    graph.node.extend(nodes)


def _point_convolution(node: Any, weight: Any, constants: Any, rank: int) -> list[Any]:
    """The nodes in place of one product, whose weights (inputs, outputs) become a kernel.

    Args:
        node: the ``MatMul``.
        weight: its weights in the graph.
        constants: of the graph, to be added to.
        rank: of the product's result.
    """
    from onnx import helper, numpy_helper

    (inputs, outputs), name = weight.dims, weight.name
    padding = -inputs % LANES
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


def _describe(model: "onnx.ModelProto", module: OdometryModule) -> None:
    """In words what goes in and comes out."""
    sensor, shapes = module.sensor, [i.type.tensor_type.shape.dim for i in model.graph.input]
    recurrent = isinstance(module.network, RCNN)
    shape = tuple(dim.dim_value for dim in shapes[-1])
    model.doc_string = ABOUT.format(
        **sensor.as_dict(),
        bins=sensor.bins,
        half_deg=sensor.field_of_view_deg / 2,
        state_in=f"; h and c {shape}, the LSTM's state, zeros at first" if recurrent else "",
        state_out="; h_out and c_out, the state for the next step" if recurrent else "",
        circle=" The last bin repeats the first." if sensor.field_of_view_deg == 360 else "",
        fraction=STEP_FRACTION[module.scoring["apply"]],
        key=METADATA,
    )
    model.producer_name, model.producer_version = "rcnn-odom", __version__
    for node in model.graph.node:  # where each came from in this project's code, of no use to others
        del node.metadata_props[:]


def _metadata(module: OdometryModule) -> dict[str, Any]:
    described = asdict(describe(module))  # JSON has no nan
    described = {key: None if value != value else value for key, value in described.items()}
    return {"version": __version__, "variant": module.variant, **described}


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps what exporter and quantizer say of their own steps off the terminal."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)
        # The quantizer's module sets up logging for the whole program when it is imported.
        root.handlers[:] = handlers
        root.setLevel(level)
