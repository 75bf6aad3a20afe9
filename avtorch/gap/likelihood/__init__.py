"""Likelihood of a log under a hypothesis: records, whitened residuals, modes and log evidence."""
