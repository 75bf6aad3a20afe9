"""What the header of a column says: its words, its unit, and which signal it may be."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from itertools import chain, pairwise

from avtorch.io.units import unit_named

_BRACKETS = re.compile(r"^(?P<name>.*?)[\s_.,-]*[\[(<{](?P<unit>[^\])>}]*)[\])>}]\s*$")
_BEHIND = re.compile(r"^(?P<name>.*?)(?:,\s*|\s+in\s+|\s*/\s+|[\s_.]+)(?P<unit>[^\s_.,]+)$")
_WORDS = re.compile(r"[A-ZÄÖÜ]+(?![a-zäöüß])|[A-ZÄÖÜ]?[a-zäöüß]+|\d+")

# letters that are as likely part of a name
_ONLY_IN_BRACKETS = {"g", "s", "m", "h", "a", "min", "gs", "ms", "rad", "second", "meter"}
_BARE = {"g": {"accel", "accel_cmd"}, "ms": {"time"}, "s": {"time"}}


@dataclass(frozen=True)
class Header:
    """A column's `name`, its `words` in lower case, and the `unit` it states in avtorch's spelling, or None.

    `bare`: a last word that may be a unit or part of the name, such as the g of `acc_g`. `endings`: the words of the
    last part of a path, of the last two, and so on to all.
    """

    name: str
    words: tuple[str, ...]
    unit: str | None = None
    bare: str | None = None
    endings: tuple[tuple[str, ...], ...] = ()


def header_of(name: str, stated: str | None = None) -> Header:
    """What a column's name says; `stated`: its unit by a row of units or the file's own format."""
    rest, unit, bare = name, unit_named(stated) if stated else None, None
    bracketed = _BRACKETS.match(name)
    if bracketed is not None:
        rest = bracketed["name"]
        unit = unit or unit_named(bracketed["unit"])
    elif (behind := _BEHIND.match(name)) is not None and (found := unit_named(behind["unit"])) is not None:
        amperes = behind["unit"] == "A" and behind["name"].islower()  # as of current_A
        if behind["unit"].lower() in _ONLY_IN_BRACKETS and not amperes:
            bare = found
        else:
            rest, unit = behind["name"], unit or found
    parts = [_words(part) for part in rest.split("/")]
    if unit is None and bare is None and parts[-1] and (found := _inside(parts[-1][-1])) is not None:
        unit, parts[-1] = found[0], (*parts[-1][:-1], found[1])
    endings = [tuple(chain.from_iterable(parts[i:])) for i in reversed(range(len(parts)))]
    return Header(name, endings[-1], unit, bare, tuple(dict.fromkeys(words for words in endings if words)))


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.lower() for word in _WORDS.findall(text))


def _inside(word: str) -> tuple[str, str] | None:
    """A unit at the end of a single word, such as `speedkph`, and what stands before it."""
    for form in ("kmph", "kmh", "kph", "mph", "mps2", "mps"):
        if word.endswith(form) and len(word) > len(form):
            return unit_named(form) or form, word[: -len(form)]
    return None


def bare_unit(header: Header, signal: str) -> str | None:
    """The unit that the last word of a name is for a signal, if it may be one."""
    last = header.bare
    return last if last is not None and signal in _BARE.get(last, {signal}) else None


_TIME = {
    "time", "timestamp", "t", "stamp", "zeit", "zeitstempel", "secs", "seconds", "elapsed", "clock", "datetime",
}  # fmt: skip
_ACCEL = {"accel", "acceleration", "beschl", "beschleunigung", "acc", "ax", "along", "alon", "a", "accx"}
_SPEED = {"speed", "veloc", "velocity", "geschw", "geschwindigkeit", "vitesse", "v", "vx", "spd", "vel", "vlon"}
_COMMAND = {
    "command", "commanded", "request", "requested", "demand", "demanded", "desired", "setpoint", "soll", "reference",
    "cmd", "req", "des", "dmd", "tgt", "ref", "sp", "set", "target", "control", "ctrl", "u", "wanted", "dem",
    "anforderung", "anf", "wunsch",
}  # fmt: skip
_LEAD = {"lead", "leader", "front", "preceding", "ahead", "vorder", "object", "obj", "radar", "other", "pov"}
_OTHER = {
    "lat", "lateral", "vert", "vertical", "pedal", "angular", "gyro", "yaw", "roll", "pitch", "y", "z", "ay", "az",
    "quer", "position", "jerk", "limit", "max", "min", "std", "var", "error", "err", "status", "valid", "steer",
    "steering", "curvature", "count", "id", "distance", "rate", "vy", "vz", "covariance", "heading",
    "accelerator",
}  # fmt: skip
_TURNING = {"wheel", "engine", "motor", "wind", "fan", "rpm", "shaft", "rad", "fl", "fr", "rl", "rr", "gps"}
_ANSWERED = {"raw", "actual", "measured", "report", "feedback"}
_STATE = {
    "status", "state", "valid", "active", "enable", "limit", "max", "min", "fault", "error", "time", "mode", "ready",
}  # fmt: skip
_ONE_WHEEL = {"fl", "fr", "rl", "rr", "left", "right", "rear"}
_OF_BRAKES = {
    "light", "lamp", "switch", "park", "parking", "temp", "temperature", "on", "disc", "hold",
}  # fmt: skip
_OF_STEERING = {"steer", "steering", "driver", "eps", "column", "yaw", "lateral", "hand", "servo", "friction", "loss"}
_OTHER_FLAGS = {
    "override", "overridden", "fault", "error", "available", "avail", "ready", "standby", "brake", "braking", "hold",
    "abs", "esp", "esc", "tcs", "turn", "indicator", "blinker", "lane", "lka", "aeb", "fcw", "warning", "light", "lamp",
    "door", "wiper", "horn",
}  # fmt: skip
_NOW = {
    "speed", "velocity", "accel", "gear", "lane", "position", "distance", "lap", "index", "heading", "battery",
    "target", "leak",
}  # fmt: skip


@dataclass(frozen=True)
class _Wanted:
    """Words of which a name holds one (each group), words it must not hold, and words that make it less likely."""

    groups: tuple[Collection[str], ...]
    not_: Collection[str]
    less: Collection[str] = ()


_SIGNALS: dict[str, _Wanted] = {
    "time": _Wanted(
        (_TIME,),
        {"gap", "headway", "collision", "ttc", "lag", "delay", "constant", "gps", "nsec", "nsecs", "nanosec"},
        {"sent", "receive", "header"},
    ),
    "accel_cmd": _Wanted((_ACCEL | {"u"}, _COMMAND), _OTHER | _LEAD | {"speed", "measured", "actual"}, {"raw"}),
    "accel": _Wanted((_ACCEL,), _OTHER | _COMMAND | _LEAD | {"speed"}, {"raw", "filtered", "model"}),
    "speed": _Wanted((_SPEED,), _OTHER | _COMMAND | _LEAD, _TURNING | {"raw", "relative", "rel"}),
    "engaged": _Wanted(
        ({"engaged", "enabled", "enable", "active", "autonomous", "automatic", "auto", "autopilot", "acc", "cruise"},),
        {"speed", "cmd", "accel", "set", "time", "x", "request"} | _OTHER_FLAGS,
    ),
    "spacing": _Wanted(
        ({"gap", "spacing", "headway", "clearance", "distance", "abstand", "range", "drel", "ivs"},),
        {"time", "travelled", "total", "set", "desired", "mileage", "lateral", "target"},
    ),
    "lead_speed": _Wanted((_SPEED, _LEAD), {"relative", "rel", "angular", "yaw", "cmd"}),
    "lead_accel": _Wanted((_ACCEL, _LEAD), {"relative", "rel", "angular", "yaw", "cmd"}),
    "grade": _Wanted(({"grade", "slope", "gradient", "incline", "steigung"},), {"time", "speed"}),
    "throttle": _Wanted(
        ({"throttle", "gas", "accelerator", "gaspedal", "fahrpedal", "accelpedal"},),
        _STATE | {"brake", "rate"},
        _ANSWERED | {"body", "valve"},
    ),
    "brake": _Wanted(
        ({"brake", "brk", "bremse", "bremsdruck"},),
        _STATE | _ONE_WHEEL | _OF_BRAKES | {"throttle"},
        _ANSWERED | {"torque"},
    ),
    "torque": _Wanted(
        ({"torque", "drehmoment", "trq", "tq", "moment"},), _STATE | _ONE_WHEEL | _OF_STEERING | {"brake"}, _ANSWERED
    ),
    "current": _Wanted(({"current", "strom", "amps", "amperes"},), _STATE | _OF_STEERING | _NOW, _ANSWERED),
    "speed_cmd": _Wanted((_SPEED, _COMMAND), _OTHER | _LEAD | _ACCEL | {"measured", "actual"}, _TURNING | {"raw"}),
    "segment": _Wanted(
        ({"segment", "run", "lap", "drive", "trip"},),
        {"time", "distance", "speed", "length", "driver", "drivetrain", "brake", "override", "mode", "torque", "count"},
    ),
}
NAMED_SIGNALS = tuple(_SIGNALS)
"""Signals that a name may be recognised as."""
_STEM = 4  # letters from which a word may begin with a wanted one, such as `acceleration` with `accel`


def likeness(header: Header, signal: str) -> float:
    """How well a name fits a signal: 0 not at all, 1 with nothing besides. Of a topic's path the last parts count."""
    if header.name == signal:
        return 2.0
    wanted = _SIGNALS[signal]
    if any(word in wanted.not_ and word in _COMMAND | _LEAD for word in header.words):
        return 0.0
    return max((_likeness(words, wanted) for words in header.endings), default=0.0)


