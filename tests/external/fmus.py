"""FMUs for the tests: a car in C for FMI 2 and 3 that shares nothing with avtorch, its description written by hand.

A second-order actuator and drag, in steps of about 1 ms. `drive` is the same in Python. With `fault` it fails at 1 s.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import fmpy
import pytest

START = {
    "u": 0.0, "a": 0.0, "v": 0.0, "v0": 3.0, "a0": 0.0, "omega": 6.0, "damping": 0.8, "drag": 4e-4,
    "accel_scale": 1.0, "speed_scale": 1.0, "only_step": 0.0, "fault": 0,
}  # fmt: skip
"""Variables by their references, in order."""
NONE, ERROR, NAN, HANG, CRASH, EXIT, HANG_AT_START = range(7)

_SOURCE = r"""
#include <math.h>
#include <stdlib.h>
#include <string.h>
enum {U, A, V, V0, A0, OMEGA, DAMPING, DRAG, ACCEL_SCALE, SPEED_SCALE, ONLY_STEP, FAULT, COUNT};
static const double start[COUNT] = {STARTS};
typedef struct { double x[COUNT], a, slope, v; void *log, *env; } Car;

static Car *made(void) { Car *c = calloc(1, sizeof(Car)); memcpy(c->x, start, sizeof start); return c; }
static void show(Car *c) { c->x[A] = c->a * c->x[ACCEL_SCALE]; c->x[V] = c->v * c->x[SPEED_SCALE]; }
static void begin(Car *c) {
    double *x = c->x; /* by the outputs' own start values, where one is set */
    c->v = (x[V] ? x[V] : x[V0]) / x[SPEED_SCALE]; c->a = (x[A] ? x[A] : x[A0]) / x[ACCEL_SCALE]; c->slope = 0;
    show(c);
    if (x[FAULT] == 6) for (volatile int on = 1; on;) {}
}
static int step(Car *c, double t, double h) {
    double *x = c->x, u = x[U] / x[ACCEL_SCALE], w = x[OMEGA];
    int n = (int)floor(h / 0.001 + 0.5), fault = (int)x[FAULT];
    if (x[ONLY_STEP] > 0 && fabs(h - x[ONLY_STEP]) > 1e-12) return 3;
    if (n < 1) n = 1;
    double k = h / n;
    for (int i = 0; i < n; i++) {
        c->slope += k * (w * w * (u - c->a) - 2 * x[DAMPING] * w * c->slope);
        c->a += k * c->slope;
        c->v += k * (c->a - x[DRAG] * c->v * c->v);
    }
    if (t + h > 1.0 + 1e-9) {
        if (fault == 1) return 3;
        if (fault == 2) c->a = NAN;
        if (fault == 3) for (volatile int on = 1; on;) {}
        if (fault == 4) abort();
        if (fault == 5) exit(7);
    }
    show(c);
    return 0;
}
#define INITIALISED(call) int call(Car *c) { begin(c); return 0; }
#define NOTHING(call) int call() { return 0; }
#if FMI == 2
typedef void (*Log)(void *, const char *, int, const char *, const char *, ...);
void *fmi2Instantiate(const char *n, int kind, const char *id, const char *at, void **calls, int visible, int log) {
    Car *c = made(); c->log = calls[0]; c->env = calls[4]; return c;
}
void fmi2FreeInstance(Car *c) { free(c); }
NOTHING(fmi2SetupExperiment) NOTHING(fmi2EnterInitializationMode) INITIALISED(fmi2ExitInitializationMode)
int fmi2SetReal(Car *c, const unsigned *r, size_t n, const double *x) { while (n--) c->x[r[n]] = x[n]; return 0; }
int fmi2GetReal(Car *c, const unsigned *r, size_t n, double *x) { while (n--) x[n] = c->x[r[n]]; return 0; }
int fmi2SetInteger(Car *c, const unsigned *r, size_t n, const int *x) { while (n--) c->x[r[n]] = x[n]; return 0; }
int fmi2DoStep(Car *c, double t, double h, int final) {
    int status = step(c, t, h);
    if (status) ((Log)c->log)(c->env, "car", status, "logStatusError", "fuse %d has blown", 17);
    return status;
}
#else
typedef void (*Log)(void *, int, const char *, const char *);
void *fmi3InstantiateCoSimulation(const char *n, const char *id, const char *at, _Bool visible, _Bool log, _Bool events,
                                  _Bool early, const unsigned *r, size_t nr, void *env, void *say, void *update) {
    Car *c = made(); c->log = say; c->env = env; return c;
}
void fmi3FreeInstance(Car *c) { free(c); }
NOTHING(fmi3EnterInitializationMode) INITIALISED(fmi3ExitInitializationMode)
int fmi3SetFloat64(Car *c, const unsigned *r, size_t n, const double *x, size_t m) {
    while (n--) c->x[r[n]] = x[n]; return 0;
}
int fmi3GetFloat64(Car *c, const unsigned *r, size_t n, double *x, size_t m) {
    while (n--) x[n] = c->x[r[n]]; return 0;
}
int fmi3SetInt32(Car *c, const unsigned *r, size_t n, const int *x, size_t m) {
    while (n--) c->x[r[n]] = x[n]; return 0;
}
int fmi3DoStep(Car *c, double t, double h, _Bool final, _Bool *event, _Bool *end, _Bool *early, double *last) {
    *event = *end = *early = 0; *last = t + h;
    int status = step(c, t, h);
    if (status) ((Log)c->log)(c->env, status, "logStatusError", "fuse 17 has blown");
    return status;
}
#endif
"""
_ENDING = fmpy.sharedLibraryExtension
BINARIES = {2: fmpy.platform, 3: fmpy.platform_tuple}


def drive(command: Any, dt: float, *, speed: float, accel: float, **given: float) -> tuple[list[float], list[float]]:
    """The car's accelerations and speeds at the ends of the steps."""
    x = {**START, **given}
    a, slope, v, n = accel, 0.0, speed, max(round(dt / 0.001), 1)
    k, w, shown = dt / n, x["omega"], []
    for u in command:
        for _ in range(n):
            slope += k * (w * w * (u - a) - 2 * x["damping"] * w * slope)
            a += k * slope
            v += k * (a - x["drag"] * v * v)
        shown.append((a, v))
    return [a for a, _ in shown], [v for _, v in shown]


