"""PPO's part in a co-design."""
