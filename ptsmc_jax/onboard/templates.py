"""The files of an exported controller: the templates in `files`, filled with the generated code."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from string import Template
from typing import NamedTuple

import numpy as np

from ptsmc_jax.onboard.expressions import REAL
from ptsmc_jax.onboard.fields import Field
from ptsmc_jax.onboard.generate import Code
from ptsmc_jax.onboard.printing import FILES, HELPERS, c_type, comment, inside_comment, number
from ptsmc_jax.simulation import run_state

STATUS = {
    "OK": "new output",
    "SATURATED": "new output; an actuator limit reduces the command",
    "MISSED": "new output; the last sample is not one period ago, so the observer is not updated",
    "SINGULAR": "the law is too near to its singularity; the last good command is returned",
    "INPUT": "an input is not finite, too large, not a rotation, or not later than the last sample; the last good "
    "output is returned and the state does not change",
    "OVERFLOW": "a result is not finite; the last good output is returned and the state does not change",
}
# columns of vectors.csv whose rounding errors are compared with the largest number of the whole group
TORQUES, RATES = ("d_hat", "observer", "command", "torque", "sent"), ("rate", "bias", "gyro")


# further exported files, and their templates; Python templates end in .py.in, so that nothing imports them
PROGRAMS = {name: name for name in ("check.c", "fuzz.c", "Makefile", "udp.c", "shared.c")}
PROGRAMS |= {name: f"{name}.in" for name in ("udp.py", "basilisk.py")}


class About(NamedTuple):
    """Properties of the controller and its origin."""

    name: str  # a C identifier
    scenario: str  # name of the scenario's file
    checksum: str  # checksum of the scenario
    law: str  # class name of the law
    filtered: bool  # whether there is an attitude filter
    largest: float  # largest accepted size of a measured number
    delay: int  # delay of the commands in control periods
    steepness: float  # growth of rounding errors up to the hand-over, see `vectors.steepness`; at least of the gains

    @property
    def stem(self) -> str:
        """The beginning of the names of its C files."""
        return f"ptsmc_{self.name}"


# public names of a controller: templates prefix them with ptsmc_ and PTSMC_, exported files with ptsmc_NAME_
_SYMBOLS = ("init", "step", "parameters")  # names with external linkage
_TYPES = ("params", "in", "out", "state", "derived", "real", "status")
_ROWS = ("in_from", "state_from", "params_from", "out_to", "state_to", "params_to")  # functions of the flat header
_CONSTANTS = (*STATUS, "SCENARIO", *(f"{kind}_SIZE" for kind in ("IN", "OUT", "STATE", "PARAMS")))
_PUBLIC = re.compile(
    rf"\b(ptsmc_)({'|'.join((*_SYMBOLS, *_TYPES, *_ROWS))})\b(?!\.[ch]\b)|\b(PTSMC_)({'|'.join(_CONSTANTS)})\b"
)


def with_public_prefix(text: str, name: str) -> str:
    """Return a text with the controller's name in all public names, so that several controllers link together."""

    def renamed(found: re.Match[str]) -> str:
        lower, own, upper, constant = found.groups()
        return f"{lower}{name}_{own}" if lower else f"{upper}{name.upper()}_{constant}"

    return _PUBLIC.sub(renamed, text)


def filled(file: str, **values: str | int) -> str:
    """Return a file of `files` with these values for ${name}; an empty value alone on a line removes the line."""
    text = (FILES / file).read_text(encoding="utf-8")
    for name, value in values.items():
        if value == "":
            text = re.sub(rf"^\$\{{{name}\}}\n", "", text, flags=re.MULTILINE)
    return Template(text).substitute(values)


