"""The text around the generated functions: header, parameters, step, the program that checks it, Makefile."""

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ptsmc_jax.onboard import generate
from ptsmc_jax.onboard.expressions import REAL
from ptsmc_jax.onboard.fields import Field
from ptsmc_jax.onboard.generate import Code
from ptsmc_jax.onboard.printing import HELPERS, comment, declared, inside_comment, number
from ptsmc_jax.simulation import run_state

STATUS = {
    "OK": "done",
    "SATURATED": "done; a limit of the actuators reduces the command",
    "MISSED": "done; the last sample is not one period ago, so the observer has left this one out",
    "SINGULAR": "the law is next to its singularity: its last good command",
    "INPUT": "an input that is not finite, beyond all measure, no rotation, or no later than the last: the last good "
    "output; nothing is kept",
    "OVERFLOW": "a result is not finite: the last good output; nothing is kept",
}


class About(NamedTuple):
    """What the files say of where they come from."""

    name: str  # a C identifier
    scenario: str  # its file
    digest: str
    law: str
    filtered: bool
    spacecraft: bool
    wheels: bool
    delay: int
    steepness: float  # (t_f / time to go of the last sample before the hand-over)^2, by which gains grow, or more


# public names of a controller: the templates have them after ptsmc_ and PTSMC_, exported files after ptsmc_NAME_
_SYMBOLS = ("init", "step", "parameters")  # linked
_TYPES = ("params", "in", "out", "state", "derived", "real", "status")
_ROWS = ("in_from", "state_from", "params_from", "out_to", "state_to", "params_to")  # of the flat header
_CONSTANTS = (*STATUS, "SCENARIO", *(f"{kind}_SIZE" for kind in ("IN", "OUT", "STATE", "PARAMS")))
_PUBLIC = re.compile(
    rf"\b(ptsmc_)({'|'.join((*_SYMBOLS, *_TYPES, *_ROWS))})\b(?!\.[ch]\b)|\b(PTSMC_)({'|'.join(_CONSTANTS)})\b"
)


def prefixed(text: str, name: str) -> str:
    """Return a text with the controller's name in all public names, so that several controllers link together."""

    def renamed(found: re.Match[str]) -> str:
        lower, own, upper, constant = found.groups()
        return f"{lower}{name}_{own}" if lower else f"{upper}{name.upper()}_{constant}"

    return _PUBLIC.sub(renamed, text)


def filled(file: str, **values: str) -> str:
    """A file of `files` with these values in place of @name@."""
    text = (Path(__file__).parent / "files" / file).read_text(encoding="utf-8")
    for name, value in values.items():
        text = text.replace(f"@{name}@", value)
    return text


def member(field: Field) -> list[str]:
    """A line of a struct, with what the field is."""
    size = "".join(f"[{n}]" for n in field.shape)
    text = f"    {declared(field.kind).replace('real', 'ptsmc_real')} {field.name}{size};"
    about = inside_comment(" ".join(field.about.split()))
    if not about:
        return [text]
    line = f"{text} /* {about} */"
    return [line] if len(line) <= 110 else [*comment(about, "    "), text]


def struct(name: str, about: str, members: Sequence[Field], first: Sequence[str] = (), last: Sequence[str] = ()) -> str:
    """A struct of C."""
    lines = [*comment(about), "typedef struct {", *first]
    for field in members:
        lines += member(field)
    return "\n".join([*lines, *last, f"}} {name};"])


