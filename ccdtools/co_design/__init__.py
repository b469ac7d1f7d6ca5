"""Controller and design optimised together: the problem, the expert, the methods."""
