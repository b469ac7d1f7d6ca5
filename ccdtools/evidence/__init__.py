"""Evidence and verdicts: whether one candidate may take the place of another."""