def texts(code: Code, about: About) -> dict[str, str]:
    """Return the text of each file of a controller, by file name, except for README.md and tables of numbers."""
    stem = about.stem
    files = {f"{stem}.h": "controller.h", f"{stem}.c": "controller.c", f"{stem}_parameters.c": "parameters.c",
             f"{stem}_flat.h": "flat.h"} | PROGRAMS  # fmt: skip
    origin = {"name": about.name, "upper": about.name.upper(), "scenario": about.scenario, "checksum": about.checksum,
              "law": about.law}  # fmt: skip
    values = origin | _structs(code, about) | _checks(code, about) | _step(code) | rows(code, about)
    values["head"] = filled("head.c", name=about.name, functions=values["functions"]).rstrip()
    return {name: filled(file, **values) for name, file in files.items()}


def plant_texts(code: Code, about: About) -> dict[str, str]:
    """Return the text of each file of a plant in C, by file name."""
    stem, call = about.stem, code.calls
    values = {"name": about.name, "upper": about.name.upper(), "scenario": about.scenario, "checksum": about.checksum}
    functions = "\n".join([*_helpers(code), "\n\n".join(code.functions)])
    head = filled("head.c", name=about.name, functions=functions).rstrip()
    values |= _structs(code, about) | {
        "head": head,
        "derive": "    derive(p, &state->derived);" if code.derived else "",
        "keep": "    now.derived = state->derived;" if code.derived else "",
        "begin": call["begin"],
        "advance": call["advance"],
        "usable": _conjunction([_called("all_finite", field, "in->") for field in _reals(code.inputs)]),
        "sound": _conjunction([_called("all_finite", field, "now.") for field in _reals(code.state)]),
        "unused": "" if code.derived or "(p" in call["begin"] + call["advance"] else "    (void)p;",
        "derivation": f"\n{code.derivation}" if code.derived else "",
    }
    files = {f"{stem}.h": "plant.h", f"{stem}.c": "plant.c"}
    return {name: filled(file, **values) for name, file in files.items()}


def _helpers(code: Code) -> list[str]:
    """Return the helper functions that the code calls, and the declaration of `derive`."""
    text = "\n".join([*code.functions, code.derivation])
    ahead = ["static void derive(const ptsmc_params *p, ptsmc_derived *d);\n"] if code.derived else []
    return [*(helper for name, helper in HELPERS.items() if f"{name}(" in text), *ahead]


def members(fields: Iterable[Field]) -> str:
    """Return the members of a struct, with the meaning of each."""
    lines = []
    for field in fields:
        size = "".join(f"[{n}]" for n in field.shape)
        text = f"    {c_type(field.kind).replace('real', 'ptsmc_real')} {field.name}{size};"
        about = inside_comment(" ".join(field.about.split()))
        line = f"{text} /* {about} */" if about else text
        lines += [line] if len(line) <= 110 else [*comment(about, "    "), text]
    return "\n".join(lines)


def _structs(code: Code, about: About) -> dict[str, str]:
    """Return the template values of the header, and the numbers of the parameters."""
    statuses = [f"    PTSMC_{name} = {k}, /* {meaning} */" for k, (name, meaning) in enumerate(STATUS.items())]
    note = ("\n * If the attitude filter has run before the manoeuvre, set attitude and bias afterwards. Otherwise it "
            "starts\n * from the first sample of the star tracker.\n")  # fmt: skip
    copies = [replace(field, name=f"of_{field.name}", about="") for field in code.basis]
    derived = members([*code.derived, *copies])
    numbers = [f"    {_initial(code.values[field.name], field.kind)}, /* {field.name} */" for field in code.parameters]
    return {
        "statuses": "\n".join(statuses),
        "params_members": members(code.parameters),
        "in_members": members(code.inputs),
        "out_members": members(code.outputs),
        "state_members": members(code.state),
        "derived_struct": filled("derived.h", derived_members=derived) if code.derived else "",
        "derived_member": "    ptsmc_derived derived;" if code.derived else "",
        "filter_note": note if about.filtered else "",
        "parameter_values": "\n".join(numbers),
    }


def _initial(value: np.ndarray, kind: str) -> str:
    if value.ndim == 0:
        return number(value.item(), kind)
    return "{" + ", ".join(_initial(row, kind) for row in value) + "}"


