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
from ptsmc_jax.onboard.printing import FILES, HELPERS, c_type, escape_comment_marks, format_comment, format_constant
from ptsmc_jax.simulation import rollout

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


class ExportInfo(NamedTuple):
    """Properties of the controller and its origin."""

    name: str  # a C identifier
    scenario: str  # name of the scenario's file
    checksum: str  # checksum of the scenario
    law: str  # class name of the law
    has_filter: bool  # whether there is an attitude filter
    largest_measurement: float  # largest accepted size of a measured number
    delay: int  # delay of the commands in control periods
    # growth of rounding errors up to the hand-over, see `vectors.rounding_growth`; at least the growth of the gains
    rounding_growth: float
    default_gains: str | None  # see `mission.describe_default_gains`

    @property
    def stem(self) -> str:
        """The beginning of the names of its C files."""
        return f"ptsmc_{self.name}"


# public names of a controller: templates prefix them with ptsmc_ and PTSMC_, exported files with ptsmc_NAME_
_NAMES = "init|step|parameters|params|in|out|state|derived|real|status|(in|state|params)_from|(out|state|params)_to"
_CONSTANTS = "|".join([*STATUS, "SCENARIO", "(IN|OUT|STATE|PARAMS)_SIZE"])


def with_public_prefix(text: str, name: str) -> str:
    """Return a text with the controller's name in all public names, so that several controllers link together."""
    text = re.sub(rf"\bptsmc_(?=({_NAMES})\b(?!\.[ch]\b))", f"ptsmc_{name}_", text)
    return re.sub(rf"\bPTSMC_(?=({_CONSTANTS})\b)", f"PTSMC_{name.upper()}_", text)


def fill_template(file: str, **values: str | int) -> str:
    """Return a file of `files` with these values for ${name}; an empty value alone on a line removes the line."""
    text = (FILES / file).read_text(encoding="utf-8")
    for name, value in values.items():
        if value == "":
            text = re.sub(rf"^\$\{{{name}\}}\n", "", text, flags=re.MULTILINE)
    return Template(text).substitute(values)


def controller_texts(code: Code, info: ExportInfo) -> dict[str, str]:
    """Return the text of each file of a controller, by file name, except for README.md and tables of numbers."""
    stem = info.stem
    files = {f"{stem}.h": "controller.h", f"{stem}.c": "controller.c", f"{stem}_parameters.c": "parameters.c",
             f"{stem}_flat.h": "flat.h"} | PROGRAMS  # fmt: skip
    values = _common_values(code, info) | _check_values(code, info) | _step_values(code) | row_values(code, info)
    return {name: fill_template(file, **values) for name, file in files.items()}


def plant_texts(code: Code, info: ExportInfo) -> dict[str, str]:
    """Return the text of each file of a plant in C, by file name."""
    calls = code.calls
    values = _common_values(code, info) | calls | {
        "keep": "    now.derived = state->derived;" if code.derived else "",
        "usable": _conjunction([_check_call("all_finite", field, "in->") for field in _real_fields(code.inputs)]),
        "sound": _conjunction([_check_call("all_finite", field, "now.") for field in _real_fields(code.state)]),
        "unused": "" if code.derived or "(p" in calls["begin"] + calls["advance"] else "    (void)p;",
    }  # fmt: skip
    files = {f"{info.stem}.h": "plant.h", f"{info.stem}.c": "plant.c"}
    return {name: fill_template(file, **values) for name, file in files.items()}


