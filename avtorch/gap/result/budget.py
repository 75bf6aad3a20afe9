"""The gap's budget: its parts, random causes, what is unexplained and where, and the sentence a person reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from avtorch.gap.quantity import Quantity, of_fields, plain
from avtorch.gap.result.counted_rows import HORIZON_S
from avtorch.gap.simulator.effect import named_cause

MATERIAL = 0.03
"""Share from which something counts, unless a user says otherwise: a part of the bare baseline's squared error, what is
unexplained of the gap."""
LIKELY = 0.5
"""Probability from which a part is named."""
Axis = Literal["time", "speed", "command", "frequency", "signal"]

_UNNAMED = "a force of command and speed without a name"
UNITS: dict[Axis, str] = {"time": "s", "speed": "m/s", "command": "m/s²", "frequency": "Hz", "signal": ""}


@dataclass(frozen=True)
class Location:
    """A part of the gap: `begin` to `end` on an `axis`, with its `share` of the cause's contribution.

    Times are on the log's own clock [s], the others [m/s, m/s², Hz]; on the axis `signal` both are `"actuation"` (the
    car's motion differs) or `"sensing"` (the accelerometer's reading differs). `q_value`: the false-discovery rate at
    which all parts with a q-value as small are named.
    """

    axis: Axis
    begin: float | str
    end: float | str
    share: float
    q_value: float

    def words(self, epoch_s: float = 0.0) -> str:
        """The part as a phrase; times count from `epoch_s`, the log's start on its own clock."""
        if isinstance(self.begin, str) or isinstance(self.end, str):
            return "in the car's motion" if self.begin == "actuation" else "in the accelerometer's reading"
        if self.axis == "time":
            return f"from {self.begin - epoch_s:.1f} to {self.end - epoch_s:.1f} s after the log's start"
        at, unit = "frequencies" if self.axis == "frequency" else f"{self.axis}s", UNITS[self.axis]
        ends = f"from {self.begin:.2g} to {self.end:.2g}" if self.begin else f"below {self.end:.2g}"
        return f"at {at} {ends} {unit}"

    def to_dict(self) -> dict[str, Any]:
        """An entry of `where` in `diagnosis.json`."""
        part = {"axis": self.axis, "from": self.begin, "to": self.end}
        return part | {"share": self.share, "q_value": self.q_value}


@dataclass(frozen=True)
class Part:
    """A cause: its `share` of the gap, `after` it the root of the energy that is left, and its parameters.

    `alias_set`: effects that these drives cannot distinguish from it, itself among them. `probability`: that one of
    them is really there. `onset_s` on the log's own clock, None: from the start. `plausible`: its parameters are
    physically possible.
    """

    name: str
    alias_set: tuple[str, ...]
    probability: float
    share: Quantity
    after: float
    parameters: Mapping[str, Quantity]
    onset_s: float | None = None
    plausible: bool = True

    def to_dict(self) -> dict[str, Any]:
        out = of_fields(self)
        del out["share"]["sd"]
        return {"names": [out.pop("name")]} | out


@dataclass(frozen=True)
class ChancePart:
    """A random cause, such as a gust: no rollout predicts it, so it is a part of the noise.

    `share_of_noise`: of the variance that is left with all parts (outliers: of the accelerometer's errors); None where
    it was not estimated. `alias_set`: effects that these drives cannot distinguish from it, itself among them (it is
    added).
    """

    name: str
    probability: float
    share_of_noise: float | None = None
    parameters: Mapping[str, Quantity] = field(default_factory=dict)
    plausible: bool = True
    alias_set: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "alias_set", tuple(sorted({self.name, *self.alias_set})))

    def to_dict(self) -> dict[str, Any]:
        out = of_fields(self)
        return {"names": [out.pop("name")]} | out


@dataclass(frozen=True)
class FamilyShare:
    """What acts in one place of the car, under whatever names: `names` of effects that the drives tell apart, and
    `form` of a part without a name, None where there is none; `hidden`: names that may stand behind it.

    `probability`: that something is there. `size_mps2`: root mean square of what it adds to the readings, over
    resampled blocks of the drive. `takes_off`: share of the gap that held-out free runs lose by it, everything else
    refitted without it; what two families can do alike is in neither. Both are None where nothing is likely.

    `excited`: whether an effect of the family would have shown at its typical size. `unseen_mps2`: the root mean square
    that the least visible of its effects could have without showing; None where only chance acts.
    """

    family: str
    names: tuple[str, ...] = ()
    form: str | None = None
    hidden: tuple[str, ...] = ()
    probability: float = 0.0
    size_mps2: Quantity | None = None
    takes_off: Quantity | None = None
    excited: bool = True
    unseen_mps2: float | None = None

    @property
    def present(self) -> bool:
        """Whether something of it is more likely there than not."""
        return self.probability >= LIKELY

    def to_dict(self) -> dict[str, Any]:
        """An entry of `budget.families`."""
        return of_fields(self, intervals=True)


