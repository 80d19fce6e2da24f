"""The learning objective: the paper's section "Learning Objective", equation by equation, one term
of ours, and whatever a user's own loss says.

All losses take (B, X, Y, Z) tensors and are computed in float32, whatever the network computed in.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812 (its usual name)
from torch import Tensor

from lidarsim import GridSpec
from scenegen.model.config import LOSSES, LossConfig, Thresholds, is_own, named
from scenegen.model.network import Batch, Output
from scenegen.model.targets import BUILT_IN, Target

ROOT_EPSILON = 1e-8
"""Under the root of the gradient's length, so that a flat field has a finite derivative."""

THRESHOLD = Thresholds().probability
"""Where `lovasz_loss` looks for an edge."""

Loss = Callable[[Output, Batch], dict[str, Tensor]]
"""From what a network says of a batch, and the batch itself (its inputs, and the truth by target),
to scalars: what is minimised, as ``loss``, and its terms by name. A batch with maps
of real places has ``known``, too, the voxels whose occupancy counts, and ``certain``, those whose
distance does."""

Divisor = Callable[[Tensor], Tensor]
"""From how many voxels count, a scalar, to what their sum is divided by for their mean."""


def at_least_one(count: Tensor) -> Tensor:
    """The divisor of a process that is alone."""
    return count.clamp(min=1)


def loss_of(
    config: LossConfig,
    grid: GridSpec,
    divisor: Divisor = at_least_one,
    targets: Mapping[str, Target] = BUILT_IN,
) -> Loss:
    """The loss that `config` names for a network with these `targets`: the paper's, with whatever
    other targets add, or one's own as docs/own-network.md says.

    `divisor` is for batches of which several processes have a part each; see
    `Coupled.eikonal_loss`. Raises ScenegenError for a name that leads to none.
    """
    if not is_own(config.objective):
        return Coupled(config, grid, divisor, targets)
    objective = named(LOSSES, config.objective)
    function = objective(config, grid) if isinstance(objective, type) else objective

    return lambda output, batch: summed(function(output, batch))


def summed(terms: Tensor | Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What a user's own code says of a batch, a scalar or several by name, with what is minimised
    as ``loss``: their sum, unless there is one."""
    if not isinstance(terms, Mapping):
        return {"loss": terms}
    total: Any = sum(terms.values())
    return {"loss": total, **terms}


@dataclass(frozen=True)
class Coupled:
    """Eq. 7 and 11: what the targets of the output add, as ``loss``, and their terms."""

    config: LossConfig
    grid: GridSpec
    divisor: Divisor = at_least_one
    targets: Mapping[str, Target] = field(default_factory=lambda: BUILT_IN)

    def __call__(self, output: Output, batch: Batch) -> dict[str, Tensor]:
        """Scalars; see `Loss`."""
        total, parts = torch.zeros((), device=batch["occupancy"].device), dict[str, Tensor]()
        for name, values in output.by_target.items():
            loss = self.targets[name].loss(values, batch, self)
            added, terms = loss if isinstance(loss, tuple) else (loss, {name: loss})
            total, parts = total + added, {**parts, **terms}
        return {"loss": total, **parts}

    def occupancy_loss(
        self, logits: Tensor, occupancy: Tensor, known: Tensor | None = None
    ) -> Tensor:
        """Eq. 8: binary cross-entropy over all voxels, or the `known` ones, occupied ones weighted;
        `occupancy` is bool.

        -[w o log p + (1 - o) log(1 - p)] with log p = -softplus(-logit): no probability is ever
        rounded to 0 or 1.
        """
        logits = logits.float()
        loss = F.softplus(torch.where(occupancy, -logits, logits))
        weighted = torch.where(occupancy, self.config.occupied_weight * loss, loss)
        return self.mean(weighted, known)

    @staticmethod
    def lovasz_loss(logits: Tensor, occupancy: Tensor, known: Tensor | None = None) -> Tensor:
        """The Lovász hinge of every map's IoU (Berman, Triki and Blaschko 2018), over all its
        voxels or the `known` ones, in the mean.

        Logits are counted from that of the probability above which the paper's protocol holds a
        voxel occupied. A voxel whose logit is less than 1 on the right side has an error; each
        counts by what it takes from the IoU, 1 at first, once all voxels of larger errors are
        wrong.
        """
        margins = logits.float() - math.log(THRESHOLD / (1 - THRESHOLD))
        if known is not None:  # what is not known is free, and has no error
            margins = torch.where(known, margins, -torch.inf)
            occupancy = occupancy & known
        margins = margins.flatten(1)
        return torch.stack(
            [_lovasz(*pair) for pair in zip(margins, occupancy.flatten(1), strict=True)]
        ).mean()

    def regression_loss(
        self, predicted: Tensor, tudf: Tensor, certain: Tensor | None = None
    ) -> Tensor:
        """Eq. 9: Smooth-L1 over all voxels, or those whose distance is `certain`, those near a
        surface weighted; metres."""
        config = self.config
        loss = F.smooth_l1_loss(predicted.float(), tudf, beta=config.beta_m, reduction="none")
        weighted = torch.where(tudf <= config.near_m, config.near_weight * loss, loss)
        return self.mean(weighted, certain)

    def eikonal_loss(
        self, predicted: Tensor, tudf: Tensor, certain: Tensor | None = None
    ) -> Tensor:
        """Eq. 10: how far the predicted field's slope is from 1, over voxels whose true distance
        lies strictly between 0 and the truncation; by forward differences, so the last voxel of
        every line has none. 0 over no voxel.

        How many such voxels there are differs from map to map: `Group.divisor` makes the mean of
        several processes' losses that of all their maps.
        """
        d = predicted.float()
        here = d[:, :-1, :-1, :-1]
        squares = (d[:, 1:, :-1, :-1] - here).square()
        squares = squares + (d[:, :-1, 1:, :-1] - here).square()
        squares = squares + (d[:, :-1, :-1, 1:] - here).square()
        slope = (squares / self.grid.voxel_m**2 + ROOT_EPSILON).sqrt()
        mask = (tudf > 0) & (tudf < self.grid.truncation_m)
        mask = mask if certain is None else mask & certain
        return self.mean((slope - 1).abs(), mask[:, :-1, :-1, :-1])

    def mean(self, loss: Tensor, over: Tensor | None) -> Tensor:
        """The mean over all voxels, or `over` those that count; 0 over none."""
        if over is None:
            return loss.mean()
        return torch.where(over, loss, 0).sum() / self.divisor(over.sum())


def _lovasz(margins: Tensor, occupied: Tensor) -> Tensor:
    """The hinge of one map, from (voxels,) each; 0 where there are no errors.

    With a set of voxels wrong, 1 - IoU is its size over that of the union with the occupied ones.
    """
    errors = 1 - torch.where(occupied, margins, -margins)
    held = errors > 0
    errors, order = errors[held].sort(descending=True)
    free = ~occupied[held][order]
    wrong = torch.arange(1, len(errors) + 1, device=errors.device)
    lost = wrong / (occupied.sum() + free.cumsum(0))
    return errors @ lost.diff(prepend=lost.new_zeros(1))
