"""Drift as a torchmetrics metric, for logging and for evaluation on several processes."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch.nn import Module
from torchmetrics import Metric

from rcnn_odom.evaluation.drift import KITTI_LENGTHS, segment_errors
from rcnn_odom.geometry import FloatArray


class DriftMetric(Metric):
    """Mean drift of whole sequences, each sent by one `update`; calls `drift.segment_errors`.

    The states are sums for each name, in an order that is fixed at construction, so processes may
    see different numbers of sequences, or none. A sequence that was sent before on the same process
    is ignored. One that two processes send counts once too, if both estimates agree: its errors and its
    number of segments double alike, and the mean stays.

    Args:
        names: all sequences that may be sent, the same on every process.
        planar: flatten to the x-z plane first, see `drift.drift`.
        lengths: segment lengths in metres.
        step: frames between the starts of segments.

    Raises:
        ValueError: a name is given twice.
    """

    is_differentiable = False
    higher_is_better = False
    # With True, `forward` updates the accumulated state itself, so that repeats are seen there too.
    full_state_update = True

    t_err_sum: torch.Tensor
    r_err_sum: torch.Tensor
    count: torch.Tensor

    def __init__(
        self,
        names: Sequence[str],
        *,
        planar: bool = True,
        lengths: Sequence[float] = KITTI_LENGTHS,
        step: int = 10,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.names = tuple(names)
        if len(set(self.names)) != len(self.names):
            raise ValueError(f"names must differ, got {self.names}")
        self.planar, self.lengths, self.step = planar, tuple(lengths), step
        for state in ("t_err_sum", "r_err_sum", "count"):
            zeros = torch.zeros(len(self.names), dtype=torch.float64)
            self.add_state(state, default=zeros, dist_reduce_fx="sum")

    def update(
        self, truth: torch.Tensor | npt.ArrayLike, estimate: torch.Tensor | npt.ArrayLike, name: str
    ) -> None:
        """Add one whole sequence.

        Args:
            truth: ground truth (N, 4, 4), camera frame, metres; a tensor on any device, or an array.
            estimate: estimate of the same frames, (N, 4, 4).
            name: which sequence it is.

        Raises:
            ValueError: the name was not given at construction.
            InputError: bad poses, see `drift.segment_errors`.
        """
        if name not in self.names:
            raise ValueError(f"unknown sequence {name!r}: this metric was built for {self.names}")
        index = self.names.index(name)
        if self.count[index] > 0:
            return
        errors = segment_errors(
            _to_array(truth), _to_array(estimate), self.lengths, self.step, planar=self.planar
        )
        self.t_err_sum[index] += float(errors.t_err.sum())
        self.r_err_sum[index] += float(np.degrees(errors.r_err.sum()))
        self.count[index] += len(errors.t_err)

    def compute(self) -> dict[str, torch.Tensor]:
        """Drift of each sequence, and the mean over sequences, which all have the same weight.

        Returns:
            ``drift`` and ``drift/NAME`` (ratios), ``r_err_deg_per_m`` and ``r_err_deg_per_m/NAME``.
            Sequences without a segment are left out; without any sequence the dict is empty.
        """
        scored = torch.nonzero(self.count).flatten().tolist()
        result = {}
        for key, total in (("drift", self.t_err_sum), ("r_err_deg_per_m", self.r_err_sum)):
            means = {f"{key}/{self.names[index]}": total[index] / self.count[index] for index in scored}
            if means:
                result[key] = torch.stack(list(means.values())).mean()
            result.update(means)
        return result

    def _apply(self, fn: Callable[[torch.Tensor], torch.Tensor], *args: Any, **kwargs: Any) -> Module:
        # torchmetrics guards against `.half()` but not against `.to(dtype)`, which a trainer in true
        # half precision calls: counts of segments above 256 would be rounded.
        return super()._apply(lambda tensor: tensor.to(fn(tensor).device), *args, **kwargs)


def _to_array(poses: torch.Tensor | npt.ArrayLike) -> FloatArray:
    if isinstance(poses, torch.Tensor):
        poses = poses.detach().cpu().double().numpy()
    return np.asarray(poses, dtype=np.float64)
