"""The digital twin: deployment, residuals and the discrepancy they teach."""
