"""Budgets of `learning`: what an answer may cost, in time [s] and in numbers. None of them judges it."""

EPISODES = 20  # So many last episodes say how good an agent is while it is trained.
TRIED_STEPS = 10  # So many steps are taken twice to see that an environment does the same after the same seed.
