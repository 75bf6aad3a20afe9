"""Pictures: drawings that take an axes and return it, and the figures that the commands write.

Names are loaded when first used: a command pays for the pictures that it draws.

Example:
    >>> import numpy as np
    >>> from avtorch import plots
    >>> time = np.arange(0.0, 10.0, 0.1)
    >>> traces = {"speed": {"leader": 20 + np.sin(time), "with action": 20 + np.sin(time - 1)}}
    >>> plots.save(plots.motion_figure({}, time, traces), "motion.png").name
    'motion.png'
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avtorch.plots.diagnosis import ratio_figure
    from avtorch.plots.drive import diagnosis_figure
    from avtorch.plots.paper import paper_pictures
    from avtorch.plots.pedals import pedal_figure
    from avtorch.plots.plane import gain_curve, region, region_figure, stability_figure, verdict_legend
    from avtorch.plots.posteriors import marginals, validation_figures
    from avtorch.plots.signatures import effect_signature, signature_figure
    from avtorch.plots.style import STYLE, save, show
    from avtorch.plots.time import belief_figure, motion_figure, overview_figure, probability_figure

_HOME = {
    "diagnosis": "ratio_figure",
    "drive": "diagnosis_figure",
    "paper": "paper_pictures",
    "pedals": "pedal_figure",
    "plane": "gain_curve region region_figure stability_figure verdict_legend",
    "posteriors": "marginals validation_figures",
    "signatures": "effect_signature signature_figure",
    "style": "STYLE save show",
    "time": "belief_figure motion_figure overview_figure probability_figure",
}
_MODULE_OF = {name: f"avtorch.plots.{home}" for home, names in _HOME.items() for name in names.split()}

__all__ = [
    "STYLE",
    "belief_figure",
    "diagnosis_figure",
    "effect_signature",
    "gain_curve",
    "marginals",
    "motion_figure",
    "overview_figure",
    "paper_pictures",
    "pedal_figure",
    "probability_figure",
    "ratio_figure",
    "region",
    "region_figure",
    "save",
    "show",
    "signature_figure",
    "stability_figure",
    "validation_figures",
    "verdict_legend",
]


def __getattr__(name: str) -> Any:
    home = _MODULE_OF.get(name)
    if home is None:
        raise AttributeError(f"module 'avtorch.plots' has no attribute {name!r}")
    value = getattr(import_module(home), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
