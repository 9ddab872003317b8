"""Equations 3 and 4 against numpy."""

import numpy as np
import pytest
import torch

from rcnn_odom.models.losses import classification_loss, euclidean, regression_loss

torch.set_num_threads(1)
SHAPES = [(5,), (1,), (3, 4)]


def draw(shape, classes=7):
    rng = np.random.default_rng(0)
    motion, truth = rng.normal(size=(2, *shape, 2))
    scores, index = 3 * rng.normal(size=(*shape, classes)), rng.integers(0, classes, shape)
    return motion, truth, scores, index


def norm(error, per_sample):
    return np.abs(error).mean() if per_sample else np.linalg.norm(error.ravel()) / np.sqrt(error.size)


def cross_entropy(scores, index):
    """Eq. 4 as it is printed, for each sample."""
    losses = [
        -np.log(np.exp(x[number]) / np.exp(x).sum())
        for x, number in zip(scores.reshape(-1, scores.shape[-1]), index.ravel(), strict=True)
    ]
    return np.mean(losses)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("per_sample", [False, True])
def test_regression_is_equation_3(shape, per_sample):
    motion, truth, _, _ = draw(shape)
    loss = regression_loss(torch.tensor(motion), torch.tensor(truth), 100.0, per_sample)
    distance, rotation = (norm((motion - truth)[..., column], per_sample) for column in (0, 1))
    assert loss.distance.item() == pytest.approx(distance)
    assert loss.rotation.item() == pytest.approx(rotation)
    assert loss.total.item() == pytest.approx(distance + 100 * rotation)
    assert loss.total.shape == ()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("per_sample", [False, True])
def test_classification_is_equation_4(shape, per_sample):
    motion, truth, scores, index = draw(shape)
    loss = classification_loss(*map(torch.tensor, (motion, scores, truth, index)), 2.5, per_sample)
    distance = norm((motion - truth)[..., 0], per_sample)
    assert loss.distance.item() == pytest.approx(distance)
    assert loss.rotation.item() == pytest.approx(cross_entropy(scores, index))
    assert loss.total.item() == pytest.approx(distance + 2.5 * cross_entropy(scores, index))


def test_values_by_hand():
    motion, truth = torch.tensor([[3.0, 0.0], [4.0, 0.0]]), torch.tensor([[0.0, 0.01], [0.0, -0.03]])
    over_batch, per_sample = (regression_loss(motion, truth, 100.0, option) for option in (False, True))
    assert over_batch.distance.item() == pytest.approx(np.sqrt(12.5))
    assert over_batch.total.item() == pytest.approx(np.sqrt(12.5) + 100 * np.sqrt(0.0005))
    assert per_sample.distance.item() == pytest.approx(3.5)
    assert per_sample.total.item() == pytest.approx(3.5 + 100 * 0.02)


def test_even_scores_cost_log_of_the_number_of_classes():
    motion = torch.zeros(2, 3, 2)
    index = torch.tensor([[0, 50, 111], [3, 4, 5]])
    loss = classification_loss(motion, torch.zeros(2, 3, 112), motion, index, 1.0)
    assert loss.rotation.item() == pytest.approx(np.log(112))


def test_loss_does_not_grow_with_the_batch():
    motion, truth, _, _ = map(torch.tensor, draw((6,)))
    once, twice = regression_loss(motion, truth, 1), regression_loss(motion.tile(2, 1), truth.tile(2, 1), 1)
    torch.testing.assert_close(once.total, twice.total)


@pytest.mark.parametrize("per_sample", [False, True])
def test_no_error_has_a_finite_gradient(per_sample):
    truth = torch.tensor([[1.0, 0.02], [0.5, -0.01]])
    motion = truth.clone().requires_grad_()
    loss = regression_loss(motion, truth, 100.0, per_sample)
    loss.total.backward()
    assert loss.total.item() == pytest.approx(0, abs=1e-3)
    assert motion.grad.isfinite().all()


@pytest.mark.parametrize("per_sample", [False, True])
def test_gradient_equals_finite_differences(per_sample):
    motion, truth, _, _ = map(torch.tensor, draw((4,)))
    assert torch.autograd.gradcheck(
        lambda estimate: euclidean(estimate, truth, per_sample), motion.requires_grad_()
    )


def test_scores_get_the_gradient_of_the_softmax():
    motion, truth, scores, index = map(torch.tensor, draw((5,)))
    scores.requires_grad_()
    classification_loss(motion, scores, truth, index, 3.0).total.backward()
    share = np.exp(scores.detach().numpy())
    expected = share / share.sum(1, keepdims=True) - np.eye(7)[index.numpy()]
    np.testing.assert_allclose(scores.grad.numpy(), 3 * expected / 5, atol=1e-12)
