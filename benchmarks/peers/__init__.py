"""avtorch's SGLD beside its peers: the same windows, the same log density, one core each, in one run.

``python -m benchmarks.peers`` prints the tables; README.md describes each peer. Peers are the extra
``bench``; one that is not installed is listed as such.
"""
