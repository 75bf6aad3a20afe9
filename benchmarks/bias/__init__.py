"""The bias table: distance of SGLD's law from the posterior, arm by arm. ``python -m benchmarks.bias``."""
