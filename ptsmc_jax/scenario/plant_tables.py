"""The tables of a scenario file that say what flies: the kind of plant, and the spacecraft's body."""

from typing import Annotated, Any, Literal

from msgspec import Meta

from ptsmc_jax.scenario.values import Inertia, Numbers, Table


class SpacecraftPlant(Table, frozen=True):
    """A rigid spacecraft, by quaternion and body rate; its body is [spacecraft], its start [initial]."""

    kind: Literal["spacecraft"] = "spacecraft"


class ChainPlant(Table, frozen=True):
    """An integrator chain x_i' = x_(i+1), x_n' = u + d, equation (35): the paper's Section 3.

    Attributes:
        order: number n of states; as many as x0 has where it is absent
        x0: initial state x_1 to x_n
    """

    kind: Literal["chain"] = "chain"
    order: Annotated[int, Meta(ge=2, le=20, description="a whole number from 2 to 20")] = 2
    x0: Numbers = (5.0, 3.0)


class SystemPlant(Table, frozen=True):
    """A second-order system of one's own, x_1' = F, x_2' = H + G u + D d, equation (25), in a Python file.

    A scenario that names one is a program: flying it runs that file, which can do what you can. Read it before you fly
    somebody else's; results that name one are flown with --trust only.

    Attributes:
        system: where it stands, "FILE.py:NAME" with the file beside the scenario, or "package.module:NAME"; needed
        x0: initial state, x_1 and then x_2
    """

    kind: Literal["system"] = "system"
    system: Annotated[Any, Meta(description='"FILE.py:NAME", a system made with plants.system')] = None
    x0: Numbers = (1.0, 0.0)


class Spacecraft(Table, frozen=True):
    """The rigid body.

    Attributes:
        inertia: three principal moments, or a full symmetric 3x3 tensor; with [wheels] of the whole spacecraft less
            each wheel's spin inertia about its axis [kg m^2]
        true_inertia: of the body that flies; default: inertia, which the law knows [kg m^2]
    """

    inertia: Inertia = (10.0, 12.0, 14.0)
    true_inertia: Inertia | None = None