def _checks(code: Code, about: About) -> dict[str, str]:
    """Return the template values of the functions that check input, results and derived numbers."""
    names = {field.name for field in code.inputs}
    # sensors whose readings may be missing
    sensors = [field for field in _reals(code.inputs) if f"{field.name}_valid" in names]
    usable = ["isfinite(in->t)", "(!state->started || in->t > state->t)"]
    usable += [_called("within", field, "in->") for field in _reals(code.inputs)
               if field not in sensors and not field.name.endswith("_age")]  # fmt: skip
    turning = "attitude" in {field.name for field in code.state}
    usable += ["rotation(in->attitude)"] if "attitude" in names and not sensors else _attitudes(sensors)
    usable += [f"(in->{field.name}_valid == 0 || isfinite(in->{field.name}_age))"
               for field in sensors if f"{field.name}_age" in names]  # fmt: skip
    usable += ["rotation(in->reference_q)"] if "reference_q" in names else []
    usable += ["turn < R(1)"] if turning else []
    sound = [_called("all_finite", field, "now->") for field in _reals(code.state)]
    sound += [_called("all_finite", field, "out->") for field in code.outputs]
    same = [_called("same", field, "p->", "d->of_") for field in _reals(code.basis)]
    same += [f"p->{one} == d->of_{one}" for field in code.basis if field.kind != REAL for one in field.elements()]
    return {
        "largest": f"{about.largest:.0f}",
        "params": "const ptsmc_params *p, " if turning else "",
        "p": "p, " if turning else "",
        "rotation": filled("rotation.c").rstrip() + "\n" if turning else "",
        "turn": filled("turn.c").rstrip() if turning else "",
        "usable": _conjunction(usable),
        "sound": _conjunction(sound),
        "current": filled("current.c", same=_conjunction(same)).rstrip() if code.derived else "",
    }


def _attitudes(sensors: Sequence[Field]) -> list[str]:
    """Return conditions on attitude sensors: an attitude is known, and each reading is usable or not valid."""
    if not sensors:
        return []
    star_trackers = [field for field in sensors if field.name.startswith(("attitude", "star_tracker_"))]
    known = ["rotation(state->attitude)", *(f"in->{field.name}_valid != 0" for field in star_trackers)]
    checks = [f"rotation(in->{field.name})" if field in star_trackers else _called("within", field, "in->")
              for field in sensors]  # fmt: skip
    readings = [f"(in->{field.name}_valid == 0 || {check})" for field, check in zip(sensors, checks, strict=True)]
    return [f"({' || '.join(known)})", *readings]


def _reals(fields: Iterable[Field]) -> list[Field]:
    return [field for field in fields if field.kind == REAL]


def _called(function: str, field: Field, *owners: str) -> str:
    """Return a call with the address of the field's first number in each of these structs, and the field's size."""
    firsts = ", ".join(f"&{owner}{field.name}{'[0]' * len(field.shape)}" for owner in owners)
    return f"{function}({firsts}, {field.size})"


def _conjunction(terms: Sequence[str]) -> str:
    """Return an expression that is true if all terms are true, one term a line."""
    return " &&\n        ".join(terms)


