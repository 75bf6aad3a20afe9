"""Simulators that are not avtorch's own: beside a car's log, as a baseline, and with the effects they lack."""

from avtorch.external.simulator import Simulator as Simulator

__all__ = ["Simulator"]
