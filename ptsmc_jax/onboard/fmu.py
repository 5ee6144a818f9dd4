"""Functional mock-up units (FMI 2.0 and 3.0, co-simulation) of an exported controller or plant.

Read `write_fmu` first.
"""

import hashlib
import math
import platform
import re
import sys
import tempfile
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from ptsmc_jax import units
from ptsmc_jax.onboard import templates
from ptsmc_jax.onboard.expressions import REAL
from ptsmc_jax.onboard.fields import Field
from ptsmc_jax.onboard.generate import Code
from ptsmc_jax.onboard.library import compile_library
from ptsmc_jax.onboard.templates import STATUS, ExportInfo
from ptsmc_jax.scenario.errors import ScenarioError

VERSIONS = (2, 3)
TYPES = {2: {"r": "Real", "i": "Integer", "u": "Integer"}, 3: {"r": "Float64", "i": "Int32", "u": "UInt32"}}
# parts of the state that a user may set before the first sample
FILTER_STATE = ("attitude", "bias", "gyro", "past_attitude", "past_rate")


class Variable(NamedTuple):
    """A variable of an FMU. Its value reference is its index in the list of all variables."""

    name: str
    kind: str  # "r" real, "i" integer or "u" unsigned integer
    role: str  # "i" input, "o" output, "f" fixed parameter, "t" tunable parameter or "c" constant
    start: float
    meaning: str

    @property
    def unit(self) -> tuple[str, dict[str, int]]:
        """The unit in brackets in `meaning`, see `parse_unit`; an empty name if there is no or more than one unit."""
        found = re.findall(r"\[([^\]]+)\]", self.meaning)
        return parse_unit(found[0]) if len(found) == 1 and self.kind == "r" else ("", {})


class Model(NamedTuple):
    """A program in C as the model of an FMU."""

    code: Code
    info: ExportInfo  # properties; `name` is the name of the C files
    title: str  # such as "controller of first_flight.toml"
    texts: dict[str, str]  # text of each C file, by file name
    t_end: float  # end of the run [s]
    filter_state: Sequence[Field] = ()  # parts of the state that can be set before the first sample
    plant: bool = False  # whether the program is the plant: it samples at the end of a step, and parameters are fixed

    @property
    def period(self) -> float:
        """The control period [s]."""
        return float(self.code.values["period"])


def parse_unit(text: str) -> tuple[str, dict[str, int]]:
    """Return name and exponents of the base units of a unit such as "N m/s^2", which has the name "N.m/s2".

    The name is empty if the text is not a product of integer powers of rad, s, m, kg and N.
    """
    value, powers = units.parse(text) or (0, {})
    if value != 1 or "dB" in powers or not all(power.is_integer() for power in powers.values()):
        return "", {}
    name = "/".join(".".join(part.split()) for part in text.replace("^", "").split("/"))
    return name, {base: int(power) for base, power in powers.items()}


def list_variables(model: Model) -> list[Variable]:
    """Return the variables of an FMU in the order of their value references."""
    code = model.code

    def make(
        fields: Iterable[Field], role: str, values: Mapping[str, np.ndarray | float], prefix: str = ""
    ) -> Iterable[Variable]:
        for field in fields:
            kind = {REAL: "r", "uint32_t": "u"}.get(field.kind, "i")
            start = np.broadcast_to(values.get(field.name, _default_start(field)), field.shape)
            for index in np.ndindex(*field.shape):
                suffix = f"[{','.join(str(k + 1) for k in index)}]" if index else ""
                name = f"{prefix}{field.name}{suffix}"
                yield Variable(name, kind, role, float(start[index]), _short_meaning(field.meaning))

    statuses = ", ".join(f"{k} {name.lower()}" for k, name in enumerate(STATUS))
    used_names = {field.name for field in (*code.inputs, *code.outputs)}
    zeros = {field.name: 0.0 for field in (*model.filter_state, *code.outputs)}
    role, period_role = ("f", "c") if model.plant else ("t", "f")
    return [
        *make(code.inputs, "i", {}),
        *make(code.outputs, "o", zeros),
        Variable("status", "i", "o", 0.0, f"status of the last sample: {statuses}"),
        *make(model.filter_state, "f", zeros, "initial_"),
        *(variable for field in code.parameters
          for variable in make([field], period_role if field.name == "period" else role, code.values,
                             "nominal_" if field.name in used_names else "")),
    ]  # fmt: skip