def header(code: Code, about: About) -> str:
    """ptsmc_NAME.h."""
    guard = f"PTSMC_{about.name.upper()}_H"
    statuses = []
    for k, (name, meaning) in enumerate(STATUS.items()):
        statuses += [*comment(meaning, "    "), f"    PTSMC_{name} = {k}{',' if k + 1 < len(STATUS) else ''}"]
    remembered = "What is remembered from sample to sample; ptsmc_init fills it."
    time = ["    double t; /* of the sample, from the start of the manoeuvre [s]; double, since it is subtracted */"]
    flags = ["    double t; /* of the last sample [s] */", "    int started; /* 0 until the first sample */",
             "    int tracking; /* 0: the sign of the attitude and the law's clearance are chosen anew */"]  # fmt: skip
    if about.filtered:
        remembered += (
            " A filter that has run before the manoeuvre: set attitude and bias after that, else it starts from the "
            "first star tracker sample."
        )
    parameters = "Gains, body, devices: numbers that may change without another export."
    derived = (
        "What follows from the parameters, and the parameters that it was computed from: ptsmc_init computes it, and "
        "ptsmc_step anew where they have changed."
    )
    basis = [dataclasses.replace(field, name=f"of_{field.name}", about="") for field in code.basis]
    last = ["    ptsmc_out last; /* good one */", *(["    ptsmc_derived derived;"] if code.derived else [])]
    return "\n\n".join([
        "\n".join(comment(f"ptsmc_{about.name}.h: {about.law}, from {about.scenario}.\nMade by ptsmc export; scenario "
                          f"SHA-256 {about.digest}.")),
        f"#ifndef {guard}\n#define {guard}",
        "#include <stdint.h>",
        "#ifdef __cplusplus\nextern \"C\" {\n#endif",
        "/* Numbers: double, or float with -DPTSMC_REAL=float. */\n#ifndef PTSMC_REAL\n#define PTSMC_REAL double\n"
        "#endif\ntypedef PTSMC_REAL ptsmc_real;",
        "/* Symbols contain the precision, so files of different PTSMC_REAL don't link. */\n"
        "#define PTSMC_SUFFIXED_(name, real) name##_##real\n"
        "#define PTSMC_SUFFIXED(name, real) PTSMC_SUFFIXED_(name, real)\n"
        + "\n".join(f"#define ptsmc_{name} PTSMC_SUFFIXED(ptsmc_{name}, PTSMC_REAL)" for name in _SYMBOLS),
        f'#define PTSMC_SCENARIO "{about.digest}"',
        "\n".join(["/* What ptsmc_step returns, the gravest last. */", "enum ptsmc_status {", *statuses, "};"]),
        struct("ptsmc_params", parameters, code.parameters),
        struct("ptsmc_in", "What is measured at a sample.", code.inputs, time),
        struct("ptsmc_out", "What comes of it.", code.outputs),
        *([struct("ptsmc_derived", derived, [*code.derived, *basis])] if code.derived else []),
        struct("ptsmc_state", remembered, code.state, flags, last),
        "/* The parameters of the scenario. */\nextern const ptsmc_params ptsmc_parameters;",
        "/* Before the first sample. */\nvoid ptsmc_init(const ptsmc_params *p, ptsmc_state *state);",
        "\n".join(comment("One sample, once a period: reads in, sets out, which is finite whatever happens, and "
                          "returns a status. No allocation, no global state."))
        + "\nint ptsmc_step(const ptsmc_params *p, ptsmc_state *state, const ptsmc_in *in, ptsmc_out *out);",
        "#ifdef __cplusplus\n}\n#endif\n#endif\n",
    ])  # fmt: skip


def values(code: Code, about: About) -> str:
    """ptsmc_NAME_parameters.c."""
    lines = [*comment(f"The parameters of {about.scenario} (SHA-256 {about.digest})."),
             f'#include "ptsmc_{about.name}.h"', "", "#define R(x) ((ptsmc_real)(x))", "",
             "const ptsmc_params ptsmc_parameters = {"]  # fmt: skip
    for field in code.parameters:
        lines += [f"    {_initial(code.values[field.name], field.kind)}, /* {field.name} */"]
    lines[-1] = (
        lines[-1].replace("}, /*", "} /*") if lines[-1].startswith("    {") else lines[-1].replace("), /*", ") /*")
    )
    return "\n".join([*lines, "};", ""])


def _initial(value: Any, kind: str) -> str:
    if np.ndim(value) == 0:
        return number(value.item(), kind)
    return "{" + ", ".join(_initial(row, kind) for row in value) + "}"


