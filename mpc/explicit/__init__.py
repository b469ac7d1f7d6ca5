"""MPC laws as piecewise affine functions: exploration, evaluation, storage."""
