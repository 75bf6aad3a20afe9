"""The monitor: evaluates all detectors on every window's posterior, for many scenarios at once.

Detectors, each reported by its own name:

- `stability` (default): under the belief and the setting in force the loop is probably not string stable. It takes
  precedence over all others (paper, Strategy 1).
- `accepted_change` (default): the paper's rule, estimate outside accepted value ± (0.2 s, 0.15), with one more
  condition: the posterior mean must be outside *and* so must nearly all of the posterior. The accepted value moves by
  `accept`.
- `kl`, `hellinger`, `w2`: divergence from a baseline posterior beyond chance at a stated false-alarm rate.
- `shewhart`, `ewma`, `cusum`: control charts on the standardised innovations, with a stated in-control run length.

The baseline pools all excited windows since the last acceptance in which no detector of change was alarmed (a
stability alarm may be the fault of the setting). An unexcited window carries no information about the vehicle: it
raises no alarm and updates no statistic.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from avtorch.decision.algorithm2 import ACCEPTED_CHANGE
from avtorch.decision.charts import CHARTS, Chart
from avtorch.decision.divergence import DIVERGENCES, Gaussian, divergence, divergence_p_value, innovation
from avtorch.decision.settings import Setting
from avtorch.errors import InputError
from avtorch.inference.estimator import shaped_as

DETECTORS = ("stability", "accepted_change", *DIVERGENCES, *CHARTS)
"""All detectors, in order of precedence."""

DEFAULT_DETECTORS = ("stability", "accepted_change")
"""The detectors that alert by default."""


@dataclass(frozen=True)
class MonitorReport:
    """The result of one window's update; every tensor (scenario,).

    `alerts` by detector's name, in order of precedence, bool; `statistics` by name: the value each detector compared;
    `p_string_stable`, `p_local_stable` under the belief with the setting in force; `mean` (T_L [s], K_L [-]).
    """

    alerts: dict[str, Tensor]
    statistics: dict[str, Tensor]
    p_string_stable: Tensor
    p_local_stable: Tensor
    mean: tuple[Tensor, Tensor]
    accepted: tuple[Tensor, Tensor]

    @property
    def any(self) -> Tensor:
        """Whether any detector is alarmed, (scenario,)."""
        return torch.stack(list(self.alerts.values())).any(dim=0)

    @property
    def actuation_changed(self) -> Tensor:
        """Whether a detector of change (any but `stability`) is alarmed, (scenario,)."""
        changed = [on for name, on in self.alerts.items() if name != "stability"]
        return torch.stack(changed).any(dim=0) if changed else torch.zeros_like(self.p_string_stable, dtype=torch.bool)

    def names(self, scenario: int = 0) -> list[str]:
        """Alarmed detectors of one scenario, the one that takes precedence first."""
        return [name for name, on in self.alerts.items() if bool(on[scenario])]

    def why(self, name: str, scenario: int = 0) -> str:
        """One sentence on one detector in one scenario."""
        T, K = (float(m[scenario]) for m in self.mean)
        T0, K0 = (float(a[scenario]) for a in self.accepted)
        seen = f"T_L {T:.2f} s, K_L {K:.2f}"
        if name == "stability":
            p, local = float(self.p_string_stable[scenario]), float(self.p_local_stable[scenario])
            worse = f", and P(locally stable) only {local:.2f}" if local < 0.95 else ""
            return f"P(string stable) is {p:.2f} with the setting in force{worse} ({seen})"
        if name == "accepted_change":
            sure = float(self.statistics[name][scenario])
            return f"{seen} left the accepted values ({T0:.2f} s, {K0:.2f}) with probability {sure:.3f}"
        value = float(self.statistics[name][scenario])
        if name in CHARTS:
            limit = float(self.statistics[name + "_limit"][scenario])
            return f"{name} chart at {value:.2f}, limit {limit:.2f} ({seen})"
        p = float(self.statistics[name + "_p_value"][scenario])
        return f"{name} divergence from the baseline {value:.3g}, by chance with probability {p:.1e} ({seen})"


class Monitor:
    """Monitors `scenarios` beliefs; see the module docstring for the detectors.

    accepted: (T_L [s], K_L [-]) accepted at the start, numbers or (scenario,); change: accepted change of the two.
    certainty: posterior probability of being outside that an `accepted_change` alarm takes. stability_level: an alarm
    where P(string stable) is below it; a little below the 0.95 a new setting must reach, so that
    scatter in the next window does not raise an alarm on a sufficient setting. false_alarm_rate: of each divergence
    detector, per excited window. arl: in-control average run length of each chart [excited windows]. unevenness: SDs,
    as shares of T_L and K_L, by which a sound vehicle differs from window to window: divergences and charts without it
    alarm on any car that is not GLVD to a per cent (0.1 and 0.03 kept them quiet, benchmarks/detectors). dead_time [s]:
    of the vehicle, number or (scenario,). link_delay [s]: of the leader's acceleration where it is fed forward. Raises
    `InputError` for unknown detectors and numbers out of range.

    Example:
        >>> import torch
        >>> from avtorch import Monitor, Setting
        >>> g, monitor = torch.Generator().manual_seed(0), Monitor()
        >>> noise = 0.05 * torch.randn(2, 1, 500, dtype=torch.float64, generator=g)
        >>> for T_L, K_L in ((0.3, 1.0), (1.5, 0.5)):  # before and after the degradation
        ...     report = monitor.update(T_L * noise[0].exp(), K_L * noise[1].exp(), torch.tensor([True]), Setting())
        ...     print(report.names())
        []
        ['stability', 'accepted_change']
    """

    def __init__(
        self,
        scenarios: int = 1,
        *,
        detectors: Sequence[str] = DEFAULT_DETECTORS,
        accepted: tuple[float | Tensor, float | Tensor] = (0.3, 1.0),
        change: tuple[float, float] = ACCEPTED_CHANGE,
        certainty: float = 0.9,
        stability_level: float = 0.9,
        false_alarm_rate: float = 0.002,
        arl: float = 500.0,
        unevenness: tuple[float, float] = (0.0, 0.0),
        dead_time: float | Tensor = 0.0,
        link_delay: float = 0.0,
    ) -> None:
        unknown = [name for name in detectors if name not in DETECTORS]
        if unknown or not detectors:
            raise InputError(f"detectors: found {unknown or 'none'}, need some of {', '.join(DETECTORS)}")
        for name, value in (
            ("certainty", certainty),
            ("stability_level", stability_level),
            ("false_alarm_rate", false_alarm_rate),
        ):
            if not 0.0 < value < 1.0:
                raise InputError(f"{name}: found {value}, need a number between 0 and 1")
        if not (change[0] > 0.0 and change[1] > 0.0):
            raise InputError(f"change: found {change}, need two numbers above 0")
        if len(unevenness) != 2 or not all(u >= 0.0 for u in unevenness):
            raise InputError(f"unevenness: found {unevenness}, need two numbers of 0 or more")
        if scenarios < 1:
            raise InputError(f"scenarios: found {scenarios}, need 1 or more")
        self.detectors = tuple(name for name in DETECTORS if name in detectors)
        self.scenarios = scenarios
        self.change = change
        self.certainty = certainty
        self.stability_level = stability_level
        self.false_alarm_rate = false_alarm_rate
        self.unevenness = unevenness
        self.dead_time = dead_time
        self.link_delay = link_delay
        first, second = (torch.as_tensor(a, dtype=torch.float64).expand(scenarios).clone() for a in accepted)
        self.accepted = (first, second)
        self._charts = {name: Chart(name, scenarios, arl) for name in CHARTS if name in self.detectors}
        unit = torch.eye(2, dtype=torch.float64).expand(scenarios, 2, 2)
        self._baseline = Gaussian(torch.zeros(scenarios, 2, dtype=torch.float64), unit)
        self._has_baseline = torch.zeros(scenarios, dtype=torch.bool)
        self._window = self._baseline
        self._mean = self.accepted

    @torch.no_grad()
    def update(self, T_L: Tensor, K_L: Tensor, excited: Tensor, setting: Setting) -> MonitorReport:
        """Update with a window: posterior draws T_L [s], K_L [-] (scenario, draw), excited (scenario,), setting in
        force.

        Raises `InputError` for shapes that do not fit.
        """
        if T_L.ndim != 2 or T_L.shape != K_L.shape or T_L.shape[0] != self.scenarios:
            raise InputError(
                f"T_L, K_L: found {tuple(T_L.shape)} and {tuple(K_L.shape)}, need ({self.scenarios}, draw) both"
            )
        if excited.shape != (self.scenarios,):
            raise InputError(f"excited: found {tuple(excited.shape)}, need ({self.scenarios},)")
        T_L, K_L = T_L.to(torch.float64), K_L.to(torch.float64)
        mean = (T_L.mean(dim=-1), K_L.mean(dim=-1))
        window = Gaussian.of_draws(T_L, K_L, unevenness=self.unevenness)
        p_local, p_string = setting.p_locally_and_string_stable(
            T_L, K_L, dead_time=self.dead_time, link_delay=self.link_delay
        )

        alerts: dict[str, Tensor] = {}
        statistics: dict[str, Tensor] = {}
        comparable = excited & self._has_baseline
        # Scenarios without a baseline are compared with themselves; their results are not used.
        baseline = _choose(self._has_baseline, self._baseline, window)
        for name in self.detectors:
            if name == "stability":
                statistics[name] = p_string  # implies local stability, draw by draw
                alerts[name] = excited & (statistics[name] < self.stability_level)
            elif name == "accepted_change":
                alarmed, statistics[name] = self._accepted_change(T_L, K_L, mean)
                alerts[name] = excited & alarmed
            elif name in self._charts:
                chart = self._charts[name]
                alerts[name] = chart.step(innovation(window, baseline), comparable)
                statistics[name] = chart.last_statistic.amax(dim=-1)
                statistics[name + "_limit"] = torch.full_like(p_string, chart.edge)
            else:
                statistics[name] = divergence(name, window, baseline)  # type: ignore[arg-type]
                chance = divergence_p_value(name, window, baseline)  # type: ignore[arg-type]
                statistics[name + "_p_value"] = chance
                alerts[name] = comparable & (chance < self.false_alarm_rate)

        report = MonitorReport(alerts, statistics, p_string, p_local, mean, self.accepted)
        # The stability alarm may be the setting's fault; only a changed vehicle spoils the baseline.
        calm = excited & ~report.actuation_changed
        pooled = _choose(self._has_baseline, self._baseline.combine(window), window)
        self._baseline = _choose(calm, pooled, self._baseline)
        self._has_baseline = self._has_baseline | calm
        self._window = _choose(excited, window, self._window)
        self._mean = (torch.where(excited, mean[0], self._mean[0]), torch.where(excited, mean[1], self._mean[1]))
        return report

    def accept(self, where: Tensor) -> None:
        """Make the present state the new baseline in the scenarios `where` (scenario,) bool, after it was accepted or
        acted on.

        The accepted values become the means of the last excited window; the baseline becomes that window's posterior
        and the charts start afresh.
        """
        T, K = (torch.where(where, new, old) for new, old in zip(self._mean, self.accepted, strict=True))
        self.accepted = (T, K)
        self._baseline = _choose(where, self._window, self._baseline)
        self._has_baseline = self._has_baseline | where
        for chart in self._charts.values():
            chart.restart(where)

    def state_dict(self) -> dict[str, Any]:
        """The whole state that later updates depend on, as tensors and dicts of tensors."""
        return {
            "accepted": [a.clone() for a in self.accepted],
            "mean": [m.clone() for m in self._mean],
            "baseline": [t.clone() for t in self._baseline],
            "window": [t.clone() for t in self._window],
            "has_baseline": self._has_baseline.clone(),
            "charts": {name: chart.state_dict() for name, chart in self._charts.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore a state bit for bit.

        Raises `InputError`, and leaves the monitor unchanged, where the state is of other charts or scenarios, has
        other shapes or types than a monitor saves, or holds numbers that are not finite.
        """
        shaped_as(self.state_dict(), state, "state: monitor")
        self.accepted = (state["accepted"][0].clone(), state["accepted"][1].clone())
        self._mean = (state["mean"][0].clone(), state["mean"][1].clone())
        self._baseline = Gaussian(*(t.clone() for t in state["baseline"]))
        self._window = Gaussian(*(t.clone() for t in state["window"]))
        self._has_baseline = state["has_baseline"].clone()
        for name, chart in self._charts.items():
            chart.load_state_dict(state["charts"][name])

    def _accepted_change(self, T_L: Tensor, K_L: Tensor, mean: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """(alarm, probability of being outside) (scenario,), of T_L or K_L, whichever is outside more probably."""
        sure = torch.zeros_like(mean[0])
        for draws, centre, accepted, width in zip((T_L, K_L), mean, self.accepted, self.change, strict=True):
            outside = ((draws - accepted.unsqueeze(-1)).abs() > width).to(draws.dtype).mean(dim=-1)
            sure = torch.maximum(sure, torch.where((centre - accepted).abs() > width, outside, 0.0))
        return sure >= self.certainty, sure


def _choose(where: Tensor, a: Gaussian, b: Gaussian) -> Gaussian:
    return Gaussian(torch.where(where[:, None], a.mean, b.mean), torch.where(where[:, None, None], a.cov, b.cov))