def source(code: Code, about: About) -> str:
    """ptsmc_NAME.c."""
    head = f"""\
#include "ptsmc_{about.name}.h"

#include <math.h>

#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "inputs are checked for NaN and infinity: compile without -ffast-math, -Ofast and -ffinite-math-only"
#endif

typedef ptsmc_real real;

/* A number, and a function of math.h, of the type in use. */
#define R(x) ((real)(x))
#define PTSMC_IS_double 0
#define PTSMC_IS_float 1
#define PTSMC_JOIN(a, b) a##b
#define PTSMC_IS(type) PTSMC_JOIN(PTSMC_IS_, type)
#if PTSMC_IS(PTSMC_REAL)
#define M(function) function##f
#else
#define M(function) function
#endif
"""
    body = "\n\n".join(code.functions)
    helpers = [text for name, text in HELPERS.items() if f"{name}(" in body + code.derivation]
    doc = comment(f"ptsmc_{about.name}.c: {about.law}, from {about.scenario}.\nMade by ptsmc export; scenario SHA-256 "
                  f"{about.digest}. Headings name the functions of the source that this is traced from, with "
                  "the equations of Chen, Ju, Wang, Li, The prescribed time sliding mode control for attitude tracking "
                  "of spacecraft.")  # fmt: skip
    ahead = ["static void derive(const ptsmc_params *p, ptsmc_derived *d);", ""] if code.derived else []
    last = ["", code.derivation] if code.derived else []  # long, and not what a reader looks for
    body = [*ahead, body, "", *_checks(code, about), "", *_step(code, about), *last, ""]
    return "\n".join([*doc, "", head, *helpers, *body])


def _within(field: Field, owner: str) -> str:
    if not field.shape:
        return f"within(&{owner}{field.name}, 1)"
    return f"within(&{owner}{field.name}{'[0]' * len(field.shape)}, {field.size})"


def _finite(field: Field, owner: str) -> str:
    if not field.shape:
        return f"isfinite({owner}{field.name})"
    first = owner + field.name + "[0]" * len(field.shape)
    return f"all_finite(&{first}, {field.size})"


def _all(terms: Sequence[str], indent: str) -> list[str]:
    lines = [f"{indent}{term}{' &&' if k + 1 < len(terms) else ';'}" for k, term in enumerate(terms)]
    return [f"    return {lines[0].strip()}", *lines[1:]]


def _checks(code: Code, about: About) -> list[str]:
    reals = [field for field in code.inputs if field.kind == REAL]
    lines = ["static int all_finite(const real *v, int count)", "{", "    for (int k = 0; k < count; k++) {",
             "        if (!isfinite(v[k])) {", "            return 0;", "        }", "    }", "    return 1;", "}", "",
             f"/* Finite and no larger than {'1e6' if about.spacecraft else '1e12'}: what is larger would stay in the "
             "observer for long. */",
             "static int within(const real *v, int count)", "{", "    for (int k = 0; k < count; k++) {",
             f"        if (!(M(fabs)(v[k]) <= R({'1e6' if about.spacecraft else '1e12'}))) {{",
             "            return 0;", "        }", "    }", "    return 1;", "}", ""]  # fmt: skip
    if about.spacecraft:
        lines += ["/* Whether a quaternion is that of a rotation, nearly. */",
                  "static int rotation(const real *q)", "{",
                  "    const real square = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3];", "",
                  "    return isfinite(square) && square > R(0.25) && square < R(4);", "}", ""]  # fmt: skip
    lines += ["/* Whether an input can be used. */"]
    parameters = "const ptsmc_params *p, " if about.spacecraft else ""
    lines += [f"static int usable({parameters}const ptsmc_state *state, const ptsmc_in *in)", "{"]
    names = {field.name for field in code.inputs}
    sensors = [field for field in reals if f"{field.name}_valid" in names]
    required = [field for field in reals if field not in sensors and not field.name.endswith("_age")]
    told = [f"(in->{field.name}_valid == 0 || isfinite(in->{field.name}_age))"
            for field in sensors if f"{field.name}_age" in names]  # fmt: skip
    if about.spacecraft:
        lines += [
            "    const real *const w = in->rate;",
            "    const real turn = (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]) * p->period * p->period; /* [rad^2] */",
        ]
        attitudes = _attitudes(sensors) if sensors or "attitude" not in names else ["rotation(in->attitude)"]
        turned = [*attitudes, *told, "turn < R(1)"]
    else:
        turned = []
    terms = ["isfinite(in->t)", "(!state->started || in->t > state->t)",
             *(_within(field, "in->") for field in required), *turned]  # fmt: skip
    lines += [*_all(terms, "        "), "}", "", "/* Whether everything that is kept, and goes out, is finite. */",
              "static int sound(const ptsmc_state *now, const ptsmc_out *out)", "{"]  # fmt: skip
    kept = [_finite(field, "now->") for field in code.state if field.kind == REAL]
    lines += [*_all([*kept, *(_finite(field, "out->") for field in code.outputs)], "        "), "}"]
    return [*lines, *_current(code)] if code.derived else lines


