"""Adam on many small parameters at once."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.optim.adamw import adamw


class VectorAdam:
    """Parameters as parts of one vector, which Adam moves at once, with a decay of the weights as in AdamW."""

    def __init__(
        self, parameters: list[nn.Parameter], rate: float, *, decay: float = 0.0, fused: bool = True
    ) -> None:  # fmt: skip
        self.decay, self.fused = decay, fused
        self.parameters = [parameter for parameter in parameters if parameter.requires_grad]
        self.rate = rate
        self.vector = _joined(self.parameters).detach()
        self.state = {name: torch.zeros_like(self.vector) for name in ("mean", "square")}
        self.state["steps"] = torch.zeros((), dtype=torch.float32, device=self.vector.device)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Parameters as parts of the vector; afterwards each has its own memory again."""
        self.vector.copy_(_joined(self.parameters).detach())
        nn.utils.vector_to_parameters(self.vector, self.parameters)
        try:
            yield
        finally:
            for parameter in self.parameters:
                parameter.data = parameter.data.clone()

    def step(self, gradients: Sequence[Tensor], limit: float = torch.inf) -> float:
        """Norm of the gradient, after a step by what is left of it within a limit."""
        gradient = _joined(gradients)
        norm = gradient.norm()
        gradient *= (limit / (norm + 1e-6)).clamp(max=1.0)
        # the function behind torch.optim.AdamW, which loads a compiler when it is made
        mean, square, steps = self.state.values()
        adamw(
            [self.vector], [gradient], [mean], [square], [], [steps], foreach=False, fused=self.fused,
            amsgrad=False, beta1=0.9, beta2=0.999, lr=self.rate, weight_decay=self.decay, eps=1e-8, maximize=False,
        )  # fmt: skip
        return float(norm)


def falling(rate: float, k: int, steps: int) -> float:
    """Rate of step k, from 0, which falls to zero along a cosine."""
    return rate * (1 + math.cos(math.pi * k / steps)) / 2


def _joined(parts: Sequence[Tensor]) -> Tensor:
    """Entries of tensors in one vector, empty where all are frozen."""
    return torch.cat([part.reshape(-1) for part in parts]) if parts else torch.zeros(0)
