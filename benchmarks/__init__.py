"""Measurements that print ratios: each module runs as `python -m benchmarks.<name>`."""