def _attitudes(sensors: Sequence[Field]) -> list[str]:
    """Conditions on the readings of attitude sensors: each is usable or not valid, and an attitude is known."""
    star_trackers = [made for made in sensors if made.name.startswith(("attitude", "star_tracker_"))]
    others = [made for made in sensors if made not in star_trackers]
    known = ["rotation(state->attitude)", *(f"in->{made.name}_valid != 0" for made in star_trackers)]
    return [f"({' || '.join(known)})",
            *(f"(in->{made.name}_valid == 0 || rotation(in->{made.name}))" for made in star_trackers),
            *(f"(in->{made.name}_valid == 0 || {_within(made, 'in->')})" for made in others)]  # fmt: skip


def _current(code: Code) -> list[str]:
    """Whether what is derived is derived from these parameters."""

    def same(made: Field) -> str:
        first = made.name + "[0]" * len(made.shape)
        if made.kind != REAL:
            return f"p->{first} == d->of_{first}"
        return f"same(&p->{first}, &d->of_{first}, {made.size})"

    return ["", "static int same(const real *v, const real *w, int count)", "{",
            "    for (int k = 0; k < count; k++) {", "        if (!(v[k] <= w[k] && v[k] >= w[k])) {",
            "            return 0;", "        }", "    }", "    return 1;", "}", "",
            "/* Whether what is derived follows from these parameters. */",
            "static int current(const ptsmc_params *p, const ptsmc_derived *d)", "{",
            *_all([same(made) for made in code.basis], "        "), "}"]  # fmt: skip


def _step(code: Code, about: About) -> list[str]:
    call = code.calls
    singular = any(field.name == "clearance" for field in code.state)
    derived = ["    derive(p, &state->derived);"] if code.derived else []
    again = (
        ["    if (!current(p, &state->derived)) {", *(f"    {line}" for line in derived), "    }"] if derived else []
    )
    lines = [
        "void ptsmc_init(const ptsmc_params *p, ptsmc_state *state)", "{",
        "    static const ptsmc_state none = {0};", "",
        "    *state = none;", *derived, f"    {call['begin'].replace('&now', 'state')};",
        *([] if code.derived or "p" in _arguments(call["begin"]) else ["    (void)p;"]), "}", "",
        "int ptsmc_step(const ptsmc_params *p, ptsmc_state *state, const ptsmc_in *in, ptsmc_out *out)", "{",
        "    const real t = (real)in->t;",
        "    const real dt = state->started ? (real)(in->t - state->t) : R(0);",
        "    const int regular = state->started && M(fabs)(dt - p->period) <= R(0.1) * p->period;",
        "    const int tracking = state->tracking;",
        "    int status = state->started && !regular ? PTSMC_MISSED : PTSMC_OK;",
        "    ptsmc_state now;", "    ptsmc_out found;", "",
        f"    if (!usable({'p, ' if about.spacecraft else ''}state, in)) {{", "        *out = state->last;",
        "        return PTSMC_INPUT;", "    }",
        *again,
        "    now = *state;", "    found = state->last;", f"    {call['sense']};", f"    {call['observe']};",
        f"    {call['command']};",
    ]  # fmt: skip
    arguments = {name for text in call.values() for name in _arguments(text)}
    if "tracking" not in arguments:
        lines.remove("    const int tracking = state->tracking;")
    if "t" not in arguments:
        lines.remove("    const real t = (real)in->t;")
    if "act" in call:
        lines += [f"    if ({call['act']} && status == PTSMC_OK) {{", "        status = PTSMC_SATURATED;", "    }"]
    lines += [
        "    if (!sound(&now, &found)) {",
        "        *out = state->last;",
        "        return PTSMC_OVERFLOW;",
        "    }",
    ]
    if singular:
        least = number(run_state.SINGULAR_CLEARANCE, REAL)
        lines += [f"    now.tracking = now.clearance >= {least};", "    if (!now.tracking) {",
                  "        status = PTSMC_SINGULAR;", "    }"]  # fmt: skip
    else:
        lines += ["    now.tracking = 1;"]
    return [*lines, "    now.t = in->t;", "    now.started = 1;", "    now.last = found;", "    *state = now;",
            "    *out = found;", "    return status;", "}"]  # fmt: skip


def _arguments(call: str) -> list[str]:
    return call[call.index("(") + 1 : -1].split(", ")


def columns(code: Code) -> dict[str, list[str]]:
    """See `generate.columns`; and the parameters."""
    found = generate.columns(code.inputs, code.state, code.outputs)
    return {**found, "params": [element for made in code.parameters for element in made.elements()]}