def _likeness(words: tuple[str, ...], wanted: _Wanted) -> float:
    both = (*words, *(a + b for a, b in pairwise(words)))
    if not words or not all(_holds(both, group) for group in wanted.groups):
        return 0.0
    if any(word in wanted.not_ or _begins(word, wanted.not_) for word in words):
        return 0.0
    spare = max(len(words) - len(wanted.groups), 0) + 2.0 * sum(word in wanted.less for word in words)
    return 1.0 / (1.0 + 0.15 * spare)


def means_otherwise(header: Header) -> bool:
    """Whether a name says what is no motion along the road: another axis, an angle, a limit, an error."""
    words = header.endings[0] if header.endings else ()
    return any(word in _OTHER or _begins(word, _OTHER) for word in words)


def is_answer(header: Header) -> bool:
    """Whether a name says that it was measured."""
    return any(word in _ANSWERED for word in header.words)


def is_asked(header: Header) -> bool:
    """Whether a name says that it was commanded."""
    return any(word in _COMMAND or _begins(word, _COMMAND) for word in header.words)


def _begins(word: str, group: Collection[str]) -> bool:
    return any(len(stem) >= _STEM and word.startswith(stem) for stem in group)


def _holds(words: Collection[str], group: Collection[str]) -> bool:
    """Whether a word is one of the group, or begins or ends with one that is long enough."""
    return any(
        word in group or any(len(stem) >= _STEM and (word.startswith(stem) or word.endswith(stem)) for stem in group)
        for word in words
    )
