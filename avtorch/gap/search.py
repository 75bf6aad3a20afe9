"""The search for the cause: all single effects, then pairs where a second effect still gains.

Every candidate is first fitted under the noise of the bare baseline, over the whole drive and from an onset on. The
best are fitted anew, each with noise of its own, and joined with whatever else gains most on top of them. Causes that
chance decides (gusts, outliers, lost messages) are judged on the errors that these leave over.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from avtorch.gap.candidate import Candidate
from avtorch.gap.chance import Tails, losses, tails
from avtorch.gap.checkpoint import Checkpoint, Kept
from avtorch.gap.effect import EFFECTS, Effect
from avtorch.gap.fit import finish, modes
from avtorch.gap.found import Found, Race, cleaned, merged, white_first
from avtorch.gap.gusts import gust
from avtorch.gap.innovations import NoiseModel, Whitener
from avtorch.gap.noise_fit import fit_noise
from avtorch.gap.onset import averaged, refined, rough
from avtorch.gap.plant import GapPlant
from avtorch.gap.record import Record
from avtorch.gap.starts import starts
from avtorch.io import Log

Float = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

_SINGLES = 6  # fitted with noise of their own
_BASES = 3  # joined with a second effect
_SECONDS = 3  # tried on each
_CLOSE = 12.0  # nats within which a single effect stays in the race for a partner


class Search:
    """One search over one or several logs of a car."""

    def __init__(
        self,
        logs: Sequence[Log],
        baseline: GapPlant,
        *,
        effects: Sequence[type[Effect]] | None = None,
        pairs: bool = True,
        budget_s: float | None = None,
        progress: Progress | None = None,
        checkpoint: Checkpoint | None = None,
    ) -> None:
        self.logs, self.baseline, self.pairs = tuple(logs), baseline, pairs
        own = {e.name for e in baseline.effects}
        self.effects = [e for e in (EFFECTS.values() if effects is None else effects)]
        self.own = own
        self.until = None if budget_s is None else time.monotonic() + budget_s
        self.progress = progress or (lambda what, done, of: None)
        self.complete = True
        self.checkpoint = checkpoint or Checkpoint(None)

    # the whole ---------------------------------------------------------------------------------------------------
    def run(self) -> Race:
        glitches = None
        logs = self.logs
        record = Record.of(logs)
        raw = Record.of(logs, rate_hz=1e9)
        none = self._none(record)
        if self._has("outliers") and record.accel is not None:
            glitches = self._tails(raw, none)
            if glitches.hit.any() and glitches.evidence > 2:
                logs = cleaned(logs, raw, glitches)
                record = Record.of(logs)
                none = self._none(record)
        found = self._deterministic(record, none)
        if self._has("outliers") and record.accel is not None:
            again = self._tails(raw, max(found, key=lambda f: f.log_evidence))
            was = glitches is not None and glitches.evidence > 2 and bool(glitches.hit.any())
            now = again.evidence > 2 and bool(again.hit.any())
            before = 0 if glitches is None else int(glitches.hit.sum())
            if was != now or (now and abs(before - int(again.hit.sum())) > 0.3 * before + 3):
                logs = cleaned(self.logs, raw, again) if now else self.logs
                record = Record.of(logs)
                none = self._none(record)
                found = self._deterministic(record, none)
            glitches = again
        if self._has("command_hold"):
            found += self._held(Record.of(logs, rate_hz=1e9), found, none)
        if glitches is not None:
            found += self._glitched(found, glitches)
        found.sort(key=lambda f: -f.log_evidence)
        return Race(record, raw, tuple(logs), tuple(found), self.complete)

    def _has(self, name: str) -> bool:
        return any(e.name == name for e in self.effects)

    def _late(self) -> bool:
        if self.until is not None and time.monotonic() > self.until:
            self.complete = False
            return True
        return False

    # deterministic causes and gusts --------------------------------------------------------------------------------
    def _none(self, record: Record) -> Found:
        """The bare baseline, with its noise."""
        candidate = Candidate(record, (), self.baseline)
        noise = white_first(record)
        white = Whitener(record, noise)
        z = np.stack([candidate.z_of({"T_L": t, "K_L": 1.0}) for t in (0.12, 0.3, 0.8)])
        found, values = modes(candidate, white, z, iterations=6)
        return self._settled(candidate, found[values.argmax()], noise, rounds=6)

    def _settled(
        self, candidate: Candidate, z: Float, noise: NoiseModel, *, onset: int | None = None, rounds: int = 2
    ) -> Found:
        """Parameters and noise in turn until both rest."""
        record = candidate.record
        known = self.checkpoint.next(candidate.name, onset)
        if known is not None:
            return known.found(candidate, onset)
        white = Whitener(record, noise)
        if record.group > 1:
            z = modes(candidate, white, z[None], onset=onset, iterations=4, coarse=True)[0][0]
        value = -np.inf
        for turn in range(rounds + 1):
            z = modes(candidate, white, z[None], onset=onset, iterations=4)[0][0]
            fit = finish(candidate, white, z, onset)
            fitted = fit_noise(record, fit.errors, noise, T_L=self._lag(candidate, z), iterations=3)
            noise = fitted.noise
            white = Whitener(record, noise)
            new = float(fitted.rows.sum())
            if new < value + 0.3 or turn == rounds:
                break
            value = new
        self.checkpoint.keep(candidate.name, onset, Kept(z, noise, fitted.log_prior))
        return Kept(z, noise, fitted.log_prior).found(candidate, onset)

    @staticmethod
    def _lag(candidate: Candidate, z: Float) -> float:
        return float(candidate.values(z[None])["T_L"])

    def _deterministic(self, record: Record, none: Found) -> list[Found]:
        kinds = [e for e in self.effects if not e.random and self._possible(e, record)]
        white = Whitener(record, none.noise.noise)
        screened: list[tuple[float, Candidate, Float, int | None]] = []
        for i, kind in enumerate(kinds):
            self.progress("single effects", i, len(kinds))
            if self._late():
                break
            candidate = Candidate(record, (kind,), self.baseline)
            z, value = self._screen(candidate, white, none)
            onset, more = (None, 0.0)
            if kind.name != "gain_change" and value > none.log_likelihood - 200:
                onset, more = rough(white, candidate, z)
            screened.append((value, candidate, z, None))
            if onset is not None and more > 3:
                screened.append((value + more - 6, candidate, z, onset))
        best: dict[str, float] = {}
        for value, candidate, _, _ in screened:
            best[candidate.name] = max(best.get(candidate.name, -np.inf), value)
        order = sorted(best, key=lambda n: -best[n])
        # whatever is left behind keeps the evidence of its screening
        floor = none.log_likelihood
        top = best[order[0]] - floor if order else 0.0
        lead = [n for n in order[:_SINGLES] if best[n] - floor > min(0.25 * top, top - 30)]
        found = [none]
        blown = gust(none) if self._has("gust") else None
        if blown is not None:
            found.append(blown)
        for i, name in enumerate(lead):
            self.progress("the best of them", i, len(lead))
            if self._late():
                break
            forms = [s for s in screened if s[1].name == name]
            found.append(self._single(forms, found))
        for name in [n for n in order if n not in lead]:
            _, candidate, z, _ = next(s for s in screened if s[1].name == name)
            fit = finish(candidate, white, z)
            found.append(self._as_found(candidate, fit, none))
        if self.pairs:
            found += self._pairs(record, kinds, found, none)
        return found

    def _as_found(self, candidate: Candidate, fit, none: Found) -> Found:  # type: ignore[no-untyped-def]
        return Found(
            name=candidate.name,
            candidate=candidate,
            z=fit.z,
            covariance=fit.covariance,
            values={k: float(v) for k, v in candidate.values(fit.z[None]).items()},
            noise=none.noise,
            log_evidence=fit.log_evidence + none.noise.log_prior,
            log_likelihood=fit.log_joint,
            errors=fit.errors,
            grade_rms=fit.grade_rms,
            profile=fit.profile,
        )

    @staticmethod
    def _possible(kind: type[Effect], record: Record) -> bool:
        if kind.place == "sensor" and record.accel is None:
            return False
        return not (kind.needs_speed and record.speed is None)

    def _screen(self, candidate: Candidate, white: Whitener, base: Found) -> tuple[Float, float]:
        """The best of all starts under noise that is not its own."""
        z = starts(candidate, base.values)
        if len(z) > 2:
            values = np.concatenate(
                [white.log_likelihood(candidate.errors(z[i : i + 32], coarse=True)) for i in range(0, len(z), 32)]
            )
            z = z[np.argsort(-(values - 0.5 * (z**2).sum(1)))[:2]]
        found, values = modes(candidate, white, z, iterations=6, coarse=True)
        return found[values.argmax()], float(values.max())

    def _single(self, forms: list[tuple[float, Candidate, Float, int | None]], found: list[Found]) -> Found:
        """One cause over the whole drive and from an onset on; both weigh the same a priori."""
        noise = max(found, key=lambda f: f.log_evidence).noise.noise
        made = []
        for _, candidate, z, onset in forms:
            made.append(self._from_onset(candidate, z, noise, onset))
        return merged(made)

    def _from_onset(self, candidate: Candidate, z: Float, noise: NoiseModel, onset: int | None) -> Found:
        if onset is None:
            return self._settled(candidate, z, noise)
        record = candidate.record
        white = Whitener(record, noise)
        for _ in range(2):
            z = modes(candidate, white, z[None], onset=onset, iterations=4)[0][0]
            moved, _ = refined(white, candidate, z, onset)
            if moved == onset:
                break
            onset = moved
        settled = self._settled(candidate, z, noise, onset=onset)
        white = Whitener(record, settled.noise.noise)
        moved, tried = refined(white, candidate, settled.z, onset)
        if abs(moved - onset) * record.dt > 0.5:
            settled = self._settled(candidate, settled.z, settled.noise.noise, onset=moved)
            white = Whitener(record, settled.noise.noise)
            _, tried = refined(white, candidate, settled.z, moved)
        return replace(settled, log_evidence=settled.log_evidence + averaged(tried, record.dt))

    # pairs ---------------------------------------------------------------------------------------------------------
    def _pairs(self, record: Record, kinds: Sequence[type[Effect]], found: list[Found], none: Found) -> list[Found]:
        single = sorted((f for f in found if f.name != "none"), key=lambda f: -f.log_evidence)
        if not single or single[0].log_evidence < none.log_evidence + 3:
            return []
        top = single[0].log_evidence
        bases = [
            f
            for i, f in enumerate(single[:_BASES])
            if i == 0 or f.log_evidence > none.log_evidence + 0.3 * (top - none.log_evidence)
        ]
        made: dict[str, Found] = {}
        for number, base in enumerate(bases):
            if base.gust:
                continue
            white = Whitener(record, base.noise.noise)
            scored = []
            for kind in kinds:
                if kind.name in base.name.split("+") or self._late():
                    continue
                candidate = Candidate(record, (*base.candidate.effects, kind), self.baseline)
                if candidate.name in made:
                    continue
                scored.append(self._score(candidate, base, white))
            scored.sort(key=lambda s: -s[0])
            for i, (gain, candidate, z) in enumerate(scored[:_SECONDS]):
                self.progress("pairs", number * _SECONDS + i, len(bases) * _SECONDS)
                if gain < 4 or self._late():
                    break
                made[candidate.name] = self._pair(candidate, z, base)
            if self._has("gust"):
                gusty = gust(base)
                made[gusty.name] = gusty
        return list(made.values())

    def _score(self, candidate: Candidate, base: Found, white: Whitener) -> tuple[float, Candidate, Float]:
        """What a second effect could gain on top of `base`, by one linear step from each of its starts."""
        z = starts(candidate, base.values)
        e = white(base.errors.mean(-1, keepdims=True)).ravel()
        own = self._own_columns(base, white)
        best, at = -np.inf, z[0]
        grade = candidate.grade_columns if "road_grade" not in base.name else None
        if grade is not None:
            # GP columns: gain by their best size
            step, value = modes(candidate, white, z[:1], onset=base.onset, iterations=2, coarse=True)
            flat = base.errors.mean(-1, keepdims=True)
            return float(value[0] - white.log_likelihood(flat)), candidate, step[0]
        silent = base.candidate.rollouts(base.z[None], base.onset, coarse=True)[0]
        for i in range(0, len(z), 32):
            apart = white(candidate.rollouts(z[i : i + 32], base.onset, coarse=True) - silent).reshape(
                len(z[i : i + 32]), -1
            )
            apart = apart - (apart @ own.T) @ own
            square = np.einsum("cr,cr->c", apart, apart)
            cross = apart @ e
            ok = square > 1e-6
            gains = np.where(ok, 0.5 * np.maximum(cross, 0) ** 2 / np.maximum(square, 1e-6), 0.0)
            # a start that overshoots still tells the direction
            k = int(gains.argmax())
            if gains[k] > best:
                best, at = float(gains[k]), z[i + k]
        return best, candidate, at

    def _own_columns(self, base: Found, white: Whitener) -> Float:
        """Orthonormal white directions (direction, row) along which the base's own parameters move its rollout."""
        size = len(base.z)
        moved = np.repeat(base.z[None], size + 1, 0)
        moved[1:] += 1e-4 * np.eye(size)
        e = white(base.candidate.rollouts(moved, base.onset, coarse=True)).reshape(size + 1, -1)
        columns = e[1:] - e[:1]
        norms = np.linalg.norm(columns, axis=1)
        columns = columns[norms > 1e-9]
        if not len(columns):
            return np.zeros((0, e.shape[1]))
        q, _ = np.linalg.qr((columns / np.linalg.norm(columns, axis=1)[:, None]).T)
        return q.T

    def _pair(self, candidate: Candidate, z: Float, base: Found) -> Found:
        if base.onset is None:
            return self._settled(candidate, z, base.noise.noise)
        return self._from_onset(candidate, z, base.noise.noise, base.onset)

    # chance --------------------------------------------------------------------------------------------------------
    def _tails(self, raw: Record, of: Found) -> Tails:
        errors = self._raw_errors(raw, of)
        return tails(errors[0, :, 0], raw.dt)

    def _raw_errors(self, raw: Record, of: Found) -> Float:
        """Errors of a candidate's rollout at the log's own rate, (witness, counted)."""
        candidate = Candidate(raw, of.candidate.effects, self.baseline)
        onset = None
        if of.onset is not None and not of.gust:
            onset = int(np.searchsorted(raw.source, of.candidate.record.source[of.onset] * of.candidate.record.group))
        errors = candidate.errors(of.z[None], onset)[0]
        grade = candidate.grade_columns if of.profile is not None else None
        if grade is not None and of.profile is not None and len(grade) == len(of.profile):
            errors = errors - np.tensordot(of.profile, grade, 1)
        return errors

    def _glitched(self, found: list[Found], glitches: Tails) -> list[Found]:
        """Every candidate with outliers besides, and outliers alone."""
        out = []
        for f in found:
            names = [] if f.name == "none" else f.name.split("+")
            if len(names) > 1 or "outliers" in names:
                continue
            name = "+".join(sorted([*names, "outliers"]))
            onset = f.onset
            if f.name == "none" and glitches.onset is not None:
                onset = None
            out.append(
                replace(f, name=name, log_evidence=f.log_evidence + glitches.evidence, tails=glitches, onset=onset)
            )
        return out

    def _held(self, raw: Record, found: list[Found], none: Found) -> list[Found]:
        noise = fit_noise(raw, self._raw_errors(raw, none), none.noise.noise, T_L=none.values["T_L"], iterations=6)
        white = Whitener(raw, noise.noise)
        lost = losses(
            white, self._raw_errors(raw, none), raw.command[raw.source], none.values["T_L"], none.values["K_L"]
        )
        return [replace(none, name="command_hold", log_evidence=none.log_evidence + lost.evidence, losses=lost)]
