"""Controllers side by side: the baselines, and every controller on the same disturbances."""