def _short_meaning(comment: str) -> str:
    """Return the meaning of a field without its shape and its default value in a scenario."""
    text = re.sub(r"^\([^)]*,[^)]*\)\s*", "", " ".join(comment.split()))
    return re.sub(r"; default: [^[]*(?=\[)", " ", text)


def _default_start(field: Field) -> list[float] | float:
    """Return the start value of an input: the identity for a quaternion, otherwise zero.

    A field of shape (4,) is a quaternion, unless its name has "wheel".
    """
    return [0.0, 0.0, 0.0, 1.0] if field.shape == (4,) and "wheel" not in field.name else 0.0


def source_texts(model: Model, version: int) -> tuple[dict[str, str], str]:
    """Return the C files of an FMU (texts by file name) and its instantiation token, a checksum of the files."""
    code, listed = model.code, list_variables(model)
    row_texts = templates.row_values(code, model.info)
    elements = [element for field in model.filter_state for element in field.elements()]
    lines = [f"    m->state.{element} = (ptsmc_real)m->v[FIRST_START + {k}];" for k, element in enumerate(elements)]
    first_parameter = len(listed) - len(code.columns["params"])
    values = {
        "name": model.info.name,
        "inputs": len(code.columns["in"]) - 1,
        "outputs": len(code.columns["out"]),
        "parameters": len(code.columns["params"]),
        "starts": len(elements),
        "at_end": int(model.plant),
        "kinds": _c_strings(variable.kind for variable in listed),
        # constants get the role of outputs, because neither can be set
        "roles": _c_strings(variable.role.replace("c", "o") for variable in listed),
        "values": "\n".join(f"    {_c_number(variable.start)}," for variable in listed),
        "filter": "\n".join(lines),
        "period": first_parameter + code.columns["params"].index("period"),
        **{name: row_texts[name] for name in ("in_from", "params_from", "out_to")},
    }
    texts = {f"fmi{version}.c": templates.fill_template(f"fmi{version}.c"), **model.texts}
    header = templates.fill_template("fmu.h", token="", **values)
    token = hashlib.sha256("".join([*texts.values(), header]).encode()).hexdigest()
    texts["fmu.h"] = templates.fill_template("fmu.h", token=token, **values)
    return {name: templates.with_public_prefix(text, model.info.name) for name, text in texts.items()}, token


def _c_strings(letters: Iterable[str]) -> str:
    """Return a C string of letters, 100 on a line."""
    text = "".join(letters)
    return "\n".join(f'    "{text[k : k + 100]}"' for k in range(0, len(text), 100))


def _c_number(value: float) -> str:
    """Return a real number as C writes it."""
    return repr(value) if math.isfinite(value) else "INFINITY" if value > 0.0 else "-INFINITY"


def model_description(model: Model, version: int, token: str, c_files: Sequence[str]) -> str:
    """Return the text of modelDescription.xml.

    Args:
        model: the model.
        version: version of FMI.
        token: instantiation token, which the binary compares with the token that a simulator passes.
        c_files: names of the C files that are compiled.
    """
    listed = list_variables(model)
    units = dict(variable.unit for variable in listed if variable.unit[0])
    exponents = {
        name: "".join(f' {base}="{power}"' for base, power in exponents.items()) for name, exponents in units.items()
    }
    outputs = [k for k, variable in enumerate(listed) if variable.role == "o"]
    output_elements = '    <Output valueReference="{}"/>', '    <InitialUnknown valueReference="{}"/>'
    if version == 2:
        outputs = [k + 1 for k in outputs]
        output_elements = ('      <Unknown index="{}"/>',) * 2
    values = {
        "title": quoteattr(model.title),
        "token": token,
        "about": quoteattr(f"{model.title}, one sample every {model.period:g} s"),
        "identifier": model.info.stem,
        "sources": "\n".join(f'      <File name="{name}"/>' for name in c_files),
        "units": "\n".join(f'    <Unit name="{name}"><BaseUnit{text}/></Unit>' for name, text in exponents.items()),
        "stop": f"{model.t_end:g}",
        "step": repr(model.period),
        "variables": "\n".join(_variable_element(variable, k, version) for k, variable in enumerate(listed)),
        "outputs": "\n".join(output_elements[0].format(k) for k in outputs),
        "unknowns": "\n".join(output_elements[1].format(k) for k in outputs),
    }
    if version == 3:
        time = f'    <Float64 name="time" valueReference="{len(listed)}" causality="independent" unit="s"/>'
        values["variables"] += "\n" + time
    return templates.fill_template(f"fmi{version}.xml", **values)


