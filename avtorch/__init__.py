"""From a drive log to a belief about an automated vehicle's actuation, and from the belief to an action.

The public face. Names are loaded when first used, so that `import avtorch` and the command line's help cost nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from avtorch.version import __version__ as __version__

if TYPE_CHECKING:
    from avtorch import decision, gap, inference, io, plots, validation, vehicle
    from avtorch.decision.algorithm2 import algorithm2
    from avtorch.decision.estimation import Estimates, estimate
    from avtorch.decision.monitor import Monitor
    from avtorch.decision.settings import Setting
    from avtorch.decision.strategist import Strategist
    from avtorch.decision.supervisor import Supervisor
    from avtorch.errors import InputError
    from avtorch.external.compare_simulators import compare_simulators
    from avtorch.external.external_simulator import ExternalSimulator
    from avtorch.gap.compare import compare
    from avtorch.gap.diagnose import diagnose
    from avtorch.gap.result.diagnosis import Diagnosis
    from avtorch.inference import SGLD, BeliefStream, SequentialInference
    from avtorch.io import Log
    from avtorch.logcheck.check import LogCheck, check
    from avtorch.validation import Validation, validate
    from avtorch.vehicle import (
        GLVD,
        MPC,
        ClosedLoop,
        GLVDPlant,
        Leader,
        LinearController,
        LowerLevel,
        performance,
        simulate,
        stability,
    )

_HOME = {
    "avtorch": "decision gap inference io plots validation vehicle",
    "avtorch.decision.algorithm2": "algorithm2",
    "avtorch.decision.estimation": "Estimates estimate",
    "avtorch.decision.monitor": "Monitor",
    "avtorch.decision.settings": "Setting",
    "avtorch.decision.strategist": "Strategist",
    "avtorch.decision.supervisor": "Supervisor",
    "avtorch.errors": "InputError",
    "avtorch.external.compare_simulators": "compare_simulators",
    "avtorch.external.external_simulator": "ExternalSimulator",
    "avtorch.gap.compare": "compare",
    "avtorch.gap.diagnose": "diagnose",
    "avtorch.gap.result.diagnosis": "Diagnosis",
    "avtorch.inference": "SGLD BeliefStream SequentialInference",
    "avtorch.io": "Log",
    "avtorch.logcheck.check": "LogCheck check",
    "avtorch.validation": "Validation validate",
    "avtorch.vehicle": "GLVD MPC ClosedLoop GLVDPlant Leader LinearController LowerLevel "
    "performance simulate stability",
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names.split()}

__all__ = [
    "GLVD",
    "MPC",
    "SGLD",
    "BeliefStream",
    "ClosedLoop",
    "Diagnosis",
    "Estimates",
    "ExternalSimulator",
    "GLVDPlant",
    "InputError",
    "Leader",
    "LinearController",
    "Log",
    "LogCheck",
    "LowerLevel",
    "Monitor",
    "SequentialInference",
    "Setting",
    "Strategist",
    "Supervisor",
    "Validation",
    "algorithm2",
    "check",
    "compare",
    "compare_simulators",
    "decision",
    "diagnose",
    "estimate",
    "gap",
    "inference",
    "io",
    "performance",
    "plots",
    "simulate",
    "stability",
    "validate",
    "validation",
    "vehicle",
]


def __getattr__(name: str) -> Any:
    home = _MODULE_OF.get(name)
    if home is None:
        raise AttributeError(f"module 'avtorch' has no attribute {name!r}")
    module = import_module(f"avtorch.{name}" if home == "avtorch" else home)
    if home == "avtorch":
        return module
    # a submodule such as stability is an attribute of its package only once imported
    value = import_module(f"{home}.{name}") if name == "stability" else getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
