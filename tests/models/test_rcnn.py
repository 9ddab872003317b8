"""The recurrent networks against PyTorch's own layers."""

import logging

import pytest
import torch
from test_cnn import plain_encoder
from torch import nn

from odometry import DEVIATION, MEAN, build, options
from rcnn_odom.errors import InputError
from rcnn_odom.models.contract import find_model
from rcnn_odom.models.encoding import Sensor
from rcnn_odom.models.rcnn import LSTM

torch.set_num_threads(1)
BINS = 181
RECURRENT = ["rcnn_reg", "rcnn_cls"]


def torch_lstm(lstm, inputs, hidden, layers):
    reference = nn.LSTM(inputs, hidden, layers, batch_first=True)
    for layer in range(layers):
        for kind in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"):
            getattr(reference, f"{kind}_l{layer}").data.copy_(getattr(lstm, kind)[layer].data)
    return reference


def test_full_rcnn_has_the_size_of_pytorchs_lstm():
    with torch.device("meta"):
        network = find_model("rcnn_reg")(options(hidden_size=1024), Sensor())
        reference = nn.LSTM(14_466, 1024, 2)
    count = sum(p.numel() for p in network.lstm.parameters())
    assert count == sum(p.numel() for p in reference.parameters())
    # Four gates; per layer inputs, 1,024 hidden and two biases: 71.85 million.
    assert count == 4 * 1024 * (14_466 + 1024 + 2) + 4 * 1024 * (1024 + 1024 + 2) == 71_852_032
    assert network.head.distance.weight.shape == (1, 1024)
    assert network.head.rotation.weight.shape == (1, 1024)
    assert network.cnn.head.rotation.weight.shape == (112, 14_464)


