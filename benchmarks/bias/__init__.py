"""The bias table: how far SGLD's law lies from the posterior, arm by arm. ``python -m benchmarks.bias``."""
