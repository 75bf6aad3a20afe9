"""Everything a command prints: notes, progress, tables, where the files are."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from avtorch.cli.progress_lines import ProgressLines
from avtorch.cli.terminal import SafeConsole

if TYPE_CHECKING:
    from avtorch.logcheck.check import LogCheck


class Talk:
    """Prints tables and progress. With `json` it prints the answer in place of the tables; with `quiet` nothing."""

    def __init__(self, *, json: bool, quiet: bool) -> None:
        self.json, self.silent = json and not quiet, quiet or json
        self.out = SafeConsole(quiet=self.silent, highlight=False)
        self.err = SafeConsole(stderr=True, quiet=self.silent, highlight=False)

    @contextmanager
    def progress(self, what: str) -> Iterator[Callable[[float, float], None]]:
        """A bar with the time left on stderr where it is a terminal, and a line now and then where it is not; yields a
        function of (done, of)."""
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %"),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=self.err, transient=True, disable=not self.err.is_terminal) as bar:
            task = bar.add_task(what, total=None)
            lines = ProgressLines(self.err, what)

            def step(done: float, of: float) -> None:
                bar.update(task, completed=done, total=of)
                if not self.err.is_terminal:
                    lines(done, of)

            yield step

    @contextmanager
    def steps(self, what: str) -> Iterator[Callable[[str, int, int], None]]:
        """A bar for each stage in turn, on stderr where it is a terminal; yields a function of (stage, done, of)."""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=self.err, transient=True, disable=not self.err.is_terminal) as bar:
            task = bar.add_task(what, total=None)
            yield lambda stage, done, of: bar.update(task, description=stage, completed=done, total=of)

    @contextmanager
    def whole(self, what: str, most_s: float | None = None) -> Iterator[Callable[[str, int, int], None]]:
        """One bar over all stages, with the time left, on stderr where it is a terminal, and a line now and then where
        it is not; yields a function of (stage, done, of). `most_s`: time at most [s]."""
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f} %{task.fields[left]}"),
            TextColumn("" if most_s is None else f"of {most_s:g} s at most"),
        )
        with Progress(*columns, console=self.err, transient=True, disable=not self.err.is_terminal) as bar:
            task = bar.add_task(what, total=None, left="")
            lines = ProgressLines(self.err, what)

            def step(stage: str, done: int, of: int) -> None:
                left = lines.left_s(done, of)
                told = "" if left is None else f", about {left:.0f} s left"
                bar.update(task, description=f"{what}: {stage}", completed=done, total=of, left=told)
                if not self.err.is_terminal:
                    lines(done, of, stage)

            yield step

    @contextmanager
    def waiting(self, what: str) -> Iterator[None]:
        if self.err.is_terminal:
            with self.err.status(what):
                yield
        else:
            yield

    def notes(self, title: str, notes: Sequence[str]) -> None:
        self.out.print(title, style="bold", markup=False)
        for note in notes:
            self.out.print(f"  {note}", markup=False)
        self.out.print()

    def check(self, found: LogCheck) -> None:
        """What a log is, how to read it, and what was seen in it."""
        self.out.print(found.source, style="bold", markup=False, soft_wrap=True)
        self.out.print(f"  {found.form}", markup=False)
        self.out.print()
        proposal = found.proposal
        if proposal is not None and proposal.signals:
            table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
            for name in ("signal", "column", "unit", "why"):
                table.add_column(name)
            for signal, one in proposal.signals.items():
                table.add_row(signal, escape(one.column), escape(one.unit or ""), escape(one.reason))
            self.out.print(table)
            self.out.print()
        for doubt in proposal.doubts if proposal is not None else ():
            self.out.print(f"In doubt: {doubt}", style="yellow", markup=False)
        groups = {
            "Seen": found.quality.notes if found.quality is not None else (),
            "Recorder": found.recorder,
            "Excitation": found.excitation,
        }
        for title, notes in groups.items():
            if notes:
                self.notes(title, notes)

    def answer(self, answer: Mapping[str, Any]) -> None:
        """The answer as JSON."""
        print(json.dumps(answer, default=lambda x: x.tolist()))

    def line(self, text: str) -> None:
        """A line that the terminal wraps and not the printing, so that a path in it can be copied."""
        self.out.print(text, markup=False, soft_wrap=True)

    def sentence(self, text: str) -> None:
        self.out.print(text, markup=False)
        self.out.print()

    def windows(self, windows: Sequence[Mapping[str, Any]], most: int = 60) -> None:
        table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
        for name in ("time [s]", "rows", "T_L [s]", "90 %", "K_L", "90 %", "P", ""):
            table.add_column(escape(name), justify="left" if name == "" else "right", no_wrap=name != "")
        for w in windows[:most]:
            style = None if w["used"] else "dim"
            unused = "not converged" if w["excited"] else "not excited"
            cells = [
                f"{w['start_s']:.0f}-{w['end_s']:.0f}" if _whole(w) else f"{w['start_s']:.1f}-{w['end_s']:.1f}",
                str(w["n"]),
            ]
            for name in ("T_L", "K_L"):
                cells += [f"{w[name]['mean']:.3f}", f"{w[name]['q05']:.2f}-{w[name]['q95']:.2f}"]
            alerts = ", ".join(w["alerts"]) if w["alerts"] else "" if w["used"] else unused
            table.add_row(*cells, f"{w['p_string_stable']:.2f}", alerts, style="bold yellow" if w["alerts"] else style)
        self.out.print(table)
        self.out.print("P: probability of string stability under the setting in force", style="dim")
        if len(windows) > most:
            self.out.print(f"... and {len(windows) - most} more windows in the answer", style="dim")
        self.out.print()

    def summary(self, answer: Mapping[str, Any], sentence: str) -> None:
        self.out.print(sentence)
        # an unanswered alarm repeats in every window: show the first, count the rest
        first: dict[str, Mapping[str, Any]] = {}
        for alert in answer["alerts"]:
            first.setdefault(alert["detector"], alert)
        for name, alert in first.items():
            count = sum(a["detector"] == name for a in answer["alerts"])
            again = f" (and {count - 1} more window{'s' * (count > 2)})" if count > 1 else ""
            line = f"{alert['time_s']:.1f} s  {name}: {alert['why']}{again}"
            self.out.print(line, style="yellow", markup=False)

    def story(self, answer: Mapping[str, Any]) -> None:
        """The events of a run in order, and how much the action helped."""
        change = answer["change"]
        lines = [(change["time_s"], "", f"the vehicle changes to T_L {change['T_L']:g} s, K_L {change['K_L']:g}")]
        lines += [(a["time_s"], "yellow", f"alert, {a['detector']}: {a['why']}") for a in answer["alerts"]]
        for a in answer["actions"]:
            names = " and ".join(map(str, a["strategies"])) or "none"
            gain = "" if a["peak_gain_true"] is None else f"; true peak gain {a['peak_gain_true']:.4f}"
            lines.append((a["time_s"], "green", f"action, strategy {names}: {a['why']}{gain}"))
        table = Table.grid(padding=(0, 2, 0, 0))
        table.add_column(justify="right", no_wrap=True)
        table.add_column()
        # the sort is stable: an action stays behind the alert of the same time that it answers
        for time, style, text in sorted(lines, key=lambda line: line[0])[:12]:
            table.add_row(f"{time:.1f} s", escape(text), style=style or None)
        self.out.print(table)
        if len(lines) > 12:
            self.out.print(f"... and {len(lines) - 12} more in the answer", style="dim")
        table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
        table.add_column("")
        for name in ("without action", "with action"):
            table.add_column(name, justify="right")
        from avtorch.results import MEASURES

        both = answer["performance"]
        for key, words in MEASURES.items():
            table.add_row(escape(words), *(_number(both[side][key]) for side in ("without_action", "with_action")))
        self.out.print()
        self.out.print(table)
        hit = [side.replace("_", " ") for side, run in both.items() if (run["min_spacing_m"] or 0.0) < 0]
        if hit:
            text = f"Collision {' and '.join(hit)}: everything after it, figures included, is not physical."
            self.out.print(text, style="bold red")

    def stability(self, answer: Mapping[str, Any]) -> None:
        table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
        for name, side in (("condition", "left"), ("expression > 0", "left"), ("value", "right"), ("", "left")):
            table.add_column(name, justify=side)  # type: ignore[arg-type]
        for group, lines in answer["conditions"].items():
            for i, (line, value) in enumerate(lines.items()):
                mark = "[green]holds[/green]" if value > 0 else "[red]fails[/red]"
                table.add_row(group if i == 0 else "", line, f"{value:.4g}", mark)
        self.out.print(table)
        self.out.print()
        if answer["setting"]["dead_time_s"] > 0:
            self.out.print("The conditions above ignore the dead time; the verdict below includes it.", style="dim")
        local, string, peak = answer["locally_stable"], answer["string_stable"], answer["peak_gain"]
        self.out.print(f"locally stable   {_yes(local)}")
        self.out.print(f"string stable    {_yes(string)}")
        if peak is not None:
            where = f" at {answer['peak_frequency_radps']:.3g} rad/s" if not string else ""
            self.out.print(f"peak gain        [bold]{peak:.4f}[/bold]{where}")
        self.out.print(f"dead time left   {answer['dead_time_margin_s']:.3f} s before local instability")

    def done(self, out: Path, answer: Mapping[str, Any]) -> None:
        if self.json:
            self.answer(answer)
            return
        names = ", ".join(
            sorted(p.name for p in out.iterdir() if p.suffix in (".html", ".json", ".png") and p.is_file())
        )
        self.out.print(f"\nWritten to [bold]{escape(str(out))}[/bold]: {escape(names)}", soft_wrap=True)


def _whole(window: Mapping[str, Any]) -> bool:
    return all(abs(window[key] - round(window[key])) < 1e-6 for key in ("start_s", "end_s"))


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _yes(verdict: bool) -> str:
    return "[bold green]yes[/bold green]" if verdict else "[bold red]no[/bold red]"


def write_answer(
    out: Path,
    name: str,
    answer: Mapping[str, Any],
    pictures: Mapping[str, Callable[[], Any]],
    *,
    more: Callable[[Path], object] = lambda staged: None,
    also: Sequence[str] = (),
) -> None:
    """Publish the answer and its pictures as one set; `more` writes further files into it, out of `also`, the files
    that an earlier answer of this kind may have left."""
    from avtorch.io import answer_set, write_json
    from avtorch.plots import save

    with answer_set(out, list(dict.fromkeys([name, *pictures, *also]))) as staged:
        for file, draw in pictures.items():
            save(draw(), staged / file)
        more(staged)
        write_json(staged / name, answer)