def library(folder: Path, fmi: int) -> Path:
    """The compiled car."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler")
    source = _SOURCE.replace("STARTS", ", ".join(str(x) for x in START.values()))
    # the other functions of the standard, which an importer looks for
    header = Path(fmpy.__file__).with_name("c-code") / f"fmi{fmi}FunctionTypes.h"
    names = set(re.findall(rf"\b(fmi{fmi}\w+)TYPE\b", header.read_text(encoding="utf-8")))
    source += "".join(
        f"int {name}() {{ return 3; }}\n" for name in sorted(names) if not re.search(rf"\b{name}\b", source)
    )
    (folder / "car.c").write_text(source)
    built = folder / f"car{_ENDING}"
    options = ["-shared", "-fPIC", "-O1", "-w", f"-DFMI={fmi}"]
    subprocess.run([compiler, *options, "-o", built, folder / "car.c", "-lm"], check=True)
    return built


def variables(*, names: Mapping[str, str] | None = None, units: Mapping[str, str] | None = None) -> dict[str, dict]:
    """What the description says of each variable, by its name in `START`; changed as a test likes."""
    names, units = names or {}, units or {}
    causality = {"u": "input", "a": "output", "v": "output"}
    found = {}
    for name, start in START.items():
        kind = causality.get(name, "parameter")
        fixed = {"variability": "fixed", "initial": "exact"} if kind == "parameter" else {}
        found[name] = {"name": names.get(name, name), "causality": kind, **fixed}
        found[name]["start"] = None if kind == "output" else start
        found[name]["unit"] = units.get(name)
    return found


UNITS = {
    "m/s2": 'm="1" s="-2"',
    "m/s": 'm="1" s="-1"',
    "km/h": 'm="1" s="-1" factor="0.2777777777777778"',
    "N": 'kg="1" m="1" s="-2"',
    "gees": 'm="1" s="-2" factor="9.80665"',
}


def description(
    fmi: int,
    given: Mapping[str, dict],
    *,
    step: float | None = None,
    variable_step: bool = True,
    kind: str = "CoSimulation",
) -> str:
    """modelDescription.xml; units that are not in `UNITS` are named without a definition."""
    stated = sorted({v["unit"] for v in given.values() if v["unit"] in UNITS})
    units = "".join(f'<Unit name="{u}"><BaseUnit {UNITS[u]}/></Unit>' for u in stated)
    units = f"<UnitDefinitions>{units}</UnitDefinitions>" if stated else ""
    experiment = "" if step is None else f'<DefaultExperiment stepSize="{step}"/>'
    free = str(variable_step).lower()
    scalars, outputs = "", ""
    for reference, (key, v) in enumerate(given.items()):
        outer = "".join(f' {k}="{v[k]}"' for k in ("name", "causality", "variability", "initial") if v.get(k))
        inner = "".join(f' {k}="{v[k]}"' for k in ("start", "unit", "min", "max") if v.get(k) is not None)
        real = key != "fault"
        if fmi == 2:
            type_ = f"<{'Real' if real else 'Integer'}{inner}/>"
            scalars += f'<ScalarVariable valueReference="{reference}"{outer}>{type_}</ScalarVariable>'
            outputs += f'<Unknown index="{reference + 1}"/>' if v["causality"] == "output" else ""
        else:
            scalars += f'<{"Float64" if real else "Int32"} valueReference="{reference}"{outer}{inner}/>'
            outputs += f'<Output valueReference="{reference}"/>' if v["causality"] == "output" else ""
    head = 'fmiVersion="2.0" guid="car"' if fmi == 2 else 'fmiVersion="3.0" instantiationToken="car"'
    structure = f"<Outputs>{outputs}</Outputs>" if fmi == 2 else outputs
    able = f' canHandleVariableCommunicationStepSize="{free}"' if kind == "CoSimulation" else ""
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription modelName="car" {head}>'
        f'<{kind} modelIdentifier="car"{able}/>{units}{experiment}'
        f"<ModelVariables>{scalars}</ModelVariables><ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )


def packed(path: Path, xml: str, library: Path, where: str) -> Path:
    """The FMU of a description and a library, which lies in the folder `where` of its binaries."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", xml)
        archive.write(library, f"binaries/{where}/car{_ENDING}")
    return path
