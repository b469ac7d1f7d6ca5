"""Evidence at any time: what fair bets have won.

Of bets that are fair whatever came before, the wealth exceeds 1 / level with at most the probability `level`, at any
time and at all times together.

References
----------
Ville, Étude critique de la notion de collectif, 1939; Ramdas, Grünwald, Vovk and Shafer, Game-theoretic statistics and
safe anytime-valid inference, Statistical Science 38(4), 2023.
"""

from __future__ import annotations

import numpy as np

from ccdtools.arrays import Array


def log_wealth(logs: Array, stakes: Array, dependence: Array | float = 1.0) -> Array:
    """Log wealth (n, K) of bets that are staked again and again.

    Parameters
    ----------
    logs : (n, K) array
        Log factors of K bets.
    stakes : (n,) array
        Logarithm of the part of the money that is staked on every bet before each factor.
    dependence : (n, 1) array or float
        At least 1: so many values tell as much as one that is independent. Wealth is raised to the power 1/dependence,
        which can but lower a wealth above 1: fair bets stay valid.
    """
    won = np.cumsum(logs, axis=0) / dependence
    before = np.concatenate([np.zeros((1, logs.shape[1])), won[:-1]])
    wealth: Array = np.logaddexp.accumulate(stakes[:, None] - before, axis=0) + won
    return wealth


def dependence(series: Array) -> float:
    """Values of a series (n,) that tell as much as one.

    By the correlation of neighbours.
    """
    away = series - series.mean()
    size = float(away @ away)
    correlation = float(away[1:] @ away[:-1]) / size if size > 0 else 0.0
    return max(1.0, (1 + correlation) / (1 - correlation))
