"""README.md of a controller's folder."""

from collections.abc import Mapping, Sequence

from ptsmc_jax.onboard.fields import Field
from ptsmc_jax.onboard.generate import Code
from ptsmc_jax.onboard.templates import STATUS, About, filled, operations, stack


def readme(code: Code, about: About) -> str:
    """What it is, what it takes, how it is linked."""
    deriving = _listed(code.deriving)
    several = "s" if about.delay != 1 else ""
    delay = (
        f"\n\nThe scenario has a delay of {about.delay} control period{several} between measuring and acting. "
        "`command` is what the law asks for now, `torque` and the wheels' torques are what acts from this sample on, "
        f"by the command of {about.delay} sample{several} ago. Send those where this program is to make the delay, "
        "and `command` where computer and bus make it."
    )
    if about.delay and about.wheels:
        delay += (
            " `command` does not contain the compensation of the wheels' momentum, w x A h. It is computed with the "
            "command from the same sample and takes the same delay. If your bus causes the delay, add it to `command` "
            "before you send it."
        )
    motors = " and `ArrayMotorTorqueMsg` (the torque on a wheel is minus `wheel_torque`)"
    return filled(
        "README.md",
        name=about.name,
        law=about.law + " with its observer" + (" and attitude filter" if about.filtered else ""),
        scenario=about.scenario,
        digest=about.digest,
        stages="\n".join(f"{k}. `{name}`: {said}" for k, (name, said) in enumerate(code.about.items(), 1)),
        inputs=_rows(code.inputs),
        outputs=_rows(code.outputs),
        statuses="\n".join(f"| `PTSMC_{key}` = {k} | {said} |" for k, (key, said) in enumerate(STATUS.items())),
        delay=delay if about.delay else "",
        costs=_listed(code.counts),
        passes=", and one pass of each loop whose passes are not known" if code.open else "",
        deriving=f" Where parameters have changed, and in `ptsmc_init`, {deriving} more." if deriving else "",
        stack=str(stack(code)),
        derived=_derived(code),
        motors=motors if about.wheels else "",
    )


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {what}" for what, n in operations(counts).items() if n)


def _derived(code: Code) -> str:
    """What follows from parameters, and what of that C leaves to the export."""

    def table(names: Sequence[str]) -> list[str]:
        return [f"| `{name}` | {', '.join(f'`{other}`' for other in code.follows[name]) or 'constant'} |"
                for name in names]  # fmt: skip

    said: list[str] = []
    if code.derived:
        said += ["What follows from them is no parameter: `ptsmc_init` derives it as the library does, and "
                 "`ptsmc_step` again where one of the parameters has changed.", "", "| derived | from |", "|---|---|",
                 *table([made.name for made in code.derived])]  # fmt: skip
    if code.fixed:
        said += ["", "These follow from others, too, but C cannot derive them: they are those of the scenario, and "
                 "where the others change, export again.", "", "| parameter | from |", "|---|---|",
                 *table(list(code.fixed)), "", *(f"{why}." for why in dict.fromkeys(code.fixed.values()))]  # fmt: skip
    return "\n".join(said)


def _rows(members: Sequence[Field]) -> str:
    return "\n".join(f"| `{made.name}` | {' '.join(made.about.split())} |" for made in members)