def _step(code: Code) -> dict[str, str]:
    """Return the template values of the functions of the stages, `ptsmc_init` and `ptsmc_step`."""
    call = code.calls
    arguments = re.findall(r"\w+", " ".join(call.values()))
    derive = "    derive(p, &state->derived);" if code.derived else ""
    least = number(run_state.SINGULAR_DISTANCE, REAL)
    singular = (f"    now.tracking = now.singularity_distance >= {least};\n"
                "    if (!now.tracking) {\n        status = PTSMC_SINGULAR;\n    }")  # fmt: skip
    saturated = f"    if ({call.get('act')} && status == PTSMC_OK) {{\n        status = PTSMC_SATURATED;\n    }}"
    return {
        "functions": "\n".join([*_helpers(code), "\n\n".join(code.functions)]),
        "derivation": f"\n{code.derivation}" if code.derived else "",  # at the end of the file, because it is long
        "derive": derive,
        "derive_again": f"    if (!current(p, &state->derived)) {{\n    {derive}\n    }}" if derive else "",
        "begin": call["begin"].replace("&now", "state"),
        "unused": "" if code.derived or "(p" in call["begin"] else "    (void)p;",
        "time": "    const real t = (real)in->t;" if "t" in arguments else "",
        "tracking": "    const int tracking = state->tracking;" if "tracking" in arguments else "",
        **{stage: call[stage] for stage in ("sense", "observe", "command")},
        "act": saturated if "act" in call else "",
        "regularity": singular
        if any(field.name == "singularity_distance" for field in code.state)
        else "    now.tracking = 1;",
    }


def rows(code: Code, about: About) -> dict[str, str | int]:
    """Return the template values of the flat header, and of the programs that read rows of vectors.csv."""
    columns = code.columns
    every = (*code.inputs, *code.state, *code.outputs, *code.parameters)
    kinds = {field.name: c_type(field.kind).replace("real", "ptsmc_real") for field in every}
    kinds |= {"t": "double", "started": "int", "tracking": "int"}

    def kind(column: str) -> str:
        return kinds[column.removeprefix("last.").partition("[")[0]]

    compared = [f"{struct}.{column}" for struct in ("out", "state") for column in columns[struct]]
    groups = {group: k for k, group in enumerate(dict.fromkeys(map(_group, compared)))}
    flags = [k for k, column in enumerate(columns["in"]) if kind(column) not in ("double", "ptsmc_real")]
    read = {f"{name}_from": "\n".join(f"    x->{column} = ({kind(column)})v[{k}];" for k, column in enumerate(found))
            for name, found in columns.items() if name != "out"}  # fmt: skip
    written = {f"{name}_to": "\n".join(f"    v[{k}] = (double)x->{column};" for k, column in enumerate(found))
               for name, found in columns.items() if name != "in"}  # fmt: skip
    return {
        **{f"{name}_size": len(found) for name, found in columns.items()},
        **read,
        **written,
        "compared": "\n".join(f'    {{"{name}", {groups[_group(name)]}}},' for name in compared),
        "flags": "\n".join(f"        v[{k}] = (double)(bits() % 2); /* a flag */" for k in flags),
        "steepness": repr(about.steepness),
    }


def _group(column: str) -> str:
    """Return the group of a column of vectors.csv. Rounding errors are relative to the largest number of a group."""
    name = column.partition(".")[2].removeprefix("last.").partition("[")[0]
    return TORQUES[0] if name.startswith(TORQUES) else RATES[0] if name in RATES else name


def operations(count: Mapping[str, int]) -> dict[str, int]:
    """Return the largest number of operations of a function, by kind."""
    sums = sum(count.get(op, 0) for op in ("add", "sub", "neg"))
    others = {"sums": sums, "products": count.get("mul", 0), "quotients": count.get("div", 0),
              "roots": count.get("sqrt", 0) + count.get("cbrt", 0)}  # fmt: skip
    plain = {"add", "sub", "neg", "mul", "div", "sqrt", "cbrt", "lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not",
             "select", "max", "min", "abs", "sign", "convert", "entry", "isfinite", "floor", "rint"}  # fmt: skip
    others["comparisons and choices"] = sum(count.get(op, 0) for op in plain) - sum(others.values())
    others["elementary functions"] = sum(n for op, n in count.items() if op not in plain)
    return others


def stack(code: Code, real: int = 8) -> int:
    """Return an upper bound on the stack of a step [byte], if each variable has its own memory."""
    held = (*code.state, *code.outputs, *code.outputs, *code.derived, *code.basis)
    fields = sum(made.size * (real if made.kind == REAL else 4) for made in held)
    return int(math.ceil((fields + code.variables * real + 256) / 16) * 16)
