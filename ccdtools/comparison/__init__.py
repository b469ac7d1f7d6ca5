"""Comparison of controllers and baselines on the same disturbances."""