def flat(code: Code, about: About) -> str:
    """ptsmc_NAME_flat.h: the structs as rows of doubles, for check.c and for other programs that call it.

    What is derived is not among them: it is the parameters' to say.
    """
    kinds = {made.name: made.kind for made in (*code.inputs, *code.state, *code.outputs)}
    kinds |= {made.name: made.kind for made in code.parameters}
    lists = columns(code)

    def kind(column: str) -> str:
        name = column.removeprefix("last.").partition("[")[0]
        return {"t": "double", "started": "int", "tracking": "int"}.get(
            name, declared(kinds.get(name, REAL)).replace("real", "ptsmc_real")
        )

    lines = [f"/* Structs of ptsmc_{about.name}.h from and to rows of doubles, in the order of vectors.csv and "
             "controller.json. */",
             f'#include "ptsmc_{about.name}.h"', ""]  # fmt: skip
    lines += ["enum {", *(f"    PTSMC_{name.upper()}_SIZE = {len(found)}{',' if name != 'params' else ''}"
                          for name, found in lists.items()), "};", ""]  # fmt: skip
    for name in ("in", "state", "params"):
        lines += [f"static inline void ptsmc_{name}_from(const double *v, ptsmc_{name} *x)", "{"]
        lines += [f"    x->{column} = ({kind(column)})v[{k}];" for k, column in enumerate(lists[name])] + ["}", ""]
    for name in ("out", "state", "params"):
        lines += [f"static inline void ptsmc_{name}_to(const ptsmc_{name} *x, double *v)", "{"]
        lines += [f"    v[{k}] = (double)x->{column};" for k, column in enumerate(lists[name])] + ["}", ""]
    return "\n".join(lines)


def makefile(about: About) -> str:
    """Makefile."""
    return filled("Makefile", name=about.name)


def check(code: Code, about: About) -> str:
    """check.c."""
    lists = columns(code)
    names = [f"{kind}.{column}" for kind in ("out", "state") for column in lists[kind]]
    groups = {group: k for k, group in enumerate(dict.fromkeys(map(_compared, names)))}
    listed = ",\n".join(f'    {{"{name}", {groups[_compared(name)]}}}' for name in names)
    return filled("check.c", name=about.name, listed=listed, steepness=repr(about.steepness))


def fuzz(code: Code, about: About) -> str:
    """fuzz.c."""
    kinds = {made.name: made.kind for made in code.inputs}
    flags = [k for k, column in enumerate(columns(code)["in"]) if kinds.get(column.partition("[")[0], REAL) != REAL]
    lines = [f"        v[{k}] = (double)(bits() % 2); /* a flag */" for k in flags]
    return filled("fuzz.c", name=about.name, flags="\n".join(lines))


# what is a difference of what: rounding leaves of it what it leaves of those
TORQUES, RATES = ("d_hat", "observer", "command", "torque"), ("rate", "bias", "gyro")


def _compared(column: str) -> str:
    """The group of columns by the largest of which a column is compared."""
    name = column.partition(".")[2].removeprefix("last.").partition("[")[0]
    return TORQUES[0] if name.startswith(TORQUES) else RATES[0] if name in RATES else name


def operations(count: Mapping[str, int]) -> dict[str, int]:
    """Operations of a step at most, or of another function, by sort."""
    sums = sum(count.get(op, 0) for op in ("add", "sub", "neg"))
    others = {"sums": sums, "products": count.get("mul", 0), "quotients": count.get("div", 0),
              "roots": count.get("sqrt", 0) + count.get("cbrt", 0)}  # fmt: skip
    plain = {"add", "sub", "neg", "mul", "div", "sqrt", "cbrt", "lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not",
             "select", "max", "min", "abs", "sign", "convert", "entry", "isfinite", "floor", "rint"}  # fmt: skip
    others["comparisons and choices"] = sum(count.get(op, 0) for op in plain) - sum(others.values())
    others["elementary functions"] = sum(n for op, n in count.items() if op not in plain)
    return others


def stack(code: Code, real: int = 8) -> int:
    """Bytes of stack of a step at most, if no variable shared a place with another."""
    held = (*code.state, *code.outputs, *code.outputs, *code.derived, *code.basis)
    fields = sum(made.size * (real if made.kind == REAL else 4) for made in held)
    return int(math.ceil((fields + code.variables * real + 256) / 16) * 16)