def _common_values(code: Code, info: ExportInfo) -> dict[str, str]:
    """Return the template values of controllers and plants: origin, structs, functions, numbers of the parameters."""
    note = ("\n * If the attitude filter has run before the manoeuvre, set attitude and bias afterwards. Otherwise it "
            "starts\n * from the first sample of the star tracker.\n")  # fmt: skip
    copies = [replace(field, name=f"of_{field.name}", meaning="") for field in code.derivation_inputs]
    derived = struct_members([*code.derived, *copies])
    initial = {field.name: _initializer(code.values[field.name], field.kind) for field in code.parameters}
    called = "\n".join([*code.functions, code.derivation])
    declared = ["static void derive(const ptsmc_params *p, ptsmc_derived *d);\n"] if code.derived else []
    helpers = [helper for name, helper in HELPERS.items() if f"{name}(" in called]
    functions = "\n".join([*helpers, *declared, "\n\n".join(code.functions)])
    return {
        "name": info.name,
        "upper": info.name.upper(),
        "scenario": info.scenario,
        "checksum": info.checksum,
        "law": info.law,
        "params_members": struct_members(code.parameters),
        "in_members": struct_members(code.inputs),
        "out_members": struct_members(code.outputs),
        "state_members": struct_members(code.state),
        "derived_struct": fill_template("derived.h", derived_members=derived) if code.derived else "",
        "derived_member": "    ptsmc_derived derived;" if code.derived else "",
        "filter_note": note if info.has_filter else "",
        "parameter_values": "\n".join(f"    {value}, /* {name} */" for name, value in initial.items()),
        "head": fill_template("head.c", name=info.name, functions=functions).rstrip(),
        "derive": "    derive(p, &state->derived);" if code.derived else "",
        "derivation": f"\n{code.derivation}" if code.derived else "",  # at the end of the file, because it is long
    }


def struct_members(fields: Iterable[Field]) -> str:
    """Return the members of a struct, with the meaning of each."""
    lines = []
    for field in fields:
        size = "".join(f"[{n}]" for n in field.shape)
        text = f"    {c_type(field.kind).replace('real', 'ptsmc_real')} {field.name}{size};"
        meaning = escape_comment_marks(" ".join(field.meaning.split()))
        line = f"{text} /* {meaning} */" if meaning else text
        lines += [line] if len(line) <= 110 else [*format_comment(meaning, "    "), text]
    return "\n".join(lines)


def _initializer(value: np.ndarray, kind: str) -> str:
    """Return the C initializer of a number or an array, with braces for each row; kind: see `format_constant`."""
    if value.ndim == 0:
        return format_constant(value.item(), kind)
    return "{" + ", ".join(_initializer(row, kind) for row in value) + "}"


def _check_values(code: Code, info: ExportInfo) -> dict[str, str]:
    """Return the template values of the functions that check input, results and derived numbers."""
    names = {field.name for field in code.inputs}
    # sensors whose readings may be missing
    sensors = [field for field in _real_fields(code.inputs) if f"{field.name}_valid" in names]
    input_checks = ["isfinite(in->t)", "(!state->started || in->t > state->t)"]
    input_checks += [_check_call("within", field, "in->") for field in _real_fields(code.inputs)
               if field not in sensors and not field.name.endswith("_age")]  # fmt: skip
    limits_rotation = "attitude" in {field.name for field in code.state}
    input_checks += ["rotation(in->attitude)"] if "attitude" in names and not sensors else _attitude_conditions(sensors)
    input_checks += [f"(in->{field.name}_valid == 0 || isfinite(in->{field.name}_age))"
               for field in sensors if f"{field.name}_age" in names]  # fmt: skip
    input_checks += ["rotation(in->reference_q)"] if "reference_q" in names else []
    input_checks += ["turn < R(1)"] if limits_rotation else []
    result_checks = [_check_call("all_finite", field, "now->") for field in _real_fields(code.state)]
    result_checks += [_check_call("all_finite", field, "out->") for field in code.outputs]
    equal = [_check_call("same", field, "p->", "d->of_") for field in _real_fields(code.derivation_inputs)]
    integers = [field for field in code.derivation_inputs if field.kind != REAL]
    equal += [f"p->{element} == d->of_{element}" for field in integers for element in field.elements()]
    return {
        "largest": f"{info.largest_measurement:.0f}",
        "params": "const ptsmc_params *p, " if limits_rotation else "",
        "p": "p, " if limits_rotation else "",
        "rotation": fill_template("rotation.c").rstrip() + "\n" if limits_rotation else "",
        "turn": fill_template("turn.c").rstrip() if limits_rotation else "",
        "usable": _conjunction(input_checks),
        "sound": _conjunction(result_checks),
        "current": fill_template("current.c", same=_conjunction(equal)).rstrip() if code.derived else "",
    }


