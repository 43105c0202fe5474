"""What tests of teachers are made of."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torch import distributions as d
from torch import nn

OBS, ACTIONS = 3, 4


def observations(*batch: int) -> TensorDict:
    return TensorDict(observation=torch.randn(*batch, OBS), batch_size=batch)


class Pair(nn.Module):
    """A policy in plain PyTorch."""

    def __init__(self, kind: str = "mean_std") -> None:
        super().__init__()
        self.mean, self.log_std, self.kind = nn.Linear(OBS, ACTIONS), nn.Linear(OBS, ACTIONS), kind

    def forward(self, observation: torch.Tensor) -> Any:
        mean, std = self.mean(observation), self.log_std(observation).exp()
        if self.kind == "normal":
            return d.Independent(d.Normal(mean, std), 1)
        return d.Categorical(logits=mean) if self.kind == "categorical" else (mean, std)
