"""The page of one tab: a log's columns, its diagnosis and the changed simulator; or two logs compared."""

from __future__ import annotations

import asyncio
import html
import shlex
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import panel as pn

from avtorch.app.controls import STYLES, Chart, CheckBox, Slider
from avtorch.app.task import Job, Task
from avtorch.app.workplace import MOST_MB, Workplace, examples
from avtorch.errors import InputError, printable
from avtorch.gap.quantity import words_of
from avtorch.io import Log
from avtorch.io.answers import atomic
from avtorch.io.formats import is_recording, open_recording
from avtorch.io.mapping import mapping_place, read_mapping
from avtorch.io.tables import read_table
from avtorch.logcheck.check import LogCheck, check
from avtorch.remedy.trial import Trial
from avtorch.report.page import text_of

_NONE = "not in the log"
_ACCELS = ["m/s2", "g", "ft/s2", "-1"]
_UNITS = {"time": ["s", "ms", "us", "ns"], "speed": ["m/s", "km/h", "mph", "ft/s"], "accel": _ACCELS}
_UNITS["accel_cmd"] = _ACCELS
_CARD = {"background": "var(--paper)", "border-radius": "8px", "padding": "1rem 1.25rem", "margin-bottom": "1rem"}
_WIDE: dict[str, Any] = {"sizing_mode": "stretch_width"}
_TITLES = ("Which log?", "What does a simulator of this car lack?", "What has changed between two drives?")


def page(place: Workplace) -> pn.template.Template:
    """What a tab shows, by its address: one or two of `log`, or an `example`; the folder of an `answer`."""
    args = {key: [x.decode("utf-8", "replace") for x in some] for key, some in pn.state.session_args.items()}
    fault, view = "", None
    try:
        names = [place.example(x) for x in args.get("example", [])[:1]] or args.get("log", [])
        if len(names) > 2:
            raise InputError(f"Found {len(names)} logs, needs one, or two to compare")
        paths, answers = ([place.inside(x) for x in some[:2]] for some in (names, args.get("answer", [])))
        view = View(place, paths, answers[0] if answers else None) if paths else None
    except InputError as error:
        fault = str(error)
    template = pn.template.Template(text_of("page.html", "avtorch.app"))
    known = {"folder": str(place.root), "start": f"/{place.token}", "fault": fault, "most": MOST_MB, "view": view}
    other = urlencode([("log", x) for x in reversed(view.names)]) if view and len(view.names) == 2 else ""
    known |= {"other": f"/{place.token}?{other}" if other else ""}
    known |= {"heading": _TITLES[len(view.paths) if view else 0], "style": "\n".join(STYLES), "examples": examples()}
    for key, value in (known | {"names": [] if view else place.logs()}).items():
        template.add_variable(key, value)
    template.add_panel("body", view.body if view else _html())
    return template


def _html(text: str = "") -> pn.pane.HTML:
    return pn.pane.HTML(text, stylesheets=STYLES, margin=0, **_WIDE)


def _safe(text: object) -> str:
    return html.escape(printable(str(text)))


def _fault(text: object) -> str:
    return f'<p class="fault" role="alert">{_safe(text)}</p>'


