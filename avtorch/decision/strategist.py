"""The strategist: the least intrusive setting that is good enough, out of a stated finite grid.

A setting is *sufficient* when

1. P(string stable) under the posterior draws reaches `required` (0.95), by the exact condition at the effective
   actuation (T_e, K_e) that setting gives every draw;
2. at most 5 % of the commands it would have sent over the last windows are clipped at the vehicle's limits, and it
   would not have collided, both in a replay of the closed loop (`replay.py`). The inversion formula ignores limits:
   without this condition, inverting a slow actuator would always win on paper.

Among the sufficient settings the strategist takes the one of least `total`: the intrusiveness of `grid.py` plus
`MARGIN` times the probability of string instability when the spread of the belief is doubled. The doubling accounts for
the prior, which pulls the first posterior after a change towards the past. Settings that reach `required` are replayed
in that order, until no remaining one could be better. Where no setting is sufficient, every setting that reaches
`required` has been replayed; the strategist then takes the best P(string stable) among those that clip at most five
percentage points more than the setting in force would have, and would have collided no harder (a leader who demands
more than the car can do clips every setting). Where P does not discriminate, mostly because it is 0 for all, the peak
gain at the belief's mean decides: a swing that grows 1.3 times per car is better than one that grows fivefold. Among
equals intrusiveness is weighed against clipping. The decision's `sufficient` is then false.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from avtorch.decision.grid import MARGIN, Candidates, Grid
from avtorch.decision.replay import History, replay
from avtorch.decision.settings import Setting
from avtorch.errors import InputError
from avtorch.vehicle.arguments import Number
from avtorch.vehicle.controllers import RAMP_RATE
from avtorch.vehicle.performance import Performance

_REPLAYED = 512  # at first; with few scenarios a larger batch costs hardly more
_PAIRS = 1024
_GAIN_PRICE = 0.05  # where none is sufficient, a peak gain e times as large weighs as much as this P(string stable)
_HIGHEST_GAIN = 1e3  # a loop that is not even locally stable has no peak; it is worse than any that has
_CLIPPING_PRICE = 10.0  # where none is sufficient, ten points of clipped commands weigh as much as a lower-level update
_SCREEN = 12


@dataclass(frozen=True)
class Decision:
    """The decision for each scenario; every tensor (scenario,).

    `setting`: the choice. `sufficient`: whether it meets both conditions; `p_string_stable` under the belief.
    `intrusiveness` as in `grid.py`. `predicted`: the performance in the replay. `strategies` lead from the default
    to the choice; `changes`: it differs from the setting in force. `driver_delay_s`: the time that the driver is
    allowed to set a longer time gap, 0 where none is asked. `why`: one sentence each.
    """

    setting: Setting
    sufficient: Tensor
    p_string_stable: Tensor
    intrusiveness: Tensor
    predicted: Performance
    strategies: list[set[int]]
    changes: Tensor
    driver_delay_s: Tensor
    why: list[str]


@dataclass(frozen=True)
class Strategist:
    """Chooses settings; see the module docstring.

    grid: what is on offer. required: P(string stable) to reach. most_clipped: share of commands. draws: of the
    posterior, used in the search (the figures reported use all that are given). dead_time [s]: of the vehicle.
    driver_delay [s]: where above zero the time gap is not set but asked for, and the driver needs that long.
    link_delay [s]: age of the leader's acceleration where it is heard (a grid with `feedforward`).
    Raises `InputError` for numbers out of range.

    Example:
        >>> import torch
        >>> from avtorch import Setting, Strategist
        >>> T_L = torch.linspace(1.3, 1.6, 61, dtype=torch.float64).unsqueeze(0)  # draws of one car
        >>> known = Setting(T_hat=1.45, K_hat=0.5)  # its model in the lower level, the nominal target
        >>> strategist, K_L = Strategist(), torch.full_like(T_L, 0.5)
        >>> [round(strategist.probability(s, T_L, K_L).item(), 2) for s in (Setting(), known)]
        [0.0, 1.0]
    """

    grid: Grid = field(default_factory=Grid)
    required: float = 0.95
    most_clipped: float = 0.05
    draws: int = 256
    dead_time: float = 0.0
    driver_delay: float = 0.0
    link_delay: float = 0.0
    ramp_rate: float = RAMP_RATE
    standstill: float = 5.0

    def __post_init__(self) -> None:
        for name in ("required", "most_clipped"):
            value = getattr(self, name)
            if not 0.0 < value < 1.0:
                raise InputError(f"{name}: found {value}, need a number between 0 and 1")
        if self.draws < 20:
            raise InputError(f"draws: found {self.draws}, need 20 or more")
        for name in ("driver_delay", "link_delay"):
            if not getattr(self, name) >= 0.0:
                raise InputError(f"{name}: found {getattr(self, name)} s, need 0 or more")

    def probability(self, setting: Setting, T_L: Tensor, K_L: Tensor) -> Tensor:
        """P(string stable) of a setting under draws, with this vehicle's dead time and link."""
        return setting.p_string_stable(T_L, K_L, dead_time=self.dead_time, link_delay=self.link_delay)

    @torch.no_grad()
    def decide(
        self,
        T_L: Tensor,
        K_L: Tensor,
        history: History,
        *,
        current: Setting,
        default: Setting,
        time_gap_now: Tensor | None = None,
        model_wrong: Tensor | None = None,
        accel_min: Number = -6.0,
        accel_max: Number = 4.0,
    ) -> Decision:
        """Choose for every scenario, from posterior draws T_L [s], K_L [-] (scenario, draw) and the last seconds.

        `current` is in force, `default` the driver's and engineer's choice; `time_gap_now` [s] where the gap is still
        on its way (default: there). `model_wrong` (scenario,) bool, default all: a change of the vehicle was detected,
        so keeping the lower level's model is penalised. Limits [m/s²] are numbers or (scenario,). Raises `InputError`
        for shapes that do not fit.
        """
        scenarios = T_L.shape[0]
        if T_L.ndim != 2 or K_L.shape != T_L.shape or history.lead_speed.shape[0] != scenarios:
            raise InputError(
                f"T_L, K_L, history: found {tuple(T_L.shape)}, {tuple(K_L.shape)} and "
                f"{history.lead_speed.shape[0]} scenarios, need (scenario, draw) and as many scenarios"
            )
        T_L, K_L = T_L.to(torch.float64), K_L.to(torch.float64)
        wrong = torch.ones(scenarios, dtype=torch.bool) if model_wrong is None else model_wrong
        mean = (T_L.mean(dim=-1), K_L.mean(dim=-1))
        every = max(1, T_L.shape[1] // self.draws)
        search = _Search(
            self,
            self.grid.candidates(*mean, current=current, default=default, model_wrong=wrong),
            history,
            belief=(T_L[:, ::every], K_L[:, ::every]),
            mean=mean,
            time_gap_now=current.time_gap if time_gap_now is None else time_gap_now,
            limits=(torch.as_tensor(accel_min).expand(scenarios), torch.as_tensor(accel_max).expand(scenarios)),
        )
        pick, sufficient = search.run()
        rows = torch.arange(scenarios)
        chosen = search.candidates.setting[rows, pick]
        predicted = search.prediction(pick)
        p = self.probability(chosen, T_L, K_L)
        p_deaf = p
        if bool(chosen.feedforward.any()):
            p_deaf = self.probability(chosen.replace(feedforward=0.0), T_L, K_L)
        asked = (chosen.time_gap > current.time_gap + 1e-9) & (self.driver_delay > 0.0)
        # Gains that follow from the gap are no strategy of their own.
        follow = self.grid.gains_of_gap is not None
        strategies = chosen.strategies(default.replace(gains=chosen.gains) if follow else default)
        why = []
        for i, used in enumerate(strategies):
            what = _steps(used, chosen[i : i + 1], default[i : i + 1], bool(asked[i]), float(p_deaf[i]))
            if chosen.as_dict(i) == current.as_dict(i):
                what = f"setting in force stays ({what})"
            clipped = f"{100.0 * float(predicted.clipped_share[i]):.1f} % of commands clipped"
            past = f"{clipped} in a replay of the past {history.seconds:.0f} s"
            result = f"P(string stable) {float(p[i]):.2f}, {past}"
            if bool(sufficient[i]):
                why.append(f"least intrusive sufficient setting: {what} ({result})")
            else:
                aim = f"at {self.required:g} with {100 * self.most_clipped:g} % of commands clipped or less"
                why.append(f"no setting of the grid keeps P(string stable) {aim}; the best one: {what} ({result})")
        cost, changes = search.candidates.cost[rows, pick], chosen.differs(current)
        return Decision(chosen, sufficient, p, cost, predicted, strategies, changes, asked * self.driver_delay, why)


def _steps(used: set[int], chosen: Setting, default: Setting, asked: bool, p_deaf: float) -> str:
    """The steps of the strategies `used` from one scenario's default to its choice, in words.

    `asked`: the driver is asked to set the gap. `p_deaf`: P(string stable) if the leader's acceleration is no longer
    received.
    """
    now = chosen.as_dict()
    steps = []
    if 1 in used:
        steps.append(f"lower level models T {now['T_hat']:.2f} s, K {now['K_hat']:.2f} and targets {now['T_d']:.2f} s")
    if 2 in used:
        verb = "driver asked for a time gap of" if asked else "time gap"
        steps.append(f"{verb} {now['time_gap_s']:g} s instead of {float(default.time_gap[0]):g} s")
    if 3 in used:
        steps.append("gains " + ", ".join(f"{k:g}" for k in now["gains"]))
    if 4 in used:
        lost = f"P(string stable) {p_deaf:.2f} if the link is lost"
        steps.append(f"leader's acceleration fed forward with k_f {now['feedforward']:g} ({lost})")
    return "; ".join(steps) if steps else "default setting"


class _Search:
    """One decision's search over (scenario, candidate); `belief` are the draws used, `mean` of all of them."""

    def __init__(
        self,
        rules: Strategist,
        candidates: Candidates,
        history: History,
        *,
        belief: tuple[Tensor, Tensor],
        mean: tuple[Tensor, Tensor],
        time_gap_now: Tensor,
        limits: tuple[Tensor, Tensor],
    ) -> None:
        self.rules, self.candidates, self.history, self.belief = rules, candidates, history, belief
        self.gap_now, self.limits = time_gap_now, limits
        self.T, self.K = mean
        shape = candidates.cost.shape
        self.p = torch.full(shape, torch.nan, dtype=torch.float64)
        self.total = candidates.cost.clone()
        self.predictions: Performance | None = None
        self.replayed = torch.zeros(shape, dtype=torch.bool)

    def run(self) -> tuple[Tensor, Tensor]:
        """(choice, whether it is sufficient), (scenario,) each."""
        self._evaluate()
        scenarios = len(self.T)
        best = torch.full((scenarios,), torch.inf, dtype=torch.float64)
        pick = torch.zeros(scenarios, dtype=torch.long)
        tries = max(4, _REPLAYED // scenarios)
        while True:
            worth = (self.p >= self.rules.required) & ~self.replayed & (self.total < best[:, None])
            if not bool(worth.any()):
                break
            # Small chunks first, as the least intrusive setting usually is sufficient; larger ones where it is not.
            self._replay(torch.arange(scenarios), worth, self.total, tries)
            tries *= 4
            best, pick = torch.where(self._sufficient(), self.total, torch.inf).min(dim=1)
        lost = torch.nonzero(torch.isinf(best))[:, 0]
        if len(lost):
            pick[lost] = self._best_of_the_rest(lost)
        return pick, torch.isfinite(best)

    def _best_of_the_rest(self, lost: Tensor) -> Tensor:
        """Where none is sufficient: the best P(string stable) of settings that clip little more than the one in force.

        The setting in force is the first candidate. All that reach the required P have been replayed already.
        """
        cost = self.candidates.cost[lost]
        in_force = torch.zeros_like(cost, dtype=torch.bool)
        in_force[:, 0] = True
        rest = torch.isfinite(cost) & ~self.replayed[lost]
        worth = self.p[lost].clamp_max(self.rules.required) - _GAIN_PRICE * self._log_peak_gain(lost)
        self._replay(lost, rest, torch.where(in_force, -torch.inf, -worth.nan_to_num(0.0) + 1e-6 * cost), 16)
        assert self.predictions is not None
        clipped, nearest = self.predictions.clipped_share[lost], self.predictions.min_spacing_m[lost]
        bearable = clipped <= clipped[:, :1] + self.rules.most_clipped
        no_closer = nearest >= nearest[:, :1].clamp_max(1e-9)
        evaluated = self.replayed[lost] & torch.isfinite(self.p[lost])
        eligible = in_force | (evaluated & bearable & no_closer)
        # Among equals intrusiveness and clipping are weighed against each other.
        # An amplified demand that is clipped most of the time is bang-bang control: clipping costs by the doubling.
        doublings = self.candidates.setting[lost].amplification().log2().clamp_min(0.0)
        price = self.total[lost] + _CLIPPING_PRICE * clipped * (1.0 + doublings)
        return torch.where(eligible, worth - 1e-4 * price, -torch.inf).argmax(dim=1)

    def _log_peak_gain(self, rows: Tensor) -> Tensor:
        """log of the peak gain at the belief's mean, (row, candidate), 0 where no frequency is amplified."""
        setting = self.candidates.setting[rows]
        gain = setting.peak_gain(
            self.T[rows, None], self.K[rows, None], dead_time=self.rules.dead_time, link_delay=self.rules.link_delay
        )
        return gain.nan_to_num(torch.inf).clamp(1.0, _HIGHEST_GAIN).log()

    def prediction(self, pick: Tensor) -> Performance:
        assert self.predictions is not None
        return self.predictions.map(lambda x: x[torch.arange(len(pick)), pick])

    def _evaluate(self) -> None:
        """P(string stable) of every candidate on offer, and the price of the margin of those that reach what is
        required.

        Most candidates fail clearly: a few draws screen them. One that reaches the required 0.95 is string stable in
        fewer than five of twelve draws once in 10⁸ times.
        """
        r, c = torch.nonzero(torch.isfinite(self.candidates.cost)).unbind(1)
        self.p[r, c] = self._probability(r, c, self.belief, every=self.belief[0].shape[1] // _SCREEN)
        left = self.p[r, c] > 0.4
        r, c = r[left], c[left]
        self.p[r, c] = self._probability(r, c, self.belief)
        left = self.p[r, c] >= self.rules.required
        r, c = r[left], c[left]
        unstable = 1.0 - self._probability(r, c, _widened(*self.belief), every=2)
        self.total[r, c] += MARGIN * unstable

    def _probability(self, r: Tensor, c: Tensor, belief: tuple[Tensor, Tensor], *, every: int = 1) -> Tensor:
        """P(string stable) of the pairs (scenario r, candidate c), from every n-th draw."""
        T, K = (x[:, :: max(1, every)] for x in belief)
        parts = [
            self.rules.probability(self.candidates.setting[i, j], T[i], K[i])
            for i, j in zip(r.split(_PAIRS), c.split(_PAIRS), strict=True)
            if len(i)
        ]
        return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.float64)

    def _replay(self, rows: Tensor, worth: Tensor, rank: Tensor, count: int) -> None:
        """Replay, for each of `rows`, the `count` candidates of least `rank` among those `worth` it."""
        rank = torch.where(worth, rank, torch.inf)
        busy = worth.any(dim=1)
        rows, rank, worth = rows[busy], rank[busy], worth[busy]
        if len(rows) == 0:
            return
        count = min(count, int(worth.sum(dim=1).max()))
        columns = rank.argsort(dim=1, stable=True)[:, :count]
        seen = replay(
            self.history[rows],
            self.candidates.setting[rows[:, None], columns],
            T_L=self.T[rows],
            K_L=self.K[rows],
            time_gap_now=self.gap_now[rows],
            accel_min=self.limits[0][rows],
            accel_max=self.limits[1][rows],
            standstill=self.rules.standstill,
            ramp_rate=self.rules.ramp_rate,
            delay=self.rules.driver_delay,
            link_delay=self.rules.link_delay,
        )
        if self.predictions is None:
            self.predictions = seen.map(lambda x: torch.full(self.p.shape, torch.nan, dtype=torch.float64))
        for name, value in vars(seen).items():
            getattr(self.predictions, name)[rows[:, None], columns] = value
        # Columns that only pad the batch are dropped, so that a scenario's result does not depend on the batch.
        self.replayed[rows[:, None], columns] |= worth.gather(1, columns)

    def _sufficient(self) -> Tensor:
        assert self.predictions is not None
        return (
            self.replayed
            & (self.p >= self.rules.required)
            & (self.predictions.clipped_share <= self.rules.most_clipped)
            & (self.predictions.min_spacing_m > 0.0)
        )


def _widened(T_L: Tensor, K_L: Tensor) -> tuple[Tensor, Tensor]:
    """The belief with its spread doubled about the mean, in log space, draws on the last dimension."""

    def twice(draws: Tensor) -> Tensor:
        z = draws.log()
        return (2.0 * z - z.mean(dim=-1, keepdim=True)).exp()

    return twice(T_L), twice(K_L)
