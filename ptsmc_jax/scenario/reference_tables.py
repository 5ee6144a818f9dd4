"""The tables [initial] and [reference] of scenario files of a spacecraft, with the references by kind in `REFERENCES`.

The numbers of a reference are declared in `signals.references`. Start with `ReferenceTable`.
"""

from typing import Annotated, Any, Literal

import numpy as np

from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.scenario import attitude_keys
from ptsmc_jax.scenario.attitude_keys import Attitude
from ptsmc_jax.scenario.custom import Custom, custom_kind, fastest
from ptsmc_jax.scenario.schema import PartTable, table
from ptsmc_jax.scenario.values import Four, Kinds, Meaning, Three
from ptsmc_jax.signals import references


class Initial(Attitude, frozen=True):
    """Initial state of the spacecraft: one attitude key and the body rate."""

    rate: Annotated[Three, Meaning("body rate at t = 0, body axes", "rad/s")] = (0.0, 0.0, 0.0)


class ReferenceTable(Attitude, PartTable, frozen=True):
    """An attitude that a spacecraft is to follow."""

    def frequencies(self) -> dict[str, float]:
        """Return the angular frequency of the reference [rad/s], by the key that determines it."""
        part = self.build() if isinstance(self, Custom) else self
        return {f"reference.{self.made.paced_by}": fastest(self, "reference", part)}

    def check(self) -> None:
        """Raise ScenarioError if the attitude is not valid."""
        attitude_keys.quaternion(self, "reference")

    def build(self) -> Any:
        """Return the part of `signals.references`."""
        return self.part(q=vector(attitude_keys.quaternion(self, "reference")))


class SlewTable(ReferenceTable, frozen=True):
    """A turn to another attitude."""

    to_quat_xyzw: Annotated[Four, Meaning("the attitude at the end, unit quaternion, scalar last")] = (
        0.0,
        0.0,
        0.0,
        1.0,
    )
    way: Annotated[Literal["short", "long"], Meaning("rotate by the smaller or by the larger angle")] = "short"

    @property
    def turn(self) -> np.ndarray:
        """Rotation vector (3,) [rad] from the initial attitude to `to_quat_xyzw`, by the short or the long way."""
        from scipy.spatial.transform import Rotation

        start = Rotation.from_quat(attitude_keys.quaternion(self, "reference"))
        end = Rotation.from_quat(attitude_keys.unit("reference.to_quat_xyzw", self.to_quat_xyzw))
        short = (start.inv() * end).as_rotvec()
        angle = np.linalg.norm(short)
        return short * (1.0 - 2.0 * np.pi / angle) if self.way == "long" and angle > 0.0 else short

    def check(self) -> None:
        """Raise ScenarioError if one of the two attitudes is not valid."""
        super().check()
        attitude_keys.unit("reference.to_quat_xyzw", self.to_quat_xyzw)


# by kind, the default first
REFERENCES: Kinds = {
    "fixed": table(ReferenceTable, references.Fixed, "fixed"),
    "spin": table(ReferenceTable, references.Spin, "spin"),
    "sinusoid": table(ReferenceTable, references.Swing, "sinusoid"),
    "slew": table(SlewTable, references.Slew, "slew"),
    "custom": custom_kind(
        ReferenceTable, references.Reference, ("attitude",),
        "A custom reference, a class derived from ptsmc_jax.Reference; its fields are further keys.",
    ),
}  # fmt: skip
