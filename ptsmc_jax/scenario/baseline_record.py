"""What the laws of a scenario file to compare with share: their table, and the usual bounds of their gains."""

from typing import Any

from ptsmc_jax.scenario.errors import show, wrong
from ptsmc_jax.scenario.gain_record import GainBounds
from ptsmc_jax.scenario.law_record import LawTable
from ptsmc_jax.scenario.values import NotNegative, Positive


class BaselineTable(LawTable, frozen=True):
    """What the laws to compare with have besides their gains; they fly in the sampled loop only.

    Attributes:
        t_f: when the law is judged [s]
        disturbance_rate_bound: c of Assumption 1, on each component of d'; default: by [disturbance] as drawn [N m/s]
        disturbance_bound: K of Assumption 1, on each component of d, used without an observer; default: by
            [disturbance] as drawn [N m]
        initial_estimate_error: bound on the observer's error at t = 0 [N m]
    """

    t_f: Positive = 30.0
    disturbance_rate_bound: NotNegative | None = None
    disturbance_bound: NotNegative | None = None
    initial_estimate_error: NotNegative = 0.0

    def check(self, scenario: Any) -> None:
        """These laws are of second order, and so must the plant be."""
        order = scenario.order
        if order != 2:
            raise wrong("plant.order", order, f"2 with controller.kind = {show(self.kind)}, a law of second order")  # pyright: ignore[reportAttributeAccessIssue]


def over_t_f(low: float, high: float, power: int = 1) -> GainBounds:
    """Bounds low / t_f^power and high / t_f^power: a law that is judged at t_f needs rates of that order.

    A spring k_p = 2 / t_f^2 turns through about 1 rad of its oscillation until t_f, one of 2000 / t_f^2 through 30; a
    damping of 0.3 / t_f leaves three quarters of a rate until t_f, one of 100 / t_f takes it away within t_f / 100.
    """
    return GainBounds(lambda choice: (low / choice.t_f**power, high / choice.t_f**power))


def until_sampling(low: float, high: float, power: int = 1) -> GainBounds:
    """Bounds low / t_f^power and high / h^power, h the period: to where samples come too seldom for a larger gain."""
    return GainBounds(
        lambda choice: (low / choice.t_f**power, high / choice.scenario.loop.period**power),
        above="so large that the sampled loop comes near its border of stability",
    )
