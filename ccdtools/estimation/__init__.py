"""Measurements of a plant, and the estimates of its state."""
