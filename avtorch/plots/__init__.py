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
    from avtorch.plots.calibration_figures import calibration_figure
    from avtorch.plots.detectors import operating_curve, operating_figure
    from avtorch.plots.figures import (
        belief_figure,
        motion_figure,
        overview_figure,
        probability_figure,
        region_figure,
        stability_figure,
    )
    from avtorch.plots.gaps import gap_figure, gap_peak, gap_probability, gap_throughput
    from avtorch.plots.paper_figures import PAPER_PICTURES, paper_pictures
    from avtorch.plots.pedals import pedal_figure, pedal_lines
    from avtorch.plots.plane import gain_curve, region, setting_region, verdict_legend, verdict_map
    from avtorch.plots.posterior_figures import VALIDATION_PICTURES, validation_figures
    from avtorch.plots.posteriors import agreement_scatter, exact_density, joint_cloud, marginals
    from avtorch.plots.ranks import ecdf_difference, ecdf_of, pooled_rank_counts, rank_band, rank_plot
    from avtorch.plots.ratios import ratio_figure, ratio_whiskers
    from avtorch.plots.signatures import effect_signature, signature_figure
    from avtorch.plots.style import STYLE, save, show
    from avtorch.plots.time import belief_band, data_quality, events, motion, string_probability
    from avtorch.plots.whole_drive import diagnosis_figure

_HOME = {
    "avtorch.plots.calibration_figures": ("calibration_figure",),
    "avtorch.plots.detectors": (
        "operating_curve",
        "operating_figure",
    ),
    "avtorch.plots.figures": (
        "belief_figure",
        "motion_figure",
        "overview_figure",
        "probability_figure",
        "region_figure",
        "stability_figure",
    ),
    "avtorch.plots.gaps": (
        "gap_figure",
        "gap_peak",
        "gap_probability",
        "gap_throughput",
    ),
    "avtorch.plots.paper_figures": (
        "PAPER_PICTURES",
        "paper_pictures",
    ),
    "avtorch.plots.pedals": (
        "pedal_figure",
        "pedal_lines",
    ),
    "avtorch.plots.plane": (
        "gain_curve",
        "region",
        "setting_region",
        "verdict_legend",
        "verdict_map",
    ),
    "avtorch.plots.posterior_figures": (
        "VALIDATION_PICTURES",
        "validation_figures",
    ),
    "avtorch.plots.posteriors": (
        "agreement_scatter",
        "exact_density",
        "joint_cloud",
        "marginals",
    ),
    "avtorch.plots.ranks": (
        "ecdf_difference",
        "ecdf_of",
        "pooled_rank_counts",
        "rank_band",
        "rank_plot",
    ),
    "avtorch.plots.ratios": (
        "ratio_figure",
        "ratio_whiskers",
    ),
    "avtorch.plots.signatures": (
        "effect_signature",
        "signature_figure",
    ),
    "avtorch.plots.style": (
        "STYLE",
        "save",
        "show",
    ),
    "avtorch.plots.time": (
        "belief_band",
        "data_quality",
        "events",
        "motion",
        "string_probability",
    ),
    "avtorch.plots.whole_drive": ("diagnosis_figure",),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "PAPER_PICTURES",
    "STYLE",
    "VALIDATION_PICTURES",
    "agreement_scatter",
    "belief_band",
    "belief_figure",
    "calibration_figure",
    "data_quality",
    "diagnosis_figure",
    "ecdf_difference",
    "ecdf_of",
    "effect_signature",
    "events",
    "exact_density",
    "gain_curve",
    "gap_figure",
    "gap_peak",
    "gap_probability",
    "gap_throughput",
    "joint_cloud",
    "marginals",
    "motion",
    "motion_figure",
    "operating_curve",
    "operating_figure",
    "overview_figure",
    "paper_pictures",
    "pedal_figure",
    "pedal_lines",
    "pooled_rank_counts",
    "probability_figure",
    "rank_band",
    "rank_plot",
    "ratio_figure",
    "ratio_whiskers",
    "region",
    "region_figure",
    "save",
    "setting_region",
    "show",
    "signature_figure",
    "stability_figure",
    "string_probability",
    "validation_figures",
    "verdict_legend",
    "verdict_map",
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