def _attitude_conditions(sensors: Sequence[Field]) -> list[str]:
    """Return the C conditions that an attitude is known, and that each valid reading of attitude sensors is usable."""
    if not sensors:
        return []
    star_trackers = [field for field in sensors if field.name.startswith(("attitude", "star_tracker_"))]
    attitude_is_known = ["rotation(state->attitude)", *(f"in->{field.name}_valid != 0" for field in star_trackers)]
    checks = [f"rotation(in->{field.name})" if field in star_trackers else _check_call("within", field, "in->")
              for field in sensors]  # fmt: skip
    readings = [f"(in->{field.name}_valid == 0 || {check})" for field, check in zip(sensors, checks, strict=True)]
    return [f"({' || '.join(attitude_is_known)})", *readings]


def _real_fields(fields: Iterable[Field]) -> list[Field]:
    """Return the fields with real numbers, in their order."""
    return [field for field in fields if field.kind == REAL]


def _check_call(function: str, field: Field, *owners: str) -> str:
    """Return a C call with the address of a field's first number in each of these structs, and the field's size."""
    addresses = ", ".join(f"&{owner}{field.name}{'[0]' * len(field.shape)}" for owner in owners)
    return f"{function}({addresses}, {field.size})"


def _conjunction(terms: Sequence[str]) -> str:
    """Return an expression that is true if all terms are true, one term a line."""
    return " &&\n        ".join(terms)


def _step_values(code: Code) -> dict[str, str]:
    """Return the template values of the statuses, and of the calls in `ptsmc_init` and `ptsmc_step`."""
    calls, lowest_distance = code.calls, format_constant(rollout.SINGULAR_DISTANCE, REAL)
    arguments = re.findall(r"\w+", " ".join(calls.values()))
    can_be_singular = any(field.name == "singularity_distance" for field in code.state)
    statuses = [f"    PTSMC_{name} = {k}, /* {meaning} */" for k, (name, meaning) in enumerate(STATUS.items())]
    derive_again = "    if (!current(p, &state->derived)) {\n        derive(p, &state->derived);\n    }"
    singular = (f"    now.tracking = now.singularity_distance >= {lowest_distance};\n"
                "    if (!now.tracking) {\n        status = PTSMC_SINGULAR;\n    }")  # fmt: skip
    saturated = f"    if ({calls.get('act')} && status == PTSMC_OK) {{\n        status = PTSMC_SATURATED;\n    }}"
    return calls | {
        "statuses": "\n".join(statuses),
        "derive_again": derive_again if code.derived else "",
        "begin": calls["begin"].replace("&now", "state"),
        "unused": "" if code.derived or "(p" in calls["begin"] else "    (void)p;",
        "time": "    const real t = (real)in->t;" if "t" in arguments else "",
        "tracking": "    const int tracking = state->tracking;" if "tracking" in arguments else "",
        "act": saturated if "act" in calls else "",
        "regularity": singular if can_be_singular else "    now.tracking = 1;",
    }


def row_values(code: Code, info: ExportInfo) -> dict[str, str | int]:
    """Return the template values of the flat header, and of the programs that read rows of vectors.csv."""
    columns = code.columns
    all_fields = (*code.inputs, *code.state, *code.outputs, *code.parameters)
    c_types = {field.name: c_type(field.kind).replace("real", "ptsmc_real") for field in all_fields}
    c_types |= {"t": "double", "started": "int", "tracking": "int"}

    def type_of(column: str) -> str:
        return c_types[column.removeprefix("last.").partition("[")[0]]

    compared_columns = [f"{struct}.{column}" for struct in ("out", "state") for column in columns[struct]]
    groups = {group: k for k, group in enumerate(dict.fromkeys(map(_tolerance_group, compared_columns)))}
    flag_indices = [k for k, column in enumerate(columns["in"]) if type_of(column) not in ("double", "ptsmc_real")]
    reads = {f"{key}_from": "\n".join(f"    x->{name} = ({type_of(name)})v[{k}];" for k, name in enumerate(names))
             for key, names in columns.items() if key != "out"}  # fmt: skip
    writes = {f"{key}_to": "\n".join(f"    v[{k}] = (double)x->{name};" for k, name in enumerate(names))
              for key, names in columns.items() if key != "in"}  # fmt: skip
    return {
        **{f"{key}_size": len(names) for key, names in columns.items()},
        **reads,
        **writes,
        "compared": "\n".join(f'    {{"{name}", {groups[_tolerance_group(name)]}}},' for name in compared_columns),
        "flags": "\n".join(f"        v[{k}] = (double)(bits() % 2); /* a flag */" for k in flag_indices),
        "rounding_growth": repr(info.rounding_growth),
    }


