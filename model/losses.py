"""Losses of the training: the paper's section "Learning Objective", equation by equation, one term
of ours, and losses of users' own.

Losses take (B, X, Y, Z) tensors. They are computed in float32 also if the network computes in
bfloat16, whose differences between neighbours are too coarse for slopes.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 (its usual name)
from torch import Tensor

from lidarsim import GridSpec
from scenegen.model.config import LOSSES, LossConfig, Thresholds, import_named, is_own
from scenegen.model.network import Batch, Output
from scenegen.model.targets import BUILT_IN, Target

ROOT_EPSILON = 1e-8
"""Added under the root of the gradient's length, so that a flat field has a finite derivative."""

THRESHOLD = Thresholds().probability
"""Probability from which on a voxel counts as occupied in `Coupled.lovasz_loss`: the paper's, at
which IoU is measured."""

Loss = Callable[[Output, Batch], dict[str, Tensor]]
"""A loss: (output of a network, batch) → scalars by name. ``loss`` is minimised; the others are its
terms. The batch has the inputs, and the truth by target. If maps of real places are in it, it also
has ``known``, the voxels whose occupancy counts, and ``certain``, those whose distance counts."""

Divisor = Callable[[Tensor], Tensor]
"""Number of voxels that count, a scalar → divisor of their sum, which gives their mean."""


def local_divisor(count: Tensor) -> Tensor:
    """Divide by the voxels of this process only; a sum over none gives 0, not NaN."""
    return count.clamp(min=1)


def loss_of(
    config: LossConfig,
    grid: GridSpec,
    divisor: Divisor = local_divisor,
    targets: Mapping[str, Target] = BUILT_IN,
) -> Loss:
    """Make the loss that a configuration names.

    Args:
        config: Name and weights of the loss. A user's own loss does not use the weights.
        grid: Grid of the maps.
        divisor: `Group.divisor` if several processes share each batch; see `Coupled.eikonal_loss`.
        targets: What the network predicts, by `target_name`.

    Returns:
        The loss.

    Raises:
        ScenegenError: if the name leads to no loss.
    """
    if not is_own(config.objective):
        return Coupled(config, grid, divisor, targets)
    objective = import_named(LOSSES, config.objective)
    function = objective(config, grid) if isinstance(objective, type) else objective

    return lambda output, batch: summed(function(output, batch))


