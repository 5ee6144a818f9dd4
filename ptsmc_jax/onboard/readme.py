"""README.md of a controller's folder."""

from collections.abc import Sequence

from ptsmc_jax.onboard.fields import Field
from ptsmc_jax.onboard.generate import Code
from ptsmc_jax.onboard.templates import STATUS, About, filled, operations, stack

DERIVED = {
    "observer_matrix": "(I - e^(-A h)) / h, A = diag(l) J^-1, of the observer's gain l, `inertia` and `period`",
    "bound_rate": "with the other `bound_` fields K2(t), which the law switches against, of the observer's gain, "
    "`inertia` and the bounds on the disturbance",
    "inertia_inverse": "the inverse of `inertia`",
    "filter_attitude_gain": "1 - p^2, p = e^(-bandwidth interval), interval that between star tracker samples",
    "filter_bias_gain": "(1 - p)^2 / interval",
    "actuators_wheels_allocation": "the pseudo-inverse of `actuators_wheels_axes`",
}


def readme(code: Code, about: About) -> str:
    """What it is, what it takes, how it is linked."""
    names = [made.name for made in code.parameters]
    derived = [f"| `{name}` | {said} |" for name, said in DERIVED.items() if name in names]
    follow = ["These follow from others, and change with them:", "", "| field | is |", "|---|---|", *derived]
    delay = (
        f"\n\nThe scenario has a delay of {about.delay} control periods between measuring and acting. `command` is "
        "what the law asks for now, `torque` and the wheels' torques are what acts from this sample on, by the "
        f"command of {about.delay} samples ago. Send those where this program is to make the delay, and `command` "
        "where computer and bus make it."
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
        costs=", ".join(f"{n} {what}" for what, n in operations(code).items() if n),
        stack=str(stack(code)),
        derived="\n".join(follow) if derived else "",
        motors=motors if about.wheels else "",
    )


def _rows(members: Sequence[Field]) -> str:
    return "\n".join(f"| `{made.name}` | {' '.join(made.about.split())} |" for made in members)
