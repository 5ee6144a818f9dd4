"""README.md of an exported controller."""

from collections.abc import Iterable, Mapping

from ptsmc_jax.onboard.fields import Field
from ptsmc_jax.onboard.generate import Code
from ptsmc_jax.onboard.templates import STATUS, ExportInfo, count_operations, fill_template, stack_bytes


def readme(code: Code, info: ExportInfo) -> str:
    """Return the text of README.md: interface, cost, parameters, linking."""
    counts = _format_counts(code.derivation_counts)
    return fill_template(
        "README.md",
        name=info.name,
        law=info.law + " with its observer" + (" and attitude filter" if info.has_filter else ""),
        scenario=info.scenario,
        checksum=info.checksum,
        stages="\n".join(f"{k}. `{name}`: {text}" for k, (name, text) in enumerate(code.stage_descriptions.items(), 1)),
        inputs=_member_rows(code.inputs),
        outputs=_member_rows(code.outputs),
        statuses="\n".join(f"| `PTSMC_{name}` = {k} | {text} |" for k, (name, text) in enumerate(STATUS.items())),
        delay=_delay_section(info) if info.delay else "",
        costs=_format_counts(code.counts),
        passes=", and one pass of each loop with an unknown number of passes" if code.has_open_loop else "",
        deriving=f" After a change of parameters, and in `ptsmc_init`, there are {counts} more." if counts else "",
        stack=stack_bytes(code),
        derived=_derived_tables(code),
    )


def _delay_section(info: ExportInfo) -> str:
    periods = f"{info.delay} control period{'s' if info.delay != 1 else ''}"
    return fill_template("delay.md", delay=periods).rstrip()


def _format_counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {kind}" for kind, n in count_operations(counts).items() if n)


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
    return "\n".join(f"| `{member.name}` | {' '.join(member.meaning.split())} |" for member in members)
