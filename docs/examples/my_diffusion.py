"""A network that draws: it learns to remove noise from maps, and completes from pure noise."""

from itertools import pairwise

import torch
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits

from scenegen import Output

STEPS = 8
"""Steps from noise to a map."""


class Denoiser(nn.Module):
    """Diffusion by predictions of the clean map (Ho et al. 2020; Song et al. 2021)."""

    draws = True  # every answer has random numbers of its own
    tasks = ("occupancy",)

    def __init__(self, config):
        super().__init__()
        self.inputs, width = config.inputs, config.width
        self.layers = nn.Sequential(
            nn.Conv3d(len(self.inputs) + 2, width, 3, padding=1),
            nn.SiLU(),
            nn.Conv3d(width, width, 3, padding=1),
            nn.SiLU(),
            nn.Conv3d(width, 1, 3, padding=1),
        )

    def clean(self, batch, noisy, level):
        """Logits of the true map; `level` (B, 1, 1, 1) is the noise's share of the variance."""
        seen = [batch[name].float() for name in self.inputs]
        layers = self.layers(torch.stack([*seen, noisy, level.expand_as(noisy)], dim=1))
        return layers.squeeze(1)

    def training_step(self, batch):
        """Remove noise of a random level from the truth."""
        occupied = batch["occupancy"].float()
        level = torch.rand(len(occupied), 1, 1, 1, device=occupied.device)
        noise = torch.randn_like(occupied)
        noisy = (1 - level).sqrt() * (2 * occupied - 1) + level.sqrt() * noise
        logits = self.clean(batch, noisy, level)
        return {"entropy": binary_cross_entropy_with_logits(logits.float(), occupied)}

    def forward(self, batch):
        """Begin with noise, and go to lower levels of it step by step."""
        noisy = torch.randn_like(batch[self.inputs[0]].float())
        levels = torch.linspace(1, 0, STEPS + 1, device=noisy.device)
        logits = noisy
        for level, lower in pairwise(levels):
            logits = self.clean(batch, noisy, level.view(1, 1, 1, 1)).float()
            guess = 2 * logits.sigmoid() - 1
            noise = (noisy - (1 - level).sqrt() * guess) / level.sqrt()
            noisy = (1 - lower).sqrt() * guess + lower.sqrt() * noise
        return Output(logits, None)
