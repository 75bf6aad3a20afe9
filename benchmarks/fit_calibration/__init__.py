"""The constants behind probabilities, fitted to simulated cases: see `benchmarks.fit_calibration.__main__`."""