@dataclass(frozen=True)
class Unexplained:
    """The share that is reproducible and that no cause explains.

    `material`: surely more than a user cares for; `probability`: that it is more. Where it is material, `where` holds
    the parts of the drive that it lies in, if any in particular, and `resembles` the effect that promises to explain
    much of it but is not certain enough to be named. `still`: the share of the squared error left that a black box
    takes off on blocks that taught neither, from what it surely does to what the log could have shown. `carried`: what
    of the gap a force without a name takes off, which the repaired simulator carries; a part of `share`.
    """

    share: Quantity
    material: bool
    probability: float = 0.0
    where: tuple[Location, ...] = ()
    resembles: str | None = None
    still: Quantity | None = None
    carried: Quantity | None = None

    @property
    def beyond_carried(self) -> Quantity:
        """The share that the repaired simulator does not carry either."""
        if self.carried is None:
            return self.share
        left = [max(x - y, 0.0) for x, y in ((self.share.q05, self.carried.q05), (self.share.q95, self.carried.q95))]
        mean = max(self.share.mean - self.carried.mean, 0.0)
        return Quantity(mean, self.share.sd, min(mean, *left), max(mean, *left))

    def rest(self, material: float) -> str:
        """What the error that is left is, in words: noise only where no black box could take off what matters."""
        if self.still is None or self.still.q95 < material:
            return "noise"
        low, high = (round(100 * x) for x in (self.still.q05, self.still.q95))
        if low == 0 and high == 100:
            return "noise or what a black box may still foretell: this log cannot tell"
        if high == 100:  # the log bounds it from below alone
            return f"noise but for {low} % or more, which a black box may still foretell"
        return f"noise but for {low} to {high} %, which a black box may still foretell"

    def places(self, epoch_s: float = 0.0) -> str:
        """Where it lies and what it resembles, in words; empty where nothing was found. Times count from `epoch_s`."""
        where = ", ".join(part.words(epoch_s) for part in self.where)
        alike = "" if self.resembles is None else f"most like {self.resembles}"
        return "; ".join(x for x in (where, alike) if x)

    def to_dict(self) -> dict[str, Any]:
        return of_fields(self, intervals=True)


@dataclass(frozen=True)
class ChannelError:
    """Root mean squared error of rollouts in one channel [m/s or m/s²]: before, at the floor, and with all causes."""

    before: float
    floor: float
    left: float


