"""Simulators that are not avtorch's own: beside a car's log, as a baseline, and with the effects they lack."""

from avtorch.external.fmu import FmuSimulator as FmuSimulator
from avtorch.external.fmu_export import write_fmu as write_fmu
from avtorch.external.simulator import Simulator as Simulator

__all__ = ["FmuSimulator", "Simulator", "write_fmu"]
