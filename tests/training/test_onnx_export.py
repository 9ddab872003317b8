"""Exported networks: the same numbers, usable without this project, refused when broken."""

import json

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import numpy_helper

from odometry import NAMES, SENSOR, build, random_scans
from rcnn_odom.errors import InputError
from rcnn_odom.geometry import Step, advance
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.models.onnx_stepper import OnnxStepper
from rcnn_odom.models.trained import TorchStepper, TrainedModel
from rcnn_odom.training.onnx_graph import compare_with_model, to_onnx, write, write_metadata


def steps(stepper, scans):
    """Steps and covariances from the beginning on, side by side, (N, 12)."""
    stepper.reset()
    told = [stepper(scans[frame : frame + 2]) for frame in range(len(scans) - 1)]
    return np.array([np.concatenate([step.array(), step.covariance.ravel()]) for step in told])


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Paths of one recurrent model in both precisions, and the model."""
    folder, model = tmp_path_factory.mktemp("onnx"), build("rcnn_cls", projection=32)
    for precision in ("fp32", "int8"):
        write(to_onnx(model, precision), folder / f"{precision}.onnx")
    return folder, model


@pytest.mark.parametrize("precision", ["fp32", pytest.param("int8", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("variant", "projection"),
    [("rcnn_reg", 16), *(pytest.param(name, None, marks=pytest.mark.slow) for name in NAMES)],
)
def test_streamed_steps_equal_the_checkpoints(variant, projection, precision):
    model = build(variant, projection)
    stepper = OnnxStepper(to_onnx(model, precision).SerializeToString())
    compare_with_model(stepper, model)
    scans = random_scans(30)
    expected = steps(TorchStepper(model), scans)
    # Eight bits leave errors of a few hundredths of what the outputs vary by.
    tolerance = 1e-5 if precision == "fp32" else 0.25 * np.ptp(expected, axis=0)
    got = steps(stepper, scans)
    assert (np.abs(got - expected) <= tolerance).all()
    assert (np.abs(steps(stepper, scans[:2]) - expected[:1]) <= tolerance).all()


@pytest.mark.slow
def test_the_file_can_be_used_without_this_project(exported):
    folder, model = exported
    # What follows is a stranger's program, who has read the description and has NumPy and ONNX Runtime.
    session = onnxruntime.InferenceSession(folder / "fp32.onnx")
    sensor = json.loads(session.get_modelmeta().custom_metadata_map["rcnn_odom"])["sensor"]
    state = {i.name: np.zeros(i.shape, np.float32) for i in session.get_inputs() if i.name != "scans"}
    rng = np.random.default_rng(0)
    angles, before = np.deg2rad(rng.uniform(-89, 89, 400)), None
    x = y = heading = 0.0
    depths, poses = [], []
    for _ in range(6):
        ranges = rng.uniform(1, 45, 400)
        sums, counts = np.zeros(181), np.zeros(181)
        for angle, distance in zip(np.rad2deg(angles), ranges, strict=True):
            if distance < sensor["max_range"]:
                nearest = round((angle + sensor["field_of_view_deg"] / 2) / sensor["resolution_deg"])
                sums[nearest] += distance
                counts[nearest] += 1
        depth = (sums / np.maximum(counts, 1)).astype(np.float32)
        if before is not None:
            step, _, h, c = session.run(None, {"scans": np.stack([before, depth])[None], **state})
            state, (step_x, step_y, step_heading) = {"h": h, "c": c}, step[0]
            x += np.cos(heading) * step_x - np.sin(heading) * step_y
            y += np.sin(heading) * step_x + np.cos(heading) * step_y
            heading += step_heading
            poses.append([x, y, heading])
        before = depth
        np.testing.assert_allclose(depth, encode(angles, ranges, Sensor(**sensor)), rtol=1e-6)
        depths.append(depth)
    expected = [np.zeros(3)]
    for step in steps(TorchStepper(model), np.array(depths)):
        expected.append(advance(expected[-1], step[:3]))
    np.testing.assert_allclose(poses, expected[1:], atol=1e-5)


def test_the_file_describes_itself(exported):
    meta = onnxruntime.InferenceSession(exported[0] / "fp32.onnx").get_modelmeta()
    assert meta.description == meta.custom_metadata_map["about"]
    for words in (
        "Depth vector: bin i of 181",
        "Readings of 40.0 m or more",
        "h (2, 1, 16) and c (2, 1, 16), the network's state",
        "x += cos(heading) * step_x - sin(heading) * step_y",
        "covariance (1, 3, 3)",
    ):
        assert words in meta.description


def test_h_and_c_are_states_of_their_own(exported):
    session = onnxruntime.InferenceSession(exported[0] / "fp32.onnx")
    scans, zeros, ones = random_scans(2)[None], np.zeros((2, 1, 16), "f4"), np.ones((2, 1, 16), "f4")
    steps_, _, h, c = session.run(None, {"scans": scans, "h": zeros, "c": ones})
    assert np.abs(h - c).max() > 0.1
    for other in ({"h": ones, "c": ones}, {"h": zeros, "c": zeros}):
        assert np.abs(session.run(["step"], {"scans": scans, **other})[0] - steps_).max() > 1e-4


def test_metadata_says_what_an_odometer_needs(exported):
    for precision in ("fp32", "int8"):
        stepper = OnnxStepper(exported[0] / f"{precision}.onnx")
        assert stepper.metadata["precision"] == precision
        assert stepper.metadata["variant"] == "rcnn_cls"
        assert stepper.metadata["format"] == 2
        description, model = stepper.description, exported[1]
        assert description.sensor == SENSOR
        assert description.typical_step == pytest.approx(model.typical_step.tolist())
        assert description.typical_step[2] == pytest.approx(np.hypot(0.01, 0.03))
        assert (description.least_filled, description.period) == pytest.approx((0.1, 0.1))


def test_int8_holds_the_weights_of_all_products_in_a_byte(exported):
    kinds = {
        precision: [node.op_type for node in onnx.load(exported[0] / f"{precision}.onnx").graph.node]
        for precision in ("fp32", "int8")
    }
    # Two heads of the first stage, the projection, four products of two LSTM layers, two of the head.
    assert kinds["int8"].count("MatMulNBits") == 9
    assert "Gemm" not in kinds["int8"]
    graph = onnx.load(exported[0] / "int8.onnx").graph
    large = [
        w for w in graph.initializer if w.data_type == onnx.TensorProto.FLOAT and np.prod(w.dims) > 50_000
    ]
    assert not large


def test_a_network_without_fitted_uncertainty_is_exported_without_covariances():
    stepper = OnnxStepper(to_onnx(build(fitted=False), "fp32").SerializeToString())
    step = stepper(random_scans(2))
    assert np.isfinite(step.array()).all()
    assert np.isnan(step.covariance).all()
    assert np.isnan(stepper.description.least_filled)


def test_an_unknown_deviation_across_the_step_leaves_that_of_the_heading():
    """As of checkpoints that knew distance and heading alone; of their typical step y is not known either."""
    model = build()
    known = TorchStepper(model)(random_scans(2)).covariance[2, 2]
    model.uncertainty.lateral.fill_(np.nan)
    model.typical_step[1] = np.nan
    graph = to_onnx(model, "fp32")
    stepper = OnnxStepper(graph.SerializeToString())
    compare_with_model(stepper, model)
    assert json.loads({p.key: p.value for p in graph.metadata_props}["rcnn_odom"])["typical_step"][1] is None
    stepper.reset()
    covariance = stepper(random_scans(2)).covariance
    assert covariance[2, 2] == pytest.approx(known)
    assert np.isnan(covariance[:2, :2]).all()


class Toy(TrainedModel):
    """A network of a plugin: steps that slip sideways, its own covariances, two states with other names."""

    name, Options = "toy", dict

    def __init__(self):
        super().__init__({}, SENSOR)
        self.linear = torch.nn.Linear(2 * SENSOR.bins, 3)

    def initial_state(self):
        same = torch.zeros(1, 3)
        return {"sum": same, "last": same}

    def forward(self, pairs, state=()):
        total, last = state or self.initial_state().values()
        steps = []
        for pair in pairs.flatten(2).unbind(1):
            now = 0.01 * self.linear(pair)
            total, last = total + now, now - last
            steps.append(now + 0.1 * total.tanh() + 0.1 * last)
        steps = torch.stack(steps, 1)
        return steps, torch.diag_embed(steps.square() + 0.01), (total, last)

    def loss(self, batch):
        return {"loss": self(batch["pairs"])[0].sub(batch["steps"]).abs().mean()}


@pytest.mark.parametrize("precision", ["fp32", pytest.param("int8", marks=pytest.mark.slow)])
def test_a_model_of_a_plugin_is_exported_as_any_other(precision):
    torch.manual_seed(0)
    model = Toy().eval()
    graph = to_onnx(model, precision)
    assert [value.name for value in graph.graph.input] == ["scans", "sum", "last"]
    assert [value.name for value in graph.graph.output] == ["step", "covariance", "sum_out", "last_out"]
    stepper = OnnxStepper(graph.SerializeToString())
    compare_with_model(stepper, model)
    scans = random_scans(10)
    tolerance = {"fp32": 1e-5, "int8": 0.02}[precision]
    np.testing.assert_allclose(steps(stepper, scans), steps(TorchStepper(model), scans), atol=tolerance)


def test_a_graph_that_does_something_else_is_noticed():
    model = build()
    graph = to_onnx(model, "fp32")
    for weight in graph.graph.initializer:
        if weight.name.endswith("head.distance.bias"):
            weight.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(weight) + 0.5, weight.name))
    with pytest.raises(
        InputError, match=r"the fp32 graph differs from its checkpoint by .* it is not written"
    ):
        compare_with_model(OnnxStepper(graph.SerializeToString()), model)


class FromTheThirdStepOn:
    """A stepper that does as another one, and then something else."""

    def __init__(self, model, step, covariance):
        self.right, self.wrong, self.count = TorchStepper(model), (step, covariance), 0
        self.metadata = {"precision": "fp32"}

    def reset(self):
        self.right.reset()

    def __call__(self, pair):
        self.count += 1
        step = self.right(pair)
        if self.count <= 2:
            return step
        return Step(*(step.array() + self.wrong[0]), step.covariance + self.wrong[1])


@pytest.mark.parametrize("wrong", [(np.nan, 0.0), (0.0, np.nan), (0.0, -7.0), (0.1, 0.0)])
def test_wrong_later_steps_and_covariances_are_noticed(wrong):
    model = build()
    compare_with_model(FromTheThirdStepOn(model, 0.0, 0.0), model)
    with pytest.raises(InputError, match="differs from its checkpoint"):
        compare_with_model(FromTheThirdStepOn(model, *wrong), model)


def test_a_model_that_estimates_nan_is_noticed():
    model = build()
    model.head.distance.bias.data.fill_(np.nan)
    with pytest.raises(InputError, match="differs from its checkpoint"):
        compare_with_model(FromTheThirdStepOn(model, 0.0, 0.0), model)


def change_metadata(exported, folder, **changes):
    model = onnx.load(exported[0] / "fp32.onnx")
    told = OnnxStepper(exported[0] / "fp32.onnx").metadata | changes
    write_metadata(model, {key: value for key, value in told.items() if value != "gone"})
    write(model, folder / "changed.onnx")
    return folder / "changed.onnx"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor": "gone"}, "not one of rcnn-odom export"),
        ({"sensor": {"resolution_deg": 0.7}}, "not one of rcnn-odom export"),
        ({"typical_step": [1, 2]}, "not one of rcnn-odom export"),
        ({"format": "gone"}, "written by an older version; export the checkpoint again"),
        ({"format": 1}, "written by an older version; export the checkpoint again"),
        ({"sensor": {"resolution_deg": 0.5, "field_of_view_deg": 180.0}}, "differ in the sensor"),
    ],
)
def test_files_with_wrong_metadata_are_refused(exported, tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        OnnxStepper(change_metadata(exported, tmp_path, **changes))


def test_files_that_are_no_onnx_are_refused(exported, tmp_path):
    whole = (exported[0] / "fp32.onnx").read_bytes()
    for content in (b"", b"hello", whole[: len(whole) // 2], np.random.default_rng(0).bytes(5000)):
        (tmp_path / "bad.onnx").write_bytes(content)
        with pytest.raises(InputError, match=r"bad\.onnx: "):
            OnnxStepper(tmp_path / "bad.onnx")
    with pytest.raises(InputError, match="no such file"):
        OnnxStepper(tmp_path / "none.onnx")


def test_a_file_that_cannot_be_written_leaves_the_old_one(exported, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot be written .*choose another --out"):
        write(onnx.load(exported[0] / "fp32.onnx"), tmp_path / "file" / "model.onnx")
    assert (tmp_path / "file").read_text() == ""
