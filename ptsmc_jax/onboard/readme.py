"""README.md of an exported controller."""

from collections.abc import Iterable, Mapping

from ptsmc_jax.onboard.fields import Field
from ptsmc_jax.onboard.generate import Code
from ptsmc_jax.onboard.templates import STATUS, About, filled, operations, stack


def readme(code: Code, about: About) -> str:
    """Return the text of README.md: interface, cost, parameters, linking."""
    deriving = _counted(code.deriving)
    return filled(
        "README.md",
        name=about.name,
        law=about.law + " with its observer" + (" and attitude filter" if about.filtered else ""),
        scenario=about.scenario,
        checksum=about.checksum,
        stages="\n".join(f"{k}. `{name}`: {text}" for k, (name, text) in enumerate(code.about.items(), 1)),
        inputs=_rows(code.inputs),
        outputs=_rows(code.outputs),
        statuses="\n".join(f"| `PTSMC_{name}` = {k} | {text} |" for k, (name, text) in enumerate(STATUS.items())),
        delay=_delay(about) if about.delay else "",
        costs=_counted(code.counts),
        passes=", and one pass of each loop with an unknown number of passes" if code.open else "",
        deriving=f" After a change of parameters, and in `ptsmc_init`, there are {deriving} more." if deriving else "",
        stack=stack(code),
        derived=_derived(code),
    )


def _delay(about: About) -> str:
    periods = f"{about.delay} control period{'s' if about.delay != 1 else ''}"
    return filled("delay.md", delay=periods).rstrip()


def _counted(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {kind}" for kind, n in operations(counts).items() if n)


def _derived(code: Code) -> str:
    """Return tables of the derived numbers, and of the parameters that C cannot derive."""

    def table(heading: str, names: Iterable[str]) -> str:
        rows = (f"| `{name}` | {', '.join(f'`{other}`' for other in code.follows[name]) or 'constant'} |\n"
                for name in names)  # fmt: skip
        return f"| {heading} | derived from |\n|---|---|\n{''.join(rows)}"

    text = ""
    if code.derived:
        text += (
            "Some numbers are derived from the parameters: by `ptsmc_init`, and by `ptsmc_step` after a change of "
            f"parameters.\n\n{table('derived', [made.name for made in code.derived])}"
        )
    if code.fixed:
        reasons = " ".join(f"{why}." for why in dict.fromkeys(code.fixed.values()))
        text += (
            "\nThese parameters also depend on others, but C cannot derive them. Export again if the others change."
            f"\n\n{table('parameter', code.fixed)}\n{reasons}\n"
        )
    return text.rstrip()


def _rows(members: Iterable[Field]) -> str:
    return "\n".join(f"| `{made.name}` | {' '.join(made.about.split())} |" for made in members)
