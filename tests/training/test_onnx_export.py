"""Exported networks: the same numbers, usable without this project, refused when broken."""

import json

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import numpy_helper

from odometry import NAMES, build, random_scans
from rcnn_odom.deployment.onnx_model import OnnxStepper
from rcnn_odom.errors import InputError
from rcnn_odom.models.encoding import Sensor, encode
from rcnn_odom.training.checkpoint_stepper import CheckpointStepper
from rcnn_odom.training.onnx_graph import check, to_onnx, write, write_metadata


def steps(stepper, scans):
    pairs = [scans[frame : frame + 2] for frame in range(len(scans) - 1)]
    return np.array([np.concatenate(stepper(pair)) for pair in pairs])


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Paths of one recurrent module in both precisions, and the module."""
    folder, module = tmp_path_factory.mktemp("onnx"), build("rcnn_cls", projection=32)
    for precision in ("fp32", "int8"):
        write(to_onnx(module, precision), folder / f"{precision}.onnx")
    return folder, module


@pytest.mark.parametrize("precision", ["fp32", "int8"])
@pytest.mark.parametrize(("variant", "projection"), [*((name, None) for name in NAMES), ("rcnn_reg", 16)])
def test_streamed_steps_equal_the_checkpoints(variant, projection, precision):
    module = build(variant, projection)
    stepper = OnnxStepper(to_onnx(module, precision).SerializeToString())
    check(stepper, module)
    scans = random_scans(30)
    expected = steps(CheckpointStepper(module), scans)
    # Eight bits leave errors of a few hundredths of what the outputs vary by.
    tolerance = 1e-5 if precision == "fp32" else 0.25 * np.ptp(expected, axis=0)
    got = steps(stepper, scans)
    assert (np.abs(got - expected) <= tolerance).all()
    stepper.reset()
    assert (np.abs(steps(stepper, scans[:2]) - expected[:1]) <= tolerance).all()


def test_the_file_can_be_used_without_this_project(exported):
    folder, module = exported
    session = onnxruntime.InferenceSession(folder / "fp32.onnx")
    meta = session.get_modelmeta()
    told = json.loads(meta.custom_metadata_map["rcnn_odom"])
    sensor = told["sensor"]
    for words in ("Depth vector: bin i of 181", "Readings of 40.0 m or more", "h and c (2, 1, 16)"):
        assert words in meta.description
        assert words in meta.custom_metadata_map["about"]
    rng = np.random.default_rng(0)
    angles, motions, h, c, before = (
        np.deg2rad(rng.uniform(-89, 89, 400)),
        [],
        *np.zeros((2, 2, 1, 16), "f4"),
        None,
    )
    state_of_ours, ours = CheckpointStepper(module), []
    for _ in range(6):
        ranges = rng.uniform(1, 45, 400)
        # As the description says, not with this project's code.
        sums, counts = np.zeros(181), np.zeros(181)
        for angle, distance in zip(np.rad2deg(angles), ranges, strict=True):
            if distance < sensor["max_range"]:
                nearest = round((angle + sensor["field_of_view_deg"] / 2) / sensor["resolution_deg"])
                sums[nearest] += distance
                counts[nearest] += 1
        depth = (sums / np.maximum(counts, 1)).astype(np.float32)
        np.testing.assert_allclose(depth, encode(angles, ranges, Sensor(**sensor)), rtol=1e-6)
        if before is not None:
            pair = np.stack([before, depth])
            motion, deviation, h, c = session.run(None, {"scans": pair[None], "h": h, "c": c})
            motions.append(np.concatenate([motion[0], deviation[0]]))
            ours.append(np.concatenate(state_of_ours(pair)))
        before = depth
    np.testing.assert_allclose(motions, ours, atol=1e-5)


def test_h_and_c_are_states_of_their_own(exported):
    session = onnxruntime.InferenceSession(exported[0] / "fp32.onnx")
    scans = random_scans(2)[None]
    _, _, h, c = session.run(
        None, {"scans": scans, "h": np.zeros((2, 1, 16), "f4"), "c": np.ones((2, 1, 16), "f4")}
    )
    assert np.abs(h - c).max() > 0.1


def test_metadata_says_what_an_odometer_needs(exported):
    for precision in ("fp32", "int8"):
        stepper = OnnxStepper(exported[0] / f"{precision}.onnx")
        assert stepper.metadata["precision"] == precision
        assert stepper.metadata["variant"] == "rcnn_cls"
        description = stepper.description
        assert (description.sensor, description.apply) == (Sensor(1.0, 180.0, 40.0), "middle")
        assert description.typical_motion == pytest.approx((np.hypot(0.5, 0.2), np.hypot(0.01, 0.03)))
        assert description.least_filled == pytest.approx(0.1)


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


def test_a_network_without_fitted_uncertainty_is_exported_without_deviations():
    stepper = OnnxStepper(to_onnx(build(fitted=False), "fp32").SerializeToString())
    motion, deviation = stepper(random_scans(2))
    assert np.isfinite(motion).all()
    assert np.isnan(deviation).all()
    assert np.isnan(stepper.description.least_filled)


def test_a_graph_that_does_something_else_is_noticed():
    module = build()
    model = to_onnx(module, "fp32")
    for weight in model.graph.initializer:
        if weight.name.endswith("head.distance.bias"):
            weight.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(weight) + 0.5, weight.name))
    with pytest.raises(
        InputError, match=r"the fp32 graph differs from its checkpoint by .* it is not written"
    ):
        check(OnnxStepper(model.SerializeToString()), module)


class FromTheThirdStepOn:
    """A stepper that does as another one, and then something else."""

    def __init__(self, module, motion, deviation):
        self.right, self.wrong, self.count = CheckpointStepper(module), (motion, deviation), 0
        self.metadata = {"precision": "fp32"}

    def reset(self):
        self.right.reset()

    def __call__(self, pair):
        self.count += 1
        motion, deviation = self.right(pair)
        return (motion + self.wrong[0], deviation + self.wrong[1]) if self.count > 2 else (motion, deviation)


@pytest.mark.parametrize("wrong", [(np.nan, 0.0), (0.0, np.nan), (0.0, -7.0), (0.1, 0.0)])
def test_wrong_later_steps_and_deviations_are_noticed(wrong):
    module = build()
    check(FromTheThirdStepOn(module, 0.0, 0.0), module)
    with pytest.raises(InputError, match="differs from its checkpoint"):
        check(FromTheThirdStepOn(module, *wrong), module)


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
        ({"apply": "sometimes"}, "not one of rcnn-odom export .*apply is 'sometimes'"),
        ({"typical_motion": [1]}, "not one of rcnn-odom export"),
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