class View:
    """One log, or two to compare; its run, and the answer."""

    def __init__(self, place: Workplace, paths: list[Path], answer: Path | None) -> None:
        self.place, self.paths, self.names = place, paths, [place.name_of(x) for x in paths]
        self.found: list[LogCheck] = []
        self.map: dict[str, str] = {}
        self.unit: dict[str, str] = {}
        self.drop_downs: dict[tuple[str, str], pn.widgets.Select] = {}
        self.job: Job | None = None
        self.shown: dict[tuple[str, str], str] = {}  # in the drop-downs; what differs is a choice of the user's
        what = "Diagnose" if len(paths) == 1 else "Compare"
        self.seen, self.status, self.columns = _html('<p role="status">Reading</p>'), _html(), pn.FlexBox(**_WIDE)
        self.chart, self.result = pn.Column(**_WIDE), pn.Column(**_WIDE)
        self.go = pn.widgets.Button(name=what, button_type="primary", disabled=True, stylesheets=STYLES)
        self.stop = pn.widgets.Button(name="Cancel", disabled=True, stylesheets=STYLES)
        cards = [self.seen, self.columns, self.chart], [pn.Row(self.go, self.stop), self.status]
        self.body = pn.Column(*(pn.Column(*each, styles=_CARD, **_WIDE) for each in cards), self.result, **_WIDE)
        self.go.on_click(self._start)
        self.stop.on_click(self.end)
        pn.state.on_session_destroyed(lambda session_context: self.end())
        pn.state.onload(partial(self._load, answer))

    def end(self, _: object = None) -> None:
        """End the run, if there is one."""
        if self.job is not None:
            self.job.cancel()

    # the log ---------------------------------------------------------------------------------------------------------
    async def _load(self, answer: Path | None = None) -> None:
        self.go.disabled = True
        try:
            own = {"map": self.map, "unit": self.unit}
            self.found = [await asyncio.to_thread(check, path, **own) for path in self.paths]
        except InputError as fault:
            self.seen.object, self.chart[:] = _fault(fault), []
            return
        when = ["Before: ", "After: "] if len(self.names) == 2 else [""]
        titles = [f"{x}{name}" for x, name in zip(when, self.names, strict=True)]
        self.seen.object = "".join(map(_seen, titles, self.found))
        if len(self.found) == 1 and not self.found[0].follows:
            self._confirm(self.found[0])
        self.go.disabled = any(one.fault is not None and not one.follows for one in self.found)
        if answer is not None:
            await self._answer(answer)

    def _confirm(self, found: LogCheck) -> None:
        """Drop-downs for columns and units, as they were found, and the traces."""
        path, signals = self.paths[0], dict(found.proposal.signals) if found.proposal is not None else {}
        names = list(open_recording(path).names if is_recording(path) else read_table(path).names)
        stated = read_mapping(path, map=self.map, unit=self.unit)
        order = list(dict.fromkeys(["time", "accel_cmd", "accel", "speed", *signals, *stated.column]))
        for signal in order:
            one = signals.get(signal)
            column = one.column if one else stated.column.get(signal, signal if found.proposal is None else _NONE)
            self._drop_down("map", signal, names, column if column in names else _NONE)
            if signal in _UNITS and column in names:
                unit = (one.unit if one else stated.unit.get(signal)) or _UNITS[signal][0]
                self._drop_down("unit", signal, _UNITS[signal], unit)
        self.columns[:] = [
            box for signal in order for kind in ("map", "unit") if (box := self.drop_downs.get((kind, signal)))
        ]
        self.chart[:] = []
        if (log := found.log) is not None:
            lines = {"acceleration [m/s²]": {"command": log.accel_cmd, "measured": log.accel}}
            lines["speed [m/s]"] = {"measured": log.speed}
            there = {key: {k: x for k, x in each.items() if x is not None} for key, each in lines.items()}
            chart = Chart(log.elapsed, {key: each for key, each in there.items() if each}, log.segment)
            self.chart[:] = [_html(f"<p>As read: {chart.legend}</p>"), *chart.figures]

    def _drop_down(self, kind: str, signal: str, options: list[str], value: str) -> None:
        """`kind`: map or unit."""
        if (box := self.drop_downs.get((kind, signal))) is None:
            title = signal if kind == "map" else f"{signal} in"
            box = pn.widgets.Select(name=title, width=150 if kind == "map" else 90, stylesheets=STYLES)
            box.param.watch(partial(self._changed, kind, signal), "value")
            self.drop_downs[kind, signal] = box
        self.shown[kind, signal] = value
        box.param.update(options=list(dict.fromkeys([value, *options])), value=value)

    async def _changed(self, kind: str, signal: str, event: Any) -> None:
        if event.new not in (_NONE, self.shown[kind, signal]):
            getattr(self, kind)[signal] = self.shown[kind, signal] = event.new
            await self._load()

    # the run ---------------------------------------------------------------------------------------------------------
    def _task(self, out: str) -> Task:
        kept = all(one.proposal is not None for one in self.found)  # in the file beside the log
        own = {} if kept else {"map": self.map, "unit": self.unit}
        return Task(self.names, out, **own, follower=self.found[0].follows)

    def _start(self, _: object) -> None:
        place = self.place
        try:
            for path, one in zip(self.paths, self.found, strict=True):
                if one.proposal is not None and one.proposal.needed:
                    with atomic(mapping_place(path)) as file:
                        file.write(one.proposal.toml(path.name))
            out = place.answer(self.names[-1])
        except (InputError, OSError) as fault:
            self.status.object = _fault(fault)
            return
        self.job, self.result[:] = Job(self._task(place.name_of(out)), place.root, self.place.slots), []
        self.go.disabled, self.stop.disabled = True, False
        self.polling = pn.state.add_periodic_callback(self._poll, period=400)  # pyright: ignore[reportArgumentType]

    async def _poll(self) -> None:
        job = self.job
        assert job is not None
        if job.state in ("waiting", "running"):
            bar = f'<progress aria-label="Progress" max="100" value="{job.percent}"></progress>'
            self.status.object = f'<p role="status">{_safe(job.line)}</p>{bar}'
            return
        self.polling.stop()
        self.go.disabled, self.stop.disabled = False, True
        out = self.place.root / job.task.out
        says = (
            "Cancelled; nothing was written." if job.state == "cancelled" else f"Done; the answer is in {job.task.out}."
        )
        self.status.object = _fault(job.fault) if job.state == "failed" else f'<p role="status">{_safe(says)}</p>'
        if job.state == "done":
            await self._answer(out)
        else:
            self.place.give_up(out)

    # the answer ------------------------------------------------------------------------------------------------------
    async def _answer(self, out: Path) -> None:
        name, place = "report.html" if len(self.names) == 1 else "comparison.html", self.place
        try:
            text = (out / name).read_text(encoding="utf-8")
        except OSError as fault:
            self.status.object = _fault(f"{out / name}: {fault.strerror}")
            return
        task, where = self._task(place.name_of(out)), f"/{self.place.token}/files/{place.name_of(out)}"
        lead = text[text.index('<section class="verdict') : text.index("</section>")] + "</section>"
        lead = lead.replace("h1", "h2").replace('aria-labelledby="verdict"', 'aria-label="Verdict"')
        files = sorted(p.name for p in out.iterdir() if p.is_file())
        listed = "".join(f'<li><a href="{where}/{x}" target="_blank">{_safe(x)}</a></li>' for x in files)
        line = f"cd {shlex.quote(str(place.root))} && {task.command}"
        same = f"<h2>The same by command</h2><pre>{_safe(line)}</pre>"
        same += f"<h2>In Python, in that folder</h2><pre>{html.escape(task.python)}</pre>"
        frame = f'<h2>The whole report</h2><iframe title="The whole report" src="{where}/{name}"></iframe>'
        parts = [[_html(lead)], await asyncio.to_thread(self._trial, out)]
        parts += [[_html(f"<h2>To keep</h2><ul>{listed}</ul>{same}")], [_html(frame)]]
        self.result[:] = [pn.Column(*each, styles=_CARD, **_WIDE) for each in parts if each]

    def _trial(self, out: Path) -> list[Any]:
        """Switches, sizes and traces of the repaired simulator; nothing for two logs, and for a car that follows."""
        if len(self.paths) == 2 or self.found[0].follows:
            return []
        try:
            return Switches(Trial.of(self.found[0].log or Log.read(self.paths[0]), out)).parts
        except InputError as fault:
            return [_html(f"<h2>Switch effects</h2><p>Not for this log: {_safe(fault)}</p>")]


