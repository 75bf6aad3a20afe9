"""Physical plausibility of an answer: fitted parameters compared with their physically possible ranges.

A cause that wins far outside its range is informative: the name is right about the shape of the gap and wrong about its
origin. It is reported only where the whole central 90 % lies outside, so that a wide posterior is not reported.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from avtorch.gap.quantity import Quantity, unit_of
from avtorch.gap.simulator.effect import Effect
from avtorch.gap.simulator.parameter import Parameter
from avtorch.gap.simulator.plant import BASELINE


def implausible(
    parameters: Mapping[str, Quantity],
    moved: Mapping[str, Quantity],
    effects: Iterable[type[Effect]] = (),
) -> tuple[str, ...]:
    """A sentence for each parameter whose central 90 % lies outside what is physically possible.

    `parameters` of a candidate's `effects`, by their own names or as `effect.parameter`; `moved`: T_L [s] and K_L.
    """
    sentences = []
    for effect in effects:
        for p in (*effect.parameters, *effect.derived):
            q = parameters.get(f"{effect.name}.{p.name}", parameters.get(p.name))
            if q is not None and (p.reported or p in effect.derived) and outside(p, q):
                sentences.append(
                    f"{_sentence(f'{effect.name}.{p.name}', p, q)}; the effect stands in for something else."
                )
    sentences += [
        f"{_sentence(p.name, p, moved[p.name])}." for p in BASELINE if p.name in moved and outside(p, moved[p.name])
    ]
    return tuple(sentences)


def outside(parameter: Parameter, q: Quantity) -> bool:
    """Whether the central 90 % lies entirely outside the possible range."""
    low, high = parameter.physical
    return q.q95 < low or q.q05 > high


def _sentence(name: str, p: Parameter, q: Quantity) -> str:
    unit = unit_of(p.name)
    low, high = p.physical
    why = p.beyond or f"possible are {low:.2g} to {high:.2g}"
    return f"{name} is {q.mean:.2g}{'' if unit == '-' else ' ' + unit}, typical {p.low:.2g} to {p.high:.2g}: {why}"