def summed(terms: Tensor | Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Complete the terms of a user's own loss.

    Args:
        terms: A scalar, or scalars by name.

    Returns:
        The terms by name, with their sum as ``loss`` unless they have a ``loss`` already.
    """
    if not isinstance(terms, Mapping):
        return {"loss": terms}
    total: Any = sum(terms.values())
    return {"loss": total, **terms}


@dataclass(frozen=True)
class Coupled:
    """The paper's loss, eq. 7 and 11: the sum over the targets of a network."""

    config: LossConfig
    """Weights."""
    grid: GridSpec
    divisor: Divisor = local_divisor
    targets: Mapping[str, Target] = field(default_factory=lambda: BUILT_IN)
    """What the network predicts, by `target_name`."""

    def __call__(self, output: Output, batch: Batch) -> dict[str, Tensor]:
        """Compute the loss of a batch.

        Args:
            output: Output of the network.
            batch: Inputs and truth; see `Loss`.

        Returns:
            Scalars by name: ``loss``, and the terms of each target without their weights.
        """
        total, parts = torch.zeros((), device=batch["occupancy"].device), dict[str, Tensor]()
        for name, values in output.by_target.items():
            loss = self.targets[name].loss(values, batch, self)
            added, terms = loss if isinstance(loss, tuple) else (loss, {name: loss})
            total, parts = total + added, {**parts, **terms}
        return {"loss": total, **parts}

    def occupancy_loss(
        self, logits: Tensor, occupancy: Tensor, known: Tensor | None = None
    ) -> Tensor:
        """Eq. 8: weighted binary cross-entropy, -[w o log p + (1 - o) log(1 - p)].

        Args:
            logits: (B, X, Y, Z).
            occupancy: The truth o, bool, of the same shape.
            known: Voxels that count; None for all.

        Returns:
            The mean over these voxels.
        """
        # log p = -softplus(-logit), so that no probability is rounded to 0 or 1
        logits = logits.float()
        loss = F.softplus(torch.where(occupancy, -logits, logits))
        weighted = torch.where(occupancy, self.config.occupied_weight * loss, loss)
        return self.mean(weighted, known)

    @staticmethod
    def lovasz_loss(logits: Tensor, occupancy: Tensor, known: Tensor | None = None) -> Tensor:
        """Lovász hinge, a convex surrogate of 1 - IoU (Berman, Triki and Blaschko 2018).

        Args:
            logits: (B, X, Y, Z).
            occupancy: The truth, bool, of the same shape.
            known: Voxels that count; None for all.

        Returns:
            The mean over the maps.
        """
        # margins are measured from `THRESHOLD`, since this is where IoU is measured
        margins = logits.float() - math.log(THRESHOLD / (1 - THRESHOLD))
        if known is not None:  # an infinite margin on the free side is no error
            margins = torch.where(known, margins, -torch.inf)
            occupancy = occupancy & known
        margins = margins.flatten(1)
        return torch.stack(
            [_lovasz(*pair) for pair in zip(margins, occupancy.flatten(1), strict=True)]
        ).mean()

    def regression_loss(
        self, predicted: Tensor, tudf: Tensor, certain: Tensor | None = None
    ) -> Tensor:
        """Eq. 9: Smooth-L1 of the distances, weighted near surfaces.

        Args:
            predicted: Distances, metres, (B, X, Y, Z).
            tudf: The truth, of the same shape.
            certain: Voxels that count; None for all.

        Returns:
            The mean over these voxels.
        """
        config = self.config
        loss = F.smooth_l1_loss(predicted.float(), tudf, beta=config.beta_m, reduction="none")
        weighted = torch.where(tudf <= config.near_m, config.near_weight * loss, loss)
        return self.mean(weighted, certain)

    def eikonal_loss(
        self, predicted: Tensor, tudf: Tensor, certain: Tensor | None = None
    ) -> Tensor:
        """Eq. 10: how far the slope of the predicted field is from 1.

        It is computed where the true distance lies strictly between 0 and the truncation, because a
        distance field has slope 1 only there. The number of such voxels differs between maps. So,
        if processes share a batch, `Group.divisor` makes the mean of their losses that of all maps.

        Args:
            predicted: Distances, metres, (B, X, Y, Z).
            tudf: The truth, of the same shape.
            certain: Voxels that count; None for all.

        Returns:
            The mean over these voxels; 0 over none.
        """
        d = predicted.float()
        # Forward differences: central ones cannot see a checkerboard (docs/log). The last voxel of
        # every line has none.
        base = d[:, :-1, :-1, :-1]
        squares = (d[:, 1:, :-1, :-1] - base).square()
        squares = squares + (d[:, :-1, 1:, :-1] - base).square()
        squares = squares + (d[:, :-1, :-1, 1:] - base).square()
        slope = (squares / self.grid.voxel_m**2 + ROOT_EPSILON).sqrt()
        mask = (tudf > 0) & (tudf < self.grid.truncation_m)
        mask = mask if certain is None else mask & certain
        return self.mean((slope - 1).abs(), mask[:, :-1, :-1, :-1])

    def mean(self, loss: Tensor, over: Tensor | None) -> Tensor:
        """Average over voxels.

        Args:
            loss: A value per voxel, any shape.
            over: Voxels that count, bool, of the same shape; None for all.

        Returns:
            The mean, a scalar; 0 over no voxel.
        """
        if over is None:
            return loss.mean()
        # a boolean index would give a tensor of unknown size, which makes a GPU wait for the CPU
        return torch.where(over, loss, 0).sum() / self.divisor(over.sum())


def _lovasz(margins: Tensor, occupied: Tensor) -> Tensor:
    """Return the hinge of one map, given as (voxels,) each; 0 if there are no errors.

    If the n voxels with the largest errors are wrong, 1 - IoU is n over the number of voxels that
    are occupied or wrong. Each error counts by the increase of this value from n - 1 to n.
    """
    errors = 1 - torch.where(occupied, margins, -margins)
    positive = errors > 0  # others weigh nothing; after some training, these are most voxels
    errors, order = errors[positive].sort(descending=True)
    free = ~occupied[positive][order]
    wrong = torch.arange(1, len(errors) + 1, device=errors.device)
    lost = wrong / (occupied.sum() + free.cumsum(0))  # 1 - IoU for n = 1, 2, …
    return errors @ lost.diff(prepend=lost.new_zeros(1))
