"""Disturbances that act on a plant: random, generated or recorded disturbances."""
