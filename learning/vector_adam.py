"""Adam on many small parameters at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class VectorAdam:
    """Parameters as parts of one vector, which Adam moves at once."""

    def __init__(self, parameters: list[nn.Parameter], rate: float) -> None:
        self.parameters = [parameter for parameter in parameters if parameter.requires_grad]
        self.vector = _joined(self.parameters).detach()
        self.adam = torch.optim.Adam([self.vector], lr=rate, fused=True)

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

    def step(self, gradients: Sequence[Tensor], limit: float) -> float:
        """Norm of the gradient, after a step by what is left of it within a limit."""
        self.vector.grad = _joined(gradients)
        norm = nn.utils.clip_grad_norm_(self.vector, limit)
        self.adam.step()
        return float(norm)


def _joined(parts: Sequence[Tensor]) -> Tensor:
    """Entries of tensors in one vector, empty where all are frozen."""
    return torch.cat([part.reshape(-1) for part in parts]) if parts else torch.zeros(0)
