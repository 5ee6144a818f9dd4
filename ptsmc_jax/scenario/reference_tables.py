"""Where a run starts, and what it is to follow: tables of a scenario file, with their pace and what they are made into.

A reference is its physics in `signals.references`, a table here, and a row in `REFERENCES`.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import numpy as np

from ptsmc_jax.scenario import attitude_keys
from ptsmc_jax.scenario.attitude_keys import Attitude
from ptsmc_jax.scenario.own import Code, Own, build, fastest
from ptsmc_jax.scenario.values import ABSENT, Four, Kinds, ResolvedPositive, ResolvedThree, Scaled, Three


class Initial(Attitude, frozen=True):
    """Where the spacecraft starts: one attitude key and the body rate.

    Attributes:
        rate: body rate at t = 0, body axes [rad/s]
    """

    rate: Three = (0.0, 0.0, 0.0)


class ReferenceTable(Attitude, frozen=True):
    """What a spacecraft is to follow."""

    def frequencies(self) -> dict[str, float]:
        """How fast it turns and changes [rad/s], by the key that says so."""
        return {}

    def check(self) -> None:
        """Raise ScenarioError where its keys ask for no attitude."""
        attitude_keys.quaternion(self, "reference")

    def build(self) -> Any:
        """A part of `signals.references`."""
        raise NotImplementedError

    def _start(self) -> Any:
        from ptsmc_jax.numerics.pytrees import vector

        return vector(attitude_keys.quaternion(self, "reference"))


class FixedReference(ReferenceTable, frozen=True):
    """An attitude to be held."""

    kind: Literal["fixed"] = "fixed"

    def build(self) -> Any:
        """`references.Fixed`."""
        from ptsmc_jax.signals.references import Fixed

        return Fixed(self._start())


class SpinReference(ReferenceTable, frozen=True):
    """The attitude at t = 0, turning from then on at a constant body rate.

    Attributes:
        rate: of the reference, its own axes [rad/s]
    """

    kind: Literal["spin"] = "spin"
    rate: Three = (0.0, 0.0, 0.0)

    def frequencies(self) -> dict[str, float]:
        """Its rate."""
        return {"reference.rate": float(np.linalg.norm(self.rate))}

    def build(self) -> Any:
        """`references.Spin`."""
        from ptsmc_jax.numerics.pytrees import vector
        from ptsmc_jax.signals.references import Spin

        return Spin(self._start(), vector(self.rate))


class SinusoidReference(ReferenceTable, frozen=True):
    """On top of the attitude, the rotation vector amplitude sin(frequency t + phase), axis by axis.

    Attributes:
        amplitude: of the rotation vector, per axis [rad]
        frequency: per axis; default: 0.1 each, scaled to the mission [rad/s]
        phase: per axis [rad]
    """

    kind: Literal["sinusoid"] = "sinusoid"
    amplitude: Three = (0.1, 0.1, 0.1)
    frequency: ResolvedThree = ABSENT
    scaled: ClassVar[Mapping[str, Scaled]] = {"frequency": Scaled((0.1, 0.1, 0.1), time=-1)}
    phase: Three = (0.0, 0.0, 0.0)

    def frequencies(self) -> dict[str, float]:
        """Its largest rate, and the fastest axis."""
        turning = float(np.linalg.norm(np.multiply(self.amplitude, self.frequency)))
        return {"reference.frequency": turning + float(np.max(np.abs(self.frequency)))}

    def build(self) -> Any:
        """`references.Swing`."""
        from ptsmc_jax.numerics.pytrees import vector
        from ptsmc_jax.signals.references import Swing

        return Swing(self._start(), *(vector(value) for value in (self.amplitude, self.frequency, self.phase)))


class SlewReference(ReferenceTable, frozen=True):
    """From the attitude, at rest, to another one, at rest, about one axis.

    Attributes:
        to_quat_xyzw: the attitude at the end, unit quaternion, scalar last
        duration: how long it takes; default: 30, scaled to the mission [s]
        way: the short way, or the long way round
    """

    kind: Literal["slew"] = "slew"
    to_quat_xyzw: Four = (0.0, 0.0, 0.0, 1.0)
    duration: ResolvedPositive = ABSENT
    scaled: ClassVar[Mapping[str, Scaled]] = {"duration": Scaled(30.0, time=1)}
    way: Literal["short", "long"] = "short"

    def turn(self) -> np.ndarray:
        """Rotation vector from its attitude to `to_quat_xyzw`, the short way or the long way round (3,) [rad]."""
        from scipy.spatial.transform import Rotation

        end = attitude_keys.unit("reference.to_quat_xyzw", self.to_quat_xyzw)
        short = (
            Rotation.from_quat(attitude_keys.quaternion(self, "reference")).inv() * Rotation.from_quat(end)
        ).as_rotvec()
        angle = np.linalg.norm(short)
        return short * (1.0 - 2.0 * np.pi / angle) if self.way == "long" and angle > 0.0 else short

    def frequencies(self) -> dict[str, float]:
        """The largest rate of the quintic, and the motion's own time."""
        turning = 1.875 * float(np.linalg.norm(self.turn()))
        return {"reference.duration": (turning + 2.0 * np.pi) / self.duration}

    def check(self) -> None:
        """Both attitudes must be given as unit quaternions can be."""
        super().check()
        attitude_keys.unit("reference.to_quat_xyzw", self.to_quat_xyzw)

    def build(self) -> Any:
        """`references.Slew`."""
        from ptsmc_jax.numerics.pytrees import vector
        from ptsmc_jax.signals.references import Slew

        return Slew(self._start(), vector(self.turn()), vector(self.duration))


class OwnReference(Own, ReferenceTable, kw_only=True, frozen=True):
    """An attitude of one's own, a class derived from ptsmc_jax.Reference; its fields are further keys."""

    kind: Literal["own"] = "own"
    code: Code
    needs: ClassVar[tuple[str, ...]] = ("attitude",)

    @classmethod
    def base(cls) -> type:
        """`signals.references.Reference`."""
        from ptsmc_jax.signals.references import Reference

        return Reference

    def frequencies(self) -> dict[str, float]:
        """What its method `fastest` says."""
        return {"reference.code": fastest(self, "reference", self.build())}

    def build(self) -> Any:
        """What the code names."""
        return build(self, q=self._start())


# by kind, the default first
REFERENCES: Kinds = {
    "fixed": FixedReference,
    "spin": SpinReference,
    "sinusoid": SinusoidReference,
    "slew": SlewReference,
    "own": OwnReference,
}
