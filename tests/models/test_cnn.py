"""Encoder and heads: table I by hand, and every layer against PyTorch's own."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from odometry import build
from rcnn_odom.models.cnn import Encoder, MotionHead, RotationClasses
from rcnn_odom.models.encoding import Sensor

torch.set_num_threads(1)
BINS = 181
PAPER = RotationClasses(112, 0.1)

TABLE = [
    # layer, parameters, channels and length of the output for 3,601 bins
    ("conv1", 2 * 32 * 3 + 32, (32, 3601)),
    ("conv2", 32 * 32 * 3 + 32, (32, 1801)),
    ("pool1", 0, (32, 900)),
    ("conv3", 32 * 64 * 3 + 64, (64, 900)),
    ("conv4", 64 * 64 * 3 + 64, (64, 450)),
    ("pool2", 0, (64, 225)),
    ("conv5", 64 * 128 * 3 + 128, (128, 225)),
    ("conv6", 128 * 128 * 3 + 128, (128, 113)),
]


def encoder_of(bins, *options):
    """An encoder for so many bins, whose ranges are within 0..1."""
    return Encoder(
        Sensor(1.0 if bins <= 361 else 0.1, (bins - 1) * (1.0 if bins <= 361 else 0.1), 1.0), *options
    )


def layer_outputs(encoder, bins):
    """The sizes (channels, length) after every layer except the ReLUs, in the order of the forward pass."""
    sizes = []
    layers = [layer for layer in encoder.layers if not isinstance(layer, nn.ReLU)]
    for layer in layers:
        layer.register_forward_hook(lambda _, __, output: sizes.append((output.shape[1], output.shape[-1])))
    with torch.no_grad():
        features = encoder(torch.rand(2, 2, bins))
    return layers, sizes, features


def plain_encoder(encoder, kernel_size, pooling):
    """Table I in ``nn.Conv1d``, with the encoder's weights."""
    pool = {"avg": nn.AvgPool1d, "max": nn.MaxPool1d}[pooling]
    layers, inputs = [], 2
    for channels in (32, 64, 128):
        layers += [nn.Conv1d(inputs, channels, kernel_size, 1, kernel_size // 2), nn.ReLU()]
        layers += [nn.Conv1d(channels, channels, kernel_size, 2, kernel_size // 2), nn.ReLU(), pool(2)]
        inputs = channels
    plain = nn.Sequential(*layers[:-1], nn.Flatten()).to(next(encoder.parameters()).dtype)
    weights = [value.squeeze(2) if value.dim() == 4 else value for value in encoder.state_dict().values()]
    plain.load_state_dict(dict(zip(plain.state_dict(), weights, strict=True)))
    return plain


def test_encoder_is_table_one():
    encoder = encoder_of(3601)
    layers, sizes, features = layer_outputs(encoder, 3601)
    assert sizes == [size for _, _, size in TABLE]
    assert [sum(p.numel() for p in layer.parameters()) for layer in layers] == [
        count for _, count, _ in TABLE
    ]
    assert [layer.stride[1] for layer in layers if isinstance(layer, nn.Conv2d)] == [1, 2, 1, 2, 1, 2]
    assert sum(isinstance(layer, nn.ReLU) for layer in encoder.layers) == 6
    assert encoder.features == 128 * 113 == 14_464
    assert features.shape == (2, 14_464)
    assert sum(p.numel() for p in encoder.parameters()) == 224 + 3_104 + 6_208 + 12_352 + 24_704 + 49_280


@pytest.mark.parametrize("kernel_size", [3, 5, 7])
@pytest.mark.parametrize("pooling", ["avg", "max"])
def test_sizes_do_not_depend_on_kernel_and_pooling(kernel_size, pooling):
    layers, sizes, _ = layer_outputs(encoder_of(3601, kernel_size, pooling), 3601)
    assert sizes == [size for _, _, size in TABLE]
    assert {layer.kernel_size for layer in layers if isinstance(layer, nn.Conv2d)} == {(1, kernel_size)}
    kinds = {type(layer) for layer in layers} - {nn.Conv2d}
    assert kinds == {nn.AvgPool2d if pooling == "avg" else nn.MaxPool2d}


@pytest.mark.parametrize("bins", [13, 64, 181, 182, 183, 184, 361, 721])
def test_features_fit_any_sensor(bins):
    encoder = encoder_of(bins)
    assert layer_outputs(encoder, bins)[2].shape == (2, encoder.features)


@pytest.mark.parametrize("bins", [BINS, 184])
@pytest.mark.parametrize(("kernel_size", "pooling"), [(3, "avg"), (5, "avg"), (7, "max"), (3, "max")])
def test_encoder_equals_plain_convolutions(bins, kernel_size, pooling):
    torch.manual_seed(0)
    encoder = encoder_of(bins, kernel_size, pooling).double()
    for parameter in encoder.parameters():
        nn.init.normal_(parameter, std=0.2)
    plain = plain_encoder(encoder, kernel_size, pooling)
    pairs = torch.rand(5, 2, bins, dtype=torch.float64)
    output, expected = encoder(pairs), plain(pairs)
    torch.testing.assert_close(output, expected, rtol=1e-9, atol=1e-9)
    output.square().mean().backward()
    expected.square().mean().backward()
    for own, other in zip(encoder.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(own.grad.squeeze(), other.grad.squeeze(), rtol=1e-9, atol=1e-9)


def test_order_of_the_scans_matters():
    pairs = torch.rand(1, 2, BINS)
    encoder = encoder_of(BINS)
    assert not torch.allclose(encoder(pairs), encoder(pairs.flip(1)))


def test_heads_have_1_or_112_outputs():
    features = torch.rand(3, 4, 20)
    regression, classification = (MotionHead(20, c, "expectation") for c in (None, PAPER))
    assert regression(features).motion.shape == classification(features).motion.shape == (3, 4, 2)
    assert regression(features).scores is None
    assert regression.rotation.weight.shape == (1, 20)
    assert classification(features).scores.shape == (3, 4, 112)
    assert classification.rotation.weight.shape == (112, 20)


def test_regression_head_is_linear_in_units_of_the_training_set():
    head = MotionHead(6, None, "expectation")
    head.mean.copy_(torch.tensor([0.9, 0.01]))
    head.deviation.copy_(torch.tensor([0.3, 0.02]))
    features = torch.randn(5, 6)
    weight = torch.cat([head.distance.weight, head.rotation.weight]).detach().numpy()
    bias = torch.cat([head.distance.bias, head.rotation.bias]).detach().numpy()
    standard = features.numpy() @ weight.T + bias
    motion = head(features).motion
    np.testing.assert_allclose(motion.detach(), standard * [0.3, 0.02] + [0.9, 0.01], atol=1e-6)
    np.testing.assert_allclose(head.standardise(motion).detach(), standard, atol=1e-5)


@pytest.mark.parametrize("angle", ["expectation", "argmax"])
def test_class_scores_become_an_angle(angle):
    head = MotionHead(6, PAPER, angle)
    features = 10 * torch.randn(9, 6)
    estimate = head(features)
    scores = estimate.scores.detach().double().numpy()
    centres = np.deg2rad(-5.55 + 0.1 * np.arange(112))
    share = np.exp(scores) / np.exp(scores).sum(1, keepdims=True)
    expected = share @ centres if angle == "expectation" else centres[scores.argmax(1)]
    np.testing.assert_allclose(estimate.motion[:, 1].detach(), expected, atol=1e-7)


def test_head_stays_in_full_precision_under_autocast():
    head, features = MotionHead(6, None, "expectation"), torch.randn(5, 6)
    with torch.autocast("cpu", torch.bfloat16):
        under = head(features).motion
    assert under.dtype == torch.float32
    torch.testing.assert_close(under, head(features).motion, rtol=0, atol=0)


def test_classes_cover_5_6_degrees_to_each_side():
    classes = PAPER
    np.testing.assert_allclose(classes.centres(), np.deg2rad(-5.55 + 0.1 * np.arange(112)), atol=1e-12)
    assert classes.width == pytest.approx(math.pi / 1800)


@pytest.mark.parametrize("classes", [PAPER, RotationClasses(112, 0.5), RotationClasses(7, 1.0)])
def test_index_is_the_nearest_centre(classes):
    rng = np.random.default_rng(0)
    degrees = rng.uniform(-1.2, 1.2, 500) * classes.count / 2 * classes.width_deg
    centres = np.deg2rad((np.arange(classes.count) - (classes.count - 1) / 2) * classes.width_deg)
    heading = np.deg2rad(degrees)
    expected = np.abs(heading[:, None] - centres).argmin(1)
    np.testing.assert_array_equal(classes.index(torch.tensor(heading)), expected)
    np.testing.assert_array_equal(classes.index(torch.tensor(heading.reshape(5, 100))).ravel(), expected)


@pytest.mark.parametrize(
    ("degrees", "number"),
    [(0.01, 56), (-0.01, 55), (5.59, 111), (-5.59, 0), (5.61, 111), (-5.61, 0), (90, 111), (-90, 0)],
)
def test_class_by_hand(degrees, number):
    heading = torch.deg2rad(torch.tensor([float(degrees)]))
    assert PAPER.index(heading).tolist() == [number]


def test_headings_outside_are_counted():
    heading = torch.deg2rad(torch.tensor([[0.0, 5.59, -5.59], [5.61, -5.7, 180.0]]))
    assert PAPER.outside(heading).item() == 3


def test_cnn_divides_by_the_range_and_has_no_memory():
    model = build("cnn_reg")
    pairs = 40 * torch.rand(2, 5, 2, BINS)
    estimate, state = model.motions(pairs)
    assert state == ()
    expected = model.head(plain_encoder(model.encoder, 3, "avg")(pairs[1] / 40)).motion
    torch.testing.assert_close(estimate.motion[1], expected, rtol=1e-5, atol=1e-5)


def test_dropout_hides_features_while_training_only():
    pairs = 40 * torch.rand(2, 3, 2, BINS)
    plain, dropping = build("cnn_reg"), build("cnn_reg", dropout=0.5).train()
    expected = plain.motions(pairs)[0].motion
    assert not torch.equal(dropping.motions(pairs)[0].motion, dropping.motions(pairs)[0].motion)
    # Half of the inputs are hidden and the others doubled: the mean stays.
    mean = dropping.motions(pairs.repeat(2000, 1, 1, 1))[0].motion.unflatten(0, (2000, 2)).mean(0)
    torch.testing.assert_close(mean, expected, atol=0.1, rtol=0.05)
    assert torch.equal(dropping.eval().motions(pairs)[0].motion, expected)
