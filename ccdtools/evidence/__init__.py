"""Evidence and verdicts on whether one candidate may replace another."""