def _variable_element(variable: Variable, reference: int, version: int) -> str:
    """Return the XML element of a variable."""
    causality = {"i": "input", "o": "output", "c": "local"}.get(variable.role, "parameter")
    variability = {"f": "fixed", "t": "tunable", "c": "constant"}.get(variable.role)
    variability = variability or ("continuous" if variable.kind == "r" else "discrete")
    attributes = f'name="{variable.name}" valueReference="{reference}" causality="{causality}"'
    attributes += f' variability="{variability}"'
    attributes += f" description={quoteattr(variable.meaning)}" if variable.meaning else ""
    values = f' unit="{variable.unit[0]}"' if variable.unit[0] else ""
    if variable.role != "o":
        values += f' start="{variable.start!r}"' if variable.kind == "r" else f' start="{int(variable.start)}"'
    if version == 3:
        return f"    <{TYPES[3][variable.kind]} {attributes}{values}/>"
    return f"    <ScalarVariable {attributes}><{TYPES[2][variable.kind]}{values}/></ScalarVariable>"


def binary_path(name: str, version: int) -> str:
    """Return the path of the binary for this machine in an FMU."""
    system = {"darwin": "darwin", "win32": "windows"}.get(sys.platform, "linux")
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    folder = f"{machine}-{system}"
    if version == 2 and machine == "x86_64":
        folder = {"linux": "linux64", "windows": "win64", "darwin": "darwin64"}[system]
    suffix = {"linux": ".so", "windows": ".dll", "darwin": ".dylib"}[system]
    return f"binaries/{folder}/{name}{suffix}"


def write_fmu(file: Path, model: Model, version: int, *, binary: bool = True) -> None:
    """Write an FMU.

    Args:
        file: the new file.
        model: the model.
        version: version of FMI, 2 or 3.
        binary: whether to compile it for this machine; the sources are always in the file.

    Raises:
        ScenarioError: if there is no C compiler for the binary.
    """
    (texts, token), name = source_texts(model, version), model.info.stem
    c_files = [name for name in texts if name.endswith(".c")]
    content: dict[str, str | bytes] = {f"sources/{file}": text for file, text in texts.items()}
    content["modelDescription.xml"] = model_description(model, version, token, c_files)
    if version == 3:
        source_files = "\n".join(f'      <SourceFile name="{c_file}"/>' for c_file in c_files)
        description = templates.fill_template("build.xml", identifier=name, sources=source_files)
        content["sources/buildDescription.xml"] = description
    if binary:
        content[binary_path(name, version)] = compile_binary(texts, c_files)
    with zipfile.ZipFile(file, "w") as archive:
        for path, data in content.items():
            info = zipfile.ZipInfo(path, (1980, 1, 1, 0, 0, 0))  # fixed date: the same content gives the same file
            info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(info, data)


def compile_binary(texts: dict[str, str], c_files: Sequence[str]) -> bytes:
    """Return the shared library of these C files. Raises ScenarioError without a compiler, or if it fails."""
    with tempfile.TemporaryDirectory(prefix="ptsmc-") as build_folder:
        for name, text in texts.items():
            (Path(build_folder) / name).write_text(text, encoding="utf-8")
        error = compile_library("-fvisibility=hidden", *c_files, "-o", "binary", folder=Path(build_folder))
        if error:
            raise ScenarioError(f"the C code of the FMU does not compile: {error}")
        return (Path(build_folder) / "binary").read_bytes()
