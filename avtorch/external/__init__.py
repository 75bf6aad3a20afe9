"""Simulators that are not avtorch's own: beside a car's log, as a baseline, and with the effects they lack."""

from avtorch.external.compare_simulators import SimulatorComparison as SimulatorComparison
from avtorch.external.compare_simulators import compare_simulators as compare_simulators
from avtorch.external.external_simulator import ExternalSimulator as ExternalSimulator
from avtorch.external.external_simulator import wrap as wrap
from avtorch.external.fmu import FmuSimulator as FmuSimulator
from avtorch.external.fmu_export import write_fmu as write_fmu
from avtorch.external.simulator import Simulator as Simulator
from avtorch.external.simulator import load_simulator as load_simulator
from avtorch.external.surrogate import SimulatorCheck as SimulatorCheck
from avtorch.external.surrogate import check_simulator as check_simulator

__all__ = [
    "ExternalSimulator",
    "FmuSimulator",
    "Simulator",
    "SimulatorCheck",
    "SimulatorComparison",
    "check_simulator",
    "compare_simulators",
    "load_simulator",
    "wrap",
    "write_fmu",
]
