"""A method of a user: the best of some random designs, each with its LQR."""

from dataclasses import dataclass

import numpy as np

import ccdtools as cc


@dataclass(frozen=True)
class RandomDesigns:
    """The design of the best mean return among `count` that are drawn."""

    count: int = 12
    name: str = "random designs"

    def run(self, problem, design, rng, *, progress=False):
        """The best design and its saturated LQR."""
        tried = [design, *problem.design.latin_hypercube(self.count - 1, rng)]
        controllers = [cc.saturated_lqr(problem, p) for p in tried]
        returns = [self._mean(problem, law, p) for law, p in zip(controllers, tried)]
        best = int(np.argmax(returns))
        return cc.CoDesignResult(
            design=tried[best], controller=controllers[best], method=self.name, objective=returns[best],
            criterion="mean return", evaluations=self.count,
        )  # fmt: skip

    def _mean(self, problem, law, p):
        """Mean return on scenarios that all designs share."""
        return cc.closed_loop_returns(problem, law, p, np.random.default_rng(0)).summary.mean
