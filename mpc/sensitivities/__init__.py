"""Sensitivities of controllers to their state and parameters."""
