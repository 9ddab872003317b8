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
    """Mean drift of whole sequences, by `drift.segment_errors`. Each call of `update` adds one sequence.

    The state has one sum for each sequence name, in an order that is fixed at construction. Processes may
    therefore see different numbers of sequences, or none. A sequence that is added again in the same process
    is ignored. If two processes add the same sequence with the same estimate, the sum of its errors and its
    number of segments both double, so that the mean does not change.

    Args:
        names: names of all sequences that may be added, the same on every process.
        planar: project on the x-z plane first, see `drift.drift`.
        lengths: segment lengths in metres.
        step: frames between the starts of segments.

    Raises:
        ValueError: a name is given twice.
    """

    is_differentiable = False
    higher_is_better = False
    # With True, `forward` updates the accumulated state itself, so that it also ignores repeated sequences.
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
        """Adds one whole sequence.

        Args:
            truth: ground truth (N, 4, 4), camera frame, metres; a tensor on any device, or an array.
            estimate: estimate of the same frames, (N, 4, 4).
            name: name of the sequence.

        Raises:
            ValueError: the name was not given at construction.
            InputError: the poses are invalid, see `drift.segment_errors`.
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
        """Drift of each sequence, and the mean over sequences with equal weights.

        Returns:
            ``drift`` and ``drift/NAME`` (ratios), ``r_err_deg_per_m`` and ``r_err_deg_per_m/NAME``.
            Sequences without a segment are left out; if there is no sequence, the dict is empty.
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
        # Keeps the dtype of the state. torchmetrics ignores `.half()` but not `.to(dtype)`, which a trainer
        # in true half precision calls; it would round numbers of segments above 256.
        return super()._apply(lambda tensor: tensor.to(fn(tensor).device), *args, **kwargs)


def _to_array(poses: torch.Tensor | npt.ArrayLike) -> FloatArray:
    if isinstance(poses, torch.Tensor):
        poses = poses.detach().cpu().double().numpy()
    return np.asarray(poses, dtype=np.float64)
