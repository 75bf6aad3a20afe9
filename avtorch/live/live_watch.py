"""Many cars watched at once: batches of rows in, answers out."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch

from avtorch.inference.form import Form
from avtorch.live.car import LiveCar, LiveSettings, LiveWindow
from avtorch.live.source import Batch, Counts, Row
from avtorch.results import window_entry


class Answer(NamedTuple):
    """What is said of one window: the object that becomes a line of JSON, the car's name, the number of the window, and
    when its end had come (`time.monotonic`; None where it is no window).
    """

    entry: dict[str, Any]
    car: str
    number: int
    ended: float | None


class LiveWatch:
    """Watches of many cars, one each, made when a car's first row comes."""

    def __init__(self, settings: LiveSettings | None = None, counts: Counts | None = None) -> None:
        self.settings = LiveSettings() if settings is None else settings
        self.counts = Counts() if counts is None else counts
        self.cars: dict[str, LiveCar] = {}
        self._setting = self.settings.setting()
        self._warm: set[type[Form]] = set()

    def take(self, batch: Batch) -> list[Answer]:
        """Take in a batch; returns what is to be said, in the order of the rows that ended the windows."""
        if batch.anew:
            for car in self.cars.values():
                car.position = None
        answers: list[Answer] = []
        for row in batch.rows:
            car = self.cars.get(row.car) or self._new(row)
            if car is None:
                continue
            if row.position is not None:
                if car.position is not None and row.position <= car.position:
                    continue  # taken in before a restart
                car.position = row.position
            found = car.take(row, batch.arrived, self._setting)
            if found or car.refusal is not None:
                answers += self._said(car, found)
        return answers

    def flush(self, arrived: float) -> list[Answer]:
        """Close the open windows of all cars: the source ended for good."""
        return [answer for car in self.cars.values() for answer in self._said(car, car.flush(arrived, self._setting))]

    def _new(self, row: Row) -> LiveCar | None:
        """The watch of a car that has not been seen before; None, and counted, where there can be none."""
        signals = {name for name, value in row.signals.items() if value is not None}
        form = self.settings.form_of(signals)
        if form is None:
            self.counts.refuse("incomplete")
            return None
        if len(self.cars) >= self.settings.cars:
            self.counts.refuse("too many cars")
            return None
        self.warm_up(form)
        car = self.cars[row.car] = LiveCar(row.car, signals, self.settings, self.counts)
        return car

    def _said(self, car: LiveCar, found: list[LiveWindow]) -> list[Answer]:
        answers = [Answer(window_answer(car.name, window), car.name, window.number, window.ended) for window in found]
        if car.refusal is not None:
            entry = {"car": car.name, "after_window": car.windows, "refused": car.refusal}
            answers.append(Answer(entry, car.name, car.windows, None))
            car.refusal = None
        return answers

    def warm_up(self, form: Form) -> None:
        """Compile what the estimator needs before the first window depends on it, once a form."""
        if type(form) in self._warm:
            return
        self._warm.add(type(form))
        time = 0.02 * torch.arange(round(2.5 * self.settings.window / 0.02), dtype=torch.float64)
        command = 3.0 * torch.sin(2.0 * time)
        # the exact answer of a car of lag 0.5 s to a sine, behind its transient
        accel = 0.5 * (command - 3.0 * torch.cos(2.0 * time))
        noise = 0.05 * torch.randn(3, len(time), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        rows = {"accel_cmd": command, "accel": accel + noise[0], "jerk": 2.0 * (command - accel) + noise[1]}
        rows["speed"] = 20.0 - 0.75 * (torch.cos(2.0 * time) + torch.sin(2.0 * time)) + noise[2]
        needed = {name: rows[name] for name in form.columns}
        self.settings.watch("", form).feed(time, needed, self._setting)


def window_answer(car: str, window: LiveWindow) -> dict[str, Any]:
    """A line of `avtorch watch`: the entry of a window as in `estimates.json`, on the car's own clock, with the car,
    the window's number and a sentence for every alert."""
    watched = window.watched
    entry = window_entry(watched)
    if window.ahead != 0.0:
        entry |= {key: round(entry[key] - window.ahead, 6) for key in ("start_s", "end_s")}
    form = "jerk" if "sigma" in watched.window.belief.names else "latent"
    why = [watched.report.why(name) for name in watched.report.names()]
    return {"car": car, "window": window.number, "form": form, **entry, "why": why}