@pytest.mark.parametrize("layers", [1, 2, 3])
@pytest.mark.parametrize("carried", [False, True])
def test_lstm_equals_pytorchs(layers, carried):
    torch.manual_seed(0)
    lstm = LSTM(9, 8, layers)
    reference = torch_lstm(lstm, 9, 8, layers)
    inputs = torch.randn(3, 7, 9, requires_grad=True)
    other_inputs = inputs.detach().clone().requires_grad_()
    hidden, cell = torch.randn(2, layers, 3, 8)
    start = ((hidden, cell), (hidden, cell)) if carried else ((), None)
    outputs, state = lstm(inputs, start[0])
    expected, (h, c) = reference(other_inputs, start[1])
    torch.testing.assert_close(outputs, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(state[0], h, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(state[1], c, rtol=1e-5, atol=1e-6)
    (outputs.square().sum() + state[1][0].sum()).backward()
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
    state = ()
    for start, stop in ((0, 1), (1, 2), (2, 7), (7, 12)):
        outputs, state = lstm(inputs[:, start:stop], state)
        torch.testing.assert_close(outputs, expected[:, start:stop], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("variant", RECURRENT)
def test_rcnn_is_cnn_lstm_and_head(variant):
    network = build(variant, hidden_size=12)
    cnn = network.cnn
    pairs = 40 * torch.rand(2, 4, 2, BINS)
    features = plain_encoder(cnn.encoder, 3, "avg")(pairs.flatten(0, 1) / 40)
    mean, deviation = (torch.tensor(each, dtype=torch.float32) for each in (MEAN, DEVIATION))
    first = (cnn.head(features).motion - mean) / deviation
    joined = torch.cat([features, first], 1).unflatten(0, (2, 4))
    outputs, _ = torch_lstm(network.lstm, cnn.encoder.features + 2, 12, 2)(joined)
    expected = network.head(outputs)
    estimate, _ = network.motions(pairs)
    torch.testing.assert_close(estimate.motion, expected.motion, rtol=1e-4, atol=1e-5)
    assert (estimate.scores is None) == (variant == "rcnn_reg")


def test_projection_is_an_input_matrix_of_low_rank():
    small, whole = build(projection=6), build()
    weights = {name: value for name, value in small.state_dict().items() if "projection" not in name}
    of_features, of_estimates = small.lstm.weight_ih[0].split([6, 2], 1)
    weights["lstm.weight_ih.0"] = torch.cat([of_features @ small.projection.weight, of_estimates], 1)
    weights["lstm.bias_ih.0"] = small.lstm.bias_ih[0] + of_features @ small.projection.bias
    whole.load_state_dict(weights)
    pairs = 40 * torch.rand(2, 4, 2, BINS)
    torch.testing.assert_close(small(pairs)[0], whole(pairs)[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("variant", RECURRENT)
def test_rcnn_in_pieces_equals_the_window(variant):
    network = build(variant)
    pairs = 40 * torch.rand(2, 9, 2, BINS)
    whole, covariances, after = network(pairs)
    state, steps, spreads = (), [], []
    for start, stop in ((0, 1), (1, 2), (2, 6), (6, 9)):
        step, spread, state = network(pairs[:, start:stop], state)
        steps.append(step)
        spreads.append(spread)
    torch.testing.assert_close(torch.cat(steps, 1), whole, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(torch.cat(spreads, 1), covariances, rtol=1e-4, atol=1e-6)
    for own, other in zip(state, after, strict=True):
        torch.testing.assert_close(own, other, rtol=1e-5, atol=1e-5)


def test_rcnn_depends_on_the_pairs_before():
    network = build()
    pairs = 40 * torch.rand(1, 3, 2, BINS)
    alone = network(pairs[:, 2:])[0]
    after_two = network(pairs)[0]
    assert not torch.allclose(alone[:, 0], after_two[:, 2], atol=1e-4)


def test_initial_state_is_that_of_no_pairs_before():
    network, pairs = build(), 40 * torch.rand(1, 3, 2, BINS)
    state = network.initial_state()
    assert {name: value.shape for name, value in state.items()} == {"h": (2, 1, 16), "c": (2, 1, 16)}
    assert build("cnn_cls").initial_state() == {}
    for own, other in zip(network(pairs, tuple(state.values()))[2], network(pairs)[2], strict=True):
        assert torch.equal(own, other)


def test_dropout_hides_outputs_while_training_only():
    pairs = 40 * torch.rand(2, 3, 2, BINS)
    plain, dropping = build(), build(dropout=0.5).train()
    assert not torch.equal(dropping(pairs)[0], dropping(pairs)[0])
    assert torch.equal(dropping.eval()(pairs)[0], plain(pairs)[0])


@pytest.mark.parametrize("variant", RECURRENT)
def test_first_stage_is_taken_over_with_its_units(variant):
    cnn, network = build("cnn_cls", seed=5), build(variant, seed=6)
    cnn.head.mean.add_(1.0)
    network.take_first_stage(cnn)
    pairs = 40 * torch.rand(1, 3, 2, BINS)
    torch.testing.assert_close(network.motions(pairs)[0].first_stage, cnn.motions(pairs)[0].motion)
    torch.testing.assert_close(network.head.mean, torch.tensor(MEAN, dtype=torch.float32))


@pytest.mark.parametrize(
    ("key", "value"),
    [("kernel_size", 5), ("pooling", "max"), ("rotation_classes", {"count": 7, "width_deg": 1.0})],
)
def test_another_first_stage_is_refused(key, value):
    cnn = build("cnn_cls", **{key: value})
    with pytest.raises(InputError, match=f"trained with {key}=.*, but model.{key} is .*; set model.{key} as"):
        build().take_first_stage(cnn)


@pytest.mark.parametrize(
    ("angle", "freeze", "lines"), [("argmax", False, 1), ("argmax", True, 0), ("expectation", False, 0)]
)
def test_argmax_says_what_is_not_trained(caplog, angle, freeze, lines):
    with caplog.at_level(logging.INFO):
        build(angle=angle, freeze=freeze).take_first_stage(build("cnn_cls", angle=angle))
    assert len(caplog.messages) == lines
    assert all("model.angle=argmax" in message for message in caplog.messages)
