"""The tables of a scenario file that name a filter of the command: hardware.command_filter."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from ptsmc_jax.scenario.gain_record import Allowed, Choice, GainBounds
from ptsmc_jax.scenario.values import Kinds, Positive, Table


def _usual_corner(choice: Choice) -> tuple[float, float]:
    """A decade either way, but half of the Nyquist frequency."""
    corner = choice.scenario.devices.command_filter.corner
    return 0.1 * corner, min(10.0 * corner, max(0.5 * math.pi / choice.scenario.loop.period, 0.5 * corner))


def _allowed_corner(choice: Choice) -> Allowed:
    return Allowed(0.0, math.pi / choice.scenario.loop.period)


class CommandFilter(Table, frozen=True):
    """A filter between the law and the actuators, in the flight computer.

    Attributes:
        corner: its corner frequency, which tuning may move as command_corner [rad/s]
    """

    corner: Positive = 1.0
    prefix: ClassVar[str] = "command_"
    gains: ClassVar[Mapping[str, GainBounds]] = {"command_corner": GainBounds(_usual_corner, _allowed_corner)}

    def physics(self) -> Any:
        """A class of `devices.command_filter`."""
        raise NotImplementedError

    def dead_time(self) -> float:
        """Return its delay at low frequencies, the derivative of its phase [s]."""
        raise NotImplementedError

    def build(self) -> Any:
        """The filter, with the keys as its numbers."""
        from ptsmc_jax.numerics.pytrees import vector

        return self.physics()(*(vector(getattr(self, key)) for key in self.__struct_fields__ if key != "kind"))


class FirstOrderFilter(CommandFilter, frozen=True):
    """Roll-off of first order, W / (s + W)."""

    kind: Literal["first_order"] = "first_order"

    def physics(self) -> Any:
        """`command_filter.FirstOrder`."""
        from ptsmc_jax.devices.command_filter import FirstOrder as Physics

        return Physics

    def dead_time(self) -> float:
        """Return its delay at low frequencies, the derivative of its phase [s]."""
        return 1.0 / self.corner


class SecondOrderFilter(CommandFilter, frozen=True):
    """Roll-off of second order, W^2 / (s^2 + 2 z W s + W^2).

    Attributes:
        damping: z, its damping ratio
    """

    kind: Literal["second_order"] = "second_order"
    damping: Positive = 0.7

    def physics(self) -> Any:
        """`command_filter.SecondOrder`."""
        from ptsmc_jax.devices.command_filter import SecondOrder as Physics

        return Physics

    def dead_time(self) -> float:
        """Return its delay at low frequencies, the derivative of its phase [s]."""
        return 2.0 * self.damping / self.corner


class NotchFilter(CommandFilter, frozen=True):
    """Notch, (s^2 + W^2) / (s^2 + 2 z W s + W^2).

    Attributes:
        damping: z, how wide it is
    """

    kind: Literal["notch"] = "notch"
    damping: Positive = 0.5

    def physics(self) -> Any:
        """`command_filter.Notch`."""
        from ptsmc_jax.devices.command_filter import Notch as Physics

        return Physics

    def dead_time(self) -> float:
        """Return its delay at low frequencies, the derivative of its phase [s]."""
        return 2.0 * self.damping / self.corner


COMMAND_FILTERS: Kinds = {"first_order": FirstOrderFilter, "second_order": SecondOrderFilter, "notch": NotchFilter}
