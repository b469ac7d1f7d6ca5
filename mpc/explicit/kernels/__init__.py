"""Compiled kernels of the exploration and of point location."""
