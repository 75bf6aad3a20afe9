"""One picture a manoeuvre: how the car answered a command, and how the simulator does."""

from __future__ import annotations

from avtorch.gap.result.diagnosis import Diagnosis
from avtorch.gap.result.manoeuvres import Manoeuvre, Response, manoeuvres
from avtorch.plots.manoeuvres import manoeuvre_figure
from avtorch.report.picture import Picture, small_picture
from avtorch.report.table import Table

_COLUMNS = ("signal", "peak [m/s²]", "rise, 10 to 90 % [s]", "lag behind the command [s]")
_WORDS = {
    "measured": "the car",
    "baseline simulator": "the baseline simulator",
    "with what was named": "with what was named",
}


def manoeuvre_pictures(found: Diagnosis) -> tuple[Picture, ...]:
    """The manoeuvres in which the baseline simulator errs most, the worst first; none where there are no traces.

    Example:
        >>> from avtorch import Leader, diagnose, simulate
        >>> from avtorch.gap import DeadTime, plant
        >>> from avtorch.report.manoeuvre_pictures import manoeuvre_pictures
        >>> late = plant([DeadTime(0.4)], sigma=0.0)
        >>> log = simulate(Leader.default(start=50.0, duration=24.0, dt=0.1), plant=late).log()
        >>> len(manoeuvre_pictures(diagnose(log, effects=["dead_time"], pairs=False))) > 0
        True
    """
    traces = found.traces
    if traces is None:
        return ()
    several = len(found.log.epochs_s) > 1
    each = manoeuvres(traces, named=bool(found.winner.effects))
    return tuple(
        small_picture(
            f"manoeuvre-{i}",
            manoeuvre_figure(manoeuvre, traces),
            f"Lines of a manoeuvre: {_title(manoeuvre, several=several)}. {_told(manoeuvre)}",
            Table(
                f"{_title(manoeuvre, several=several)}",
                _COLUMNS,
                tuple(_row(name, response) for name, response in manoeuvre.responses.items()),
                numeric=_COLUMNS[1:],
            ),
            caption=f"{_title(manoeuvre, several=several)}: {100 * manoeuvre.share:.2g} % of the baseline's squared "
            f"error. {_told(manoeuvre)}",
        )
        for i, manoeuvre in enumerate(each)
    )


def _title(manoeuvre: Manoeuvre, *, several: bool) -> str:
    kind = manoeuvre.kind.capitalize()
    of = f" of drive {manoeuvre.log + 1}" if several else ""
    return f"{kind} at {manoeuvre.begin:.1f} s{of}, a command {manoeuvre.change:+.2g} m/s²"


def _told(manoeuvre: Manoeuvre) -> str:
    """Peaks and lags in words."""
    responses = {name: r for name, r in manoeuvre.responses.items() if name in _WORDS}
    peaks = ", ".join(f"{_WORDS[name]} {r.peak:.2f}" for name, r in responses.items())
    lags = ", ".join(f"{_WORDS[name]} {r.lag:.2f}" for name, r in responses.items() if r.lag is not None)
    rises = ", ".join(f"{_WORDS[name]} {r.rise:.2f}" for name, r in responses.items() if r.rise is not None)
    told = f"Peak [m/s²]: {peaks}."
    told += f" Rise [s]: {rises}." if rises else ""
    return told + (f" Lag [s]: {lags}." if lags else "")


def _row(name: str, response: Response) -> tuple[str, ...]:
    times = ("" if x is None else f"{x:.2f}" for x in (response.rise, response.lag))
    return (name, f"{response.peak:.2f}", *times)
