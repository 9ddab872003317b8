"""One pair of scans after the other through a checkpoint's network, near the speed of reading its weights."""

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from numba import njit

from rcnn_odom.deployment.odometer import Description
from rcnn_odom.geometry import FloatArray
from rcnn_odom.models.networks import RCNN
from rcnn_odom.training.modules import OdometryModule

Vector = npt.NDArray[np.float32]


class CheckpointStepper:
    """A trained module as a :class:`rcnn_odom.deployment.odometer.Stepper`.

    At batch 1 an LSTM is bound by reading its weights. They are laid out so that those of one input are
    one stretch of memory; nearly half of the convolutions' outputs are 0, and their weights are not read.

    Args:
        module: in evaluation mode.
    """

    def __init__(self, module: OdometryModule) -> None:
        network = module.network
        self.description = describe(module)
        self._cnn = network.cnn if isinstance(network, RCNN) else network
        self._head, self._uncertainty = network.head, module.uncertainty
        self._layers: list[tuple[Vector, Vector, Vector]] = []
        if isinstance(network, RCNN):
            self._projection, self._hidden, lstm = network.projection, network.lstm.hidden, network.lstm
            biases = [(ih + hh).detach().numpy() for ih, hh in zip(lstm.bias_ih, lstm.bias_hh, strict=True)]
            weights = zip(lstm.weight_ih, lstm.weight_hh, biases, strict=True)
            self._layers = [(_by_input(ih), _by_input(hh), bias) for ih, hh, bias in weights]
            # Compiled here: the first scan should not have to wait for it.
            empty = np.zeros((0, 4), np.float32), np.zeros((1, 4), np.float32), np.zeros(4, np.float32)
            _lstm_step(np.zeros(0, np.float32), *empty, np.zeros((2, 1), np.float32))
        self.reset()

    def reset(self) -> None:
        """Forgets all earlier pairs."""
        self._state = [np.zeros((2, self._hidden), np.float32) for _ in self._layers]

    @torch.inference_mode()
    def __call__(self, pair: npt.NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        """Motion (2,) and its standard deviations (2,) from scans (2, bins) in metres, the earlier first."""
        features = self._cnn.encode(torch.from_numpy(pair)[None, None])
        estimate = self._cnn.head(features)
        if self._layers:
            first_stage = estimate.motion
            first = self._cnn.head.standardise(first_stage)
            inputs = torch.cat([self._projection(features), first], -1).flatten().numpy()
            for (weight_ih, weight_hh, bias), state in zip(self._layers, self._state, strict=True):
                _lstm_step(inputs, weight_ih, weight_hh, bias, state)
                inputs = state[0]
            estimate = self._head(torch.from_numpy(inputs)[None, None])._replace(first_stage=first_stage)
        deviation = self._uncertainty(estimate, self._head)
        return estimate.motion.flatten().double().numpy(), deviation.flatten().double().numpy()


def describe(module: OdometryModule) -> Description:
    """What an odometer has to know of a trained module."""
    head = module.network.head
    typical = torch.sqrt(head.mean.double() ** 2 + head.deviation.double() ** 2)
    distance, turn = typical.tolist()
    known = module.uncertainty
    return Description(
        module.sensor,
        module.scoring["apply"],
        (distance, turn),
        float(known.least_filled),
        float(known.period),
    )


def _by_input(weight: torch.Tensor) -> Vector:
    return np.ascontiguousarray(weight.detach().numpy().T)


@njit(cache=True, fastmath={"reassoc", "contract"})
def _lstm_step(inputs: Any, weight_ih: Any, weight_hh: Any, bias: Any, state: Any) -> None:
    """One step of one LSTM layer, in place.

    Args:
        inputs: (inputs,).
        weight_ih: (inputs, 4 * hidden), of the gates i, f, g, o.
        weight_hh: (hidden, 4 * hidden).
        bias: (4 * hidden,).
        state: h and c, (2, hidden).
    """
    hidden = state.shape[1]
    gates = bias.copy()
    _add_product(inputs, weight_ih, gates)
    _add_product(state[0], weight_hh, gates)
    one = np.float32(1)
    for k in range(hidden):
        i = one / (one + np.exp(-gates[k]))
        f = one / (one + np.exp(-gates[hidden + k]))
        g = np.tanh(gates[2 * hidden + k])
        o = one / (one + np.exp(-gates[3 * hidden + k]))
        state[1, k] = f * state[1, k] + i * g
        state[0, k] = o * np.tanh(state[1, k])


@njit(cache=True, fastmath={"reassoc", "contract"})
def _add_product(x: Any, weight: Any, sums: Any) -> None:
    """Adds ``x @ weight``, (K,) by (K, N), to sums (N,), four inputs at once, those that are 0 left out."""
    chosen = np.flatnonzero(x)
    whole = len(chosen) // 4 * 4
    for k in range(0, whole, 4):
        a, b, c, d = chosen[k], chosen[k + 1], chosen[k + 2], chosen[k + 3]
        xa, xb, xc, xd = x[a], x[b], x[c], x[d]
        for n in range(len(sums)):
            sums[n] += xa * weight[a, n] + xb * weight[b, n] + xc * weight[c, n] + xd * weight[d, n]
    for k in range(whole, len(chosen)):
        a = chosen[k]
        for n in range(len(sums)):
            sums[n] += x[a] * weight[a, n]