@dataclass(frozen=True)
class Budget:
    """The gap's budget: roots of energies `before`, `left` and `floor` (1 by definition), and where they come from.

    `parts` in the order of their shares; these and `unexplained` sum to 1. `repaired`: `T_L` [s] and `K_L` [-] with all
    parts. Where rollouts show no gap, shares mean nothing. `horizon_s` [s] of the rollouts: 10 s, or the longest
    stretch.
    """

    before: float
    left: float
    by_channel: Mapping[str, ChannelError]
    parts: tuple[Part, ...]
    unexplained: Unexplained
    repaired: Mapping[str, Quantity]
    chance: tuple[ChancePart, ...] = ()
    material: float = MATERIAL
    floor: float = 1.0
    horizon_s: float = HORIZON_S
    by_drives: bool = False
    families: tuple[FamilyShare, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Causes that are more likely there than not: parts, the largest first, then those that chance decides."""
        return tuple(x.name for x in (*self.parts, *self.chance) if x.probability >= LIKELY)

    @property
    def left_above_noise(self) -> float:
        """Share of the squared error that is left, with all parts, which is above the floor; the rest is noise."""
        return max(1.0 - (self.floor / self.left) ** 2, 0.0)

    @property
    def error(self) -> tuple[Quantity, Quantity]:
        """Shares of the squared error that is left: reproducible, and noise; as far as a black box tells them apart."""
        mean, still = self.left_above_noise, self.unexplained.still
        low, high = (mean, mean) if still is None else (min(still.q05, mean), max(still.q95, mean))
        return Quantity(mean, 0.0, low, high), Quantity(1 - mean, 0.0, 1 - high, 1 - low)

    @property
    def verdict(self) -> tuple[str, ...]:
        """`names`; without any `("unknown",)` where something material is reproducible, else `("none",)`."""
        return self.names or (("unknown",) if self.unexplained.material else ("none",))

    @property
    def partial(self) -> bool:
        """Whether causes are named and something material is left besides."""
        return bool(self.names) and self.unexplained.material

    def __str__(self) -> str:
        """What a person reads first."""
        if self.names:
            return self._sentence(lead="")
        takes_off, rest = f"{_UNNAMED} takes off {percent(self._takes_off)} of", self.unexplained.rest(self.material)
        if self.unexplained.material:
            return f"No known effect explains the gap{f', but {takes_off} it' if self._takes_off else ''}."
        if not self._takes_off and rest == "noise":
            return "Nothing material is missing."
        return f"No known effect is missing; {f'{takes_off} the gap' if self._takes_off else f'the error is {rest}'}."

    def beside_its_name(self) -> str:
        """As `str()`, where the sentence before has told the one part that is named."""
        if len(self.names) != 1 or len(self.parts) != 1:
            return str(self)
        return self._sentence(lead=f"That is {percent(self.parts[0].share.mean)} of the gap")

    @property
    def rest(self) -> str:
        """A sentence on the error that is left, beside the named causes; empty without any, where `str()` tells it."""
        if not self.names:
            return ""
        by_chance = " and ".join(_words(c) for c in self.chance if c.probability >= LIKELY)
        noise = self.unexplained.rest(self.material)
        return f"The rest of the error is {f'in part this: {by_chance}; else {noise}' if by_chance else noise}."

    def _sentence(self, lead: str) -> str:
        """The named parts and the force without a name that the repaired simulator carries, the largest first; small
        ones by their names alone."""
        named = [p for p in self.parts if p.probability >= LIKELY]
        large = [p for p in named if p.share.mean >= self.material] or named[:1]
        small = [
            p.name if p.plausible else f"{p.name} (physically implausible as fitted)" for p in named if p not in large
        ]
        shares = [(p.share.mean, _words(p, f"{percent(p.share.mean)} of the gap")) for p in large]
        lines = []
        if lead:
            lines, shares = [lead], []
        if self._takes_off and (named or self.unexplained.material):
            shares.append((self._takes_off, f"{_UNNAMED} ({percent(self._takes_off)} of the gap)"))
        words = [said for _, said in sorted(shares, key=lambda x: -x[0])]
        if words:
            lines.append(f"{'' if lead else 'chiefly '}{', then '.join(words)}")
        if small:
            lines.append(f"under {percent(self.material)}{' each' if small[1:] else ''}: {listing(small)}")
        rest = self.unexplained.beyond_carried.mean
        if rest >= 0.005 and named:
            if not lead and rest > max(share for share, _ in shares):
                lines[0] = lines[0].replace("chiefly ", "", 1)
                lines.insert(0, f"chiefly no known effect explains it ({percent(rest)} of the gap)")
            else:
                lines.append(f"{percent(rest)} is reproducible and no known effect explains it")
        text = "; ".join(lines) + "."
        return text[0].upper() + text[1:]

    @property
    def _takes_off(self) -> float:
        """What of the gap the repaired simulator takes off without a name; 0 where that is next to nothing."""
        carried = self.unexplained.carried
        return 0.0 if carried is None or carried.mean < 0.005 else carried.mean

    def to_dict(self) -> dict[str, Any]:
        """The object `budget` of `diagnosis.json`."""
        out = {
            "metric": "rollout_10s_over_floor",
            "heldout_by": "drives" if self.by_drives else "blocks",
        }
        keys = ("horizon_s", "before", "floor", "left", "by_channel", "parts", "chance", "families", "unexplained")
        return out | {key: plain(getattr(self, key)) for key in (*keys, "material")}


def _words(part: Part | ChancePart, behind: str = "") -> str:
    """A cause in words; by its name alone where its parameters are not those of such an effect."""
    if not part.plausible:
        return f"{part.name} ({f'{behind}, ' if behind else ''}physically implausible as fitted)"
    return named_cause(part.name, {key: q.mean for key, q in part.parameters.items()}, behind)


def listing(names: Sequence[str], last: str = "and") -> str:
    """Names in a sentence."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {last} {names[-1]}"


def percent(share: float) -> str:
    """A share as it is printed."""
    return "under 1 %" if 0 < share < 0.01 else f"{100 * share:.0f} %"