class Switches:
    """The effects of a repaired simulator, each with a switch and its sizes, and the traces that follow them."""

    def __init__(self, trial: Trial) -> None:
        self.trial, self.car, traces = trial, trial.car, trial.traces
        self.base, self.base_errors = trial.rollout(trial.base, (), {})
        names = {"accel": "acceleration [m/s²]", "speed": "speed [m/s]"}
        self.quantities = [names[x] for x in traces.channels]
        lines = {"command [m/s²]": {"command": traces.command}}
        for quantity, measured, before in zip(self.quantities, traces.measured, self.base, strict=True):
            lines[quantity] = {"measured": measured, "simulator as it is": before, "as set here": before}
        self.chart = Chart(traces.time, lines, traces.stretch)
        self.error, self.controls = _html(), pn.Column(width=300)
        self.add = pn.widgets.Select(name="Add an effect", options=["", *trial.addable()], stylesheets=STYLES)
        self.add.param.watch(self._added, "value")
        self._build({e.name for e in self.car.effects}, {})
        says = "<h2>Switch effects and see</h2><p>The simulator drives anew by the logged commands with each change; "
        says += f"a speed begins anew every 10 s. {self.chart.legend}</p>"
        drawn = pn.Column(*self.chart.figures, min_width=260, styles={"flex": "1 1 26rem"}, **_WIDE)
        self.parts = [_html(says), self.error, pn.FlexBox(pn.Column(self.controls, self.add), drawn, **_WIDE)]

    def _build(self, on: set[str], moved: Mapping[str, Any]) -> None:
        chance = {"": "", **{e.name: " (by chance; not in the rollout)" if e.random else "" for e in self.car.effects}}
        self.boxes = {x: CheckBox(label=x + chance[x], value=x in on) for x in chance if x}
        self.sliders = {
            key: Slider(label=" ".join([*key.split(".")[:-1], words_of(key.split(".")[-1])]), **_WIDE, **vars(size))
            for key, size in self.trial.sizes(self.car).items()
        }
        for key in moved.keys() & self.sliders.keys():
            self.sliders[key].value = moved[key]
        rows = [*self.boxes.items(), *self.sliders.items()]
        for _, control in rows:
            control.param.watch(self._moved, "value")
        # the simulator's own first, then each effect above its sizes
        self.controls[:] = [x for effect in chance for key, x in rows if effect in (key, key.rpartition(".")[0])]
        self._moved()

    def _added(self, event: Any) -> None:
        if event.new and event.new not in self.boxes:
            on = {name for name, box in self.boxes.items() if box.value} | {event.new}
            moved = {key: slider.value for key, slider in self.sliders.items()}
            self.car = self.trial.with_effect(self.car, event.new)
            self._build(on, moved)

    def _moved(self, _: object = None) -> None:
        on = [name for name, box in self.boxes.items() if box.value]
        try:
            lines, errors = self.trial.rollout(self.car, on, {key: x.value for key, x in self.sliders.items()})
        except InputError as fault:
            self.error.object = _fault(fault)
            return
        self.chart.show({(q, "as set here"): x for q, x in zip(self.quantities, lines, strict=True)})
        told = f"simulator as it is {_errors(self.base_errors)}; <strong>as set here {_errors(errors)}</strong>"
        self.error.object = f'<p role="status">RMS error over 10 s: {told}.</p>'


def _seen(name: str, found: LogCheck) -> str:
    """What the check saw of a log."""
    says = [*(() if found.proposal is None else found.proposal.doubts), *found.notes]
    head = f'<h2>{_safe(name)}</h2><p class="soft">{_safe(found.form)}</p>'
    return f"{head}{_fault(found.fault) if found.fault else ''}<ul>{''.join(f'<li>{_safe(x)}</li>' for x in says)}</ul>"


def _errors(errors: Mapping[str, float]) -> str:
    words = {"accel": "acceleration {:.3g} m/s²", "speed": "speed {:.3g} m/s"}
    return ", ".join(words[key].format(x) for key, x in errors.items())
