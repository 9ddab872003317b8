"""Table I by hand, and every written-out layer against PyTorch's own."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from rcnn_odom.models.networks import CNN, LSTM, RCNN, Encoder, MotionHead, RotationClasses

torch.set_num_threads(1)
BINS = 181

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


def torch_lstm(lstm, inputs, hidden, layers):
    reference = nn.LSTM(inputs, hidden, layers, batch_first=True)
    for layer in range(layers):
        for kind in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
            getattr(reference, f"{kind}_l{layer}").data.copy_(getattr(lstm, kind)[layer].data)
    return reference


def test_encoder_is_table_one():
    encoder = Encoder(3601)
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
    layers, sizes, _ = layer_outputs(Encoder(3601, kernel_size, pooling), 3601)
    assert sizes == [size for _, _, size in TABLE]
    assert {layer.kernel_size for layer in layers if isinstance(layer, nn.Conv2d)} == {(1, kernel_size)}
    kinds = {type(layer) for layer in layers} - {nn.Conv2d}
    assert kinds == {nn.AvgPool2d if pooling == "avg" else nn.MaxPool2d}


@pytest.mark.parametrize("bins", [13, 64, 181, 182, 183, 184, 361, 721])
def test_features_fit_any_sensor(bins):
    encoder = Encoder(bins)
    assert layer_outputs(encoder, bins)[2].shape == (2, encoder.features)


@pytest.mark.parametrize("bins", [BINS, 184])
@pytest.mark.parametrize(("kernel_size", "pooling"), [(3, "avg"), (5, "avg"), (7, "max"), (3, "max")])
def test_encoder_equals_plain_convolutions(bins, kernel_size, pooling):
    torch.manual_seed(0)
    encoder = Encoder(bins, kernel_size, pooling).double()
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
    encoder = Encoder(BINS)
    assert not torch.allclose(encoder(pairs), encoder(pairs.flip(1)))


def test_full_rcnn_has_the_size_of_pytorchs_lstm():
    with torch.device("meta"):
        network = RCNN(CNN(3601, 80.0, RotationClasses()), None)
        reference = nn.LSTM(14_466, 1024, 2)
    count = sum(p.numel() for p in network.lstm.parameters())
    assert count == sum(p.numel() for p in reference.parameters())
    # Four gates; per layer inputs, 1,024 hidden and two biases: 71.85 million.
    assert count == 4 * 1024 * (14_466 + 1024 + 2) + 4 * 1024 * (1024 + 1024 + 2) == 71_852_032
    assert network.head.distance.weight.shape == (1, 1024)
    assert network.head.rotation.weight.shape == (1, 1024)
    assert network.cnn.head.rotation.weight.shape == (112, 14_464)


def test_heads_have_1_or_112_outputs():
    features = torch.rand(3, 4, 20)
    regression, classification = (MotionHead(20, c, "expectation") for c in (None, RotationClasses()))
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
    head = MotionHead(6, RotationClasses(), angle)
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
    classes = RotationClasses()
    np.testing.assert_allclose(classes.centres(), np.deg2rad(-5.55 + 0.1 * np.arange(112)), atol=1e-12)
    assert classes.width == pytest.approx(math.pi / 1800)


@pytest.mark.parametrize("classes", [RotationClasses(), RotationClasses(112, 0.5), RotationClasses(7, 1.0)])
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
    assert RotationClasses().index(heading).tolist() == [number]


def test_headings_outside_are_counted():
    heading = torch.deg2rad(torch.tensor([[0.0, 5.59, -5.59], [5.61, -5.7, 180.0]]))
    assert RotationClasses().outside(heading).item() == 3


@pytest.mark.parametrize("layers", [1, 2, 3])
@pytest.mark.parametrize("carried", [False, True])
def test_lstm_equals_pytorchs(layers, carried):
    torch.manual_seed(0)
    lstm = LSTM(9, 8, layers)
    reference = torch_lstm(lstm, 9, 8, layers)
    inputs = torch.randn(3, 7, 9, requires_grad=True)
    other_inputs = inputs.detach().clone().requires_grad_()
    hidden, cell = torch.randn(2, layers, 3, 8)
    start = (tuple(zip(hidden, cell, strict=True)), (hidden, cell)) if carried else (None, None)
    outputs, state = lstm(inputs, start[0])
    expected, (h, c) = reference(other_inputs, start[1])
    torch.testing.assert_close(outputs, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(torch.stack([layer[0] for layer in state]), h, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(torch.stack([layer[1] for layer in state]), c, rtol=1e-5, atol=1e-6)
    (outputs.square().sum() + state[0][1].sum()).backward()
    (expected.square().sum() + c[0].sum()).backward()
    torch.testing.assert_close(inputs.grad, other_inputs.grad, rtol=1e-5, atol=1e-5)
    for layer in range(layers):
        for kind in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
            own, other = getattr(lstm, kind)[layer].grad, getattr(reference, f"{kind}_l{layer}").grad
            torch.testing.assert_close(own, other, rtol=1e-5, atol=1e-5)


def test_lstm_step_by_step_equals_pytorchs_whole():
    torch.manual_seed(1)
    lstm = LSTM(5, 8, 2)
    inputs = torch.randn(2, 12, 5)
    expected, _ = torch_lstm(lstm, 5, 8, 2)(inputs)
    state = None
    for start, stop in ((0, 1), (1, 2), (2, 7), (7, 12)):
        outputs, state = lstm(inputs[:, start:stop], state)
        torch.testing.assert_close(outputs, expected[:, start:stop], rtol=1e-5, atol=1e-6)


def test_cnn_divides_by_the_range_and_has_no_memory():
    cnn = CNN(BINS, 40.0, None)
    pairs = 40 * torch.rand(2, 5, 2, BINS)
    estimate, state = cnn(pairs)
    assert state is None
    expected = cnn.head(plain_encoder(cnn.encoder, 3, "avg")(pairs[1] / 40)).motion
    torch.testing.assert_close(estimate.motion[1], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("classes", [None, RotationClasses()])
def test_rcnn_is_cnn_lstm_and_head(classes):
    torch.manual_seed(2)
    cnn = CNN(BINS, 40.0, RotationClasses())
    cnn.head.mean.copy_(torch.tensor([0.9, 0.01]))
    cnn.head.deviation.copy_(torch.tensor([0.3, 0.02]))
    network = RCNN(cnn, classes, hidden=12, layers=2)
    pairs = 40 * torch.rand(2, 4, 2, BINS)
    features = plain_encoder(cnn.encoder, 3, "avg")(pairs.flatten(0, 1) / 40)
    first = (cnn.head(features).motion - torch.tensor([0.9, 0.01])) / torch.tensor([0.3, 0.02])
    joined = torch.cat([features, first], 1).unflatten(0, (2, 4))
    outputs, _ = torch_lstm(network.lstm, cnn.encoder.features + 2, 12, 2)(joined)
    expected = network.head(outputs)
    estimate, _ = network(pairs)
    torch.testing.assert_close(estimate.motion, expected.motion, rtol=1e-4, atol=1e-5)
    assert (estimate.scores is None) == (classes is None)


def test_projection_is_an_input_matrix_of_low_rank():
    torch.manual_seed(5)
    cnn = CNN(BINS, 40.0, RotationClasses())
    small = RCNN(cnn, None, hidden=12, projection=6)
    whole = RCNN(cnn, None, hidden=12)
    weights = {name: value for name, value in small.state_dict().items() if "projection" not in name}
    of_features, of_estimates = small.lstm.weight_ih[0].split([6, 2], 1)
    weights["lstm.weight_ih.0"] = torch.cat([of_features @ small.projection.weight, of_estimates], 1)
    weights["lstm.bias_ih.0"] = small.lstm.bias_ih[0] + of_features @ small.projection.bias
    whole.load_state_dict(weights)
    pairs = 40 * torch.rand(2, 4, 2, BINS)
    torch.testing.assert_close(small(pairs)[0].motion, whole(pairs)[0].motion, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("classes", [None, RotationClasses()])
def test_rcnn_pair_by_pair_equals_the_window(classes):
    torch.manual_seed(3)
    network = RCNN(CNN(BINS, 40.0, RotationClasses()), classes, hidden=12, layers=2)
    pairs = 40 * torch.rand(2, 9, 2, BINS)
    whole, after = network(pairs)
    state, steps = None, []
    for number in range(9):
        estimate, state = network(pairs[:, number : number + 1], state)
        steps.append(estimate.motion)
    torch.testing.assert_close(torch.cat(steps, 1), whole.motion, rtol=1e-5, atol=1e-5)
    for own, other in zip(state, after, strict=True):
        torch.testing.assert_close(own, other, rtol=1e-5, atol=1e-5)


def test_rcnn_depends_on_the_pairs_before():
    torch.manual_seed(4)
    network = RCNN(CNN(BINS, 40.0, RotationClasses()), None, hidden=12, layers=2)
    pairs = 40 * torch.rand(1, 3, 2, BINS)
    alone, _ = network(pairs[:, 2:])
    after_two, _ = network(pairs)
    assert not torch.allclose(alone.motion[:, 0], after_two.motion[:, 2], atol=1e-4)


def test_dropout_hides_features_while_training_only():
    torch.manual_seed(0)
    bins, pairs = 361, torch.rand(2, 3, 2, 361)
    for plain, dropping in (
        (CNN(bins, 80.0, None), CNN(bins, 80.0, None, dropout=0.5)),
        (
            RCNN(CNN(bins, 80.0, None), None, hidden=8),
            RCNN(CNN(bins, 80.0, None), None, hidden=8, dropout=0.5),
        ),
    ):
        dropping.load_state_dict(plain.state_dict())
        expected = plain(pairs)[0].motion
        assert not torch.equal(dropping(pairs)[0].motion, dropping(pairs)[0].motion)
        assert torch.equal(dropping.eval()(pairs)[0].motion, expected)
        head = plain.head
        # Half of the inputs are hidden and the others doubled: the mean stays.
        inputs = plain.encode(pairs) if isinstance(plain, CNN) else None
        if inputs is not None:
            dropping.train()
            mean = torch.stack([dropping(pairs)[0].motion for _ in range(2000)]).mean(0)
            torch.testing.assert_close(mean, head(inputs).motion, atol=0.1, rtol=0.05)