def _tolerance_group(column: str) -> str:
    """Return the group of a column of vectors.csv. Rounding errors are relative to the largest number of a group."""
    name = column.partition(".")[2].removeprefix("last.").partition("[")[0]
    return TORQUES[0] if name.startswith(TORQUES) else RATES[0] if name in RATES else name


def format_counts(by_operation: Mapping[str, int]) -> str:
    """Return the largest number of operations of a function, by kind, such as "3 sums, 2 products".

    Args:
        by_operation: number of nodes by their operation, such as "add". Several operations form a kind.
    """
    kinds = {"sums": "add sub neg", "products": "mul", "quotients": "div", "roots": "sqrt cbrt",
             "comparisons and choices": "lt le gt ge eq ne and or not select max min abs sign convert entry isfinite "
             "floor rint"}  # fmt: skip
    counts = {kind: sum(by_operation.get(op, 0) for op in operations.split()) for kind, operations in kinds.items()}
    counts["elementary functions"] = sum(by_operation.values()) - sum(counts.values())
    return ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)


def stack_bytes(code: Code) -> int:
    """Return an upper bound on the stack of a step in double [byte], if each variable has its own memory."""
    stored = (*code.state, *code.outputs, *code.outputs, *code.derived, *code.derivation_inputs)
    field_bytes = sum(field.size * (8 if field.kind == REAL else 4) for field in stored)
    return math.ceil((field_bytes + 8 * code.variables + 256) / 16) * 16


def readme(code: Code, info: ExportInfo) -> str:
    """Return the text of README.md: interface, cost, parameters, linking."""
    counts = format_counts(code.derivation_counts)
    gains = f"\n*Default gains*: {info.default_gains}. `ptsmc tune` searches for better gains."
    periods = f"{info.delay} control period{'s' if info.delay != 1 else ''}"
    return fill_template(
        "README.md",
        name=info.name,
        law=info.law + " with its observer" + (" and attitude filter" if info.has_filter else ""),
        scenario=info.scenario,
        checksum=info.checksum,
        gains=gains if info.default_gains else "",
        stages="\n".join(f"{k}. `{name}`: {text}" for k, (name, text) in enumerate(code.stage_descriptions.items(), 1)),
        inputs=_member_rows(code.inputs),
        outputs=_member_rows(code.outputs),
        statuses="\n".join(f"| `PTSMC_{name}` = {k} | {text} |" for k, (name, text) in enumerate(STATUS.items())),
        delay=fill_template("delay.md", delay=periods).rstrip() if info.delay else "",
        costs=format_counts(code.counts),
        passes=", and one pass of each loop with an unknown number of passes" if code.has_open_loop else "",
        deriving=f" After a change of parameters, and in `ptsmc_init`, there are {counts} more." if counts else "",
        stack=stack_bytes(code),
        derived=_derived_tables(code),
    )


def _derived_tables(code: Code) -> str:
    """Return tables of the derived numbers, and of the parameters that C cannot derive."""

    def table(heading: str, names: Iterable[str]) -> str:
        rows = (f"| `{name}` | {', '.join(f'`{other}`' for other in code.sources_of[name]) or 'constant'} |\n"
                for name in names)  # fmt: skip
        return f"| {heading} | derived from |\n|---|---|\n{''.join(rows)}"

    text = ""
    if code.derived:
        text += (
            "Some numbers are derived from the parameters: by `ptsmc_init`, and by `ptsmc_step` after a change of "
            f"parameters.\n\n{table('derived', [member.name for member in code.derived])}"
        )
    if code.underivable:
        reasons = " ".join(f"{reason}." for reason in dict.fromkeys(code.underivable.values()))
        text += (
            "\nThese parameters also depend on others, but C cannot derive them. Export again if the others change."
            f"\n\n{table('parameter', code.underivable)}\n{reasons}\n"
        )
    return text.rstrip()


def _member_rows(members: Iterable[Field]) -> str:
    """Return the rows of a Markdown table: name and meaning of each member."""
    return "\n".join(f"| `{member.name}` | {' '.join(member.meaning.split())} |" for member in members)
