"""Budgets of `learning`: what an answer may cost, in time [s] and in numbers. None of them judges it."""

EPISODES = 20  # So many last episodes say how good an agent is while it is trained.
TRIAL_TIME = 1.0  # [s] An episode is tried for so long, twice, to see that an environment repeats itself.
TRIED_STEPS = 10  # So many steps are tried in any case, and tell environments of a checkpoint apart.
