"""Budgets of `learning`: what an answer may cost, in time [s] and in numbers. None of them judges it."""

EPISODES = 20  # So many last episodes say how good an agent is while it is trained.
