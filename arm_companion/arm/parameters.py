"""What the mechanics need to know of an arm: segments of backbone and the tendons that bend them."""

import enum
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from arm_companion.errors import ConfigError
from arm_companion.geometry.arrays import Array, sealed

if TYPE_CHECKING:
    from arm_companion.config.schema import ArmConfig


class Guides(enum.Enum):
    """What leads a tendon along the backbone."""

    CONTINUOUS = "continuous"  # a guide everywhere: the tendon stays parallel to the backbone
    DISKS = "disks"  # real disks: straight chords in between


@dataclass(frozen=True)
class Segment:
    """One piece of backbone between two plates that end tendons.

    Attributes:
        L: length, m.
        r: radius of the tendons' pitch circle, m.
        disks: guide intervals, that is disks without the base plate and with the end disk; a part of a segment
            need not have a whole number.
        EI: bending stiffness, N m^2.
        GJ: torsional stiffness, N m^2.
        line_mass: backbone, spacer disks and tendons spread over the length, kg/m.
        end_mass: end disk, a point at the segment's end, kg.
    """

    L: float
    r: float
    disks: float
    EI: float
    GJ: float
    line_mass: float
    end_mass: float

    def __post_init__(self) -> None:
        _positive(L=self.L, r=self.r, disks=self.disks, EI=self.EI, GJ=self.GJ)
        _not_negative(line_mass=self.line_mass, end_mass=self.end_mass)


@dataclass(frozen=True)
class Tendon:
    """One cable from its motor to the disk where it ends.

    Attributes:
        angle: place on the pitch circle, about the base z axis from x, rad.
        k_T: force per stretch between motor and end disk, servo compliance in series, N/m.
        T0: tension in the straight, unloaded arm at zero pull, N.
        segment: index of the segment at whose end the tendon is tied; it runs through those before.
    """

    angle: float
    k_T: float
    T0: float
    segment: int = 0

    def __post_init__(self) -> None:
        _positive(k_T=self.k_T)
        _not_negative(T0=self.T0)


@dataclass(frozen=True)
class ArmParameters:
    """An arm: its segments from base to tip, and its tendons in the motors' order.

    Raises:
        ConfigError: when a tendon ends nowhere, or the tendons of a segment cannot bend it every way.
    """

    segments: tuple[Segment, ...]
    tendons: tuple[Tendon, ...]
    guides: Guides = Guides.DISKS

    def __post_init__(self) -> None:
        if not self.segments:
            raise ConfigError("an arm needs at least one segment")
        for k in range(len(self.segments)):
            angles = [t.angle for t in self.tendons if t.segment == k]
            if not _surrounds(angles):
                places = np.degrees(angles).tolist()
                raise ConfigError(f"tendons at {places} deg cannot bend segment {k} every way")
        if any(not 0 <= t.segment < len(self.segments) for t in self.tendons):
            raise ConfigError("a tendon ends at a segment that does not exist")

    @classmethod
    def of(cls, config: "ArmConfig", guides: Guides = Guides.DISKS) -> "ArmParameters":
        """From the configuration's [arm] section and the [[arm.segments]] beyond it.

        Backbone, tendons and spacer disks are spread evenly over each segment's length; its end disk is a point
        mass. A tendon's stiffness is E A over the length from pulley to end disk, with the servo's in series.
        """
        segments: list[Segment] = []
        tendons: list[Tendon] = []
        for k, part in enumerate(config.chain):
            rod, cable, mass = part.backbone, part.tendons, part.mass
            EI = rod.youngs_modulus_pa * math.pi * rod.diameter_m**4 / 64
            backbone_kg = mass.backbone_density_kg_m3 * math.pi * rod.diameter_m**2 / 4 * part.length_m
            spread_kg = backbone_kg + mass.tendons_kg + (part.disks - 1) * mass.disk_kg
            segment = Segment(
                L=part.length_m,
                r=part.pitch_radius_m,
                disks=part.disks,
                EI=EI,
                GJ=EI / (1 + rod.poisson_ratio),  # G = E / 2(1 + nu), J = 2 I for a round rod
                line_mass=spread_kg / part.length_m,
                end_mass=mass.end_disk_kg,
            )
            segments.append(segment)
            length = math.fsum(s.L for s in segments) + cable.routing_length_m
            EA_T = cable.youngs_modulus_pa * math.pi * cable.diameter_m**2 / 4
            k_T = 1 / (length / EA_T + 1 / cable.servo_stiffness_n_per_m)
            tendons += [Tendon(math.radians(angle), k_T, cable.pretension_n, k) for angle in cable.angles_deg]
        return cls(tuple(segments), tuple(tendons), guides)

    def scaled(self, *, EI: float = 1.0, GJ: float = 1.0, k_T: float = 1.0, T0: float = 1.0) -> "ArmParameters":
        """The same arm with stiffnesses and pretension multiplied by these factors."""
        segments = tuple(replace(s, EI=s.EI * EI, GJ=s.GJ * GJ) for s in self.segments)
        tendons = tuple(replace(t, k_T=t.k_T * k_T, T0=t.T0 * T0) for t in self.tendons)
        return replace(self, segments=segments, tendons=tendons)

    def up_to(self, s: float) -> "ArmParameters":
        """The arm from its base to arc length s, m: backbone and its masses cut off, tendons as stiff as before."""
        if s >= self.L:
            return self
        segments: list[Segment] = []
        for segment in self.segments:
            rest = s - math.fsum(g.L for g in segments)
            if rest <= 1e-12 * self.L:
                break
            part = min(segment.L, rest)
            disks = segment.disks * part / segment.L
            segments.append(replace(segment, L=part, disks=disks, end_mass=segment.end_mass * (part == segment.L)))
        segments[-1] = replace(segments[-1], end_mass=0.0)
        tendons = tuple(replace(t, segment=min(t.segment, len(segments) - 1)) for t in self.tendons)
        return replace(self, segments=tuple(segments), tendons=tendons)

    @property
    def n(self) -> int:
        """Number of tendons."""
        return len(self.tendons)

    @cached_property
    def L(self) -> float:
        """Length of the whole backbone, m."""
        return math.fsum(s.L for s in self.segments)

    @property
    def r(self) -> float:
        """Pitch radius of the first segment, m."""
        return self.segments[0].r

    @property
    def EI(self) -> float:
        """Bending stiffness of the first segment, N m^2."""
        return self.segments[0].EI

    @property
    def GJ(self) -> float:
        """Torsional stiffness of the first segment, N m^2."""
        return self.segments[0].GJ

    @cached_property
    def angles(self) -> Array:
        """Angle of each tendon (n,), rad."""
        return sealed(np.array([t.angle for t in self.tendons]))

    @cached_property
    def k_T(self) -> Array:
        """Stiffness of each tendon (n,), N/m."""
        return sealed(np.array([t.k_T for t in self.tendons]))

    @cached_property
    def T0(self) -> Array:
        """Pretension of each tendon (n,), N."""
        return sealed(np.array([t.T0 for t in self.tendons]))

    @cached_property
    def runs(self) -> Array:
        """1 where tendon i runs along segment k, else 0 (n, m)."""
        last = np.array([t.segment for t in self.tendons])
        return sealed((np.arange(len(self.segments)) <= last[:, None]).astype(np.float64))

    @cached_property
    def H(self) -> Array:
        """H (n, 2 m), m: q = H u with u the bends of the m segments one after the other.

        For one segment H_i = r [cos phi_i, sin phi_i] (the paper's eq. 3).
        """
        arm = np.array([s.r for s in self.segments]) * self.runs
        H = np.empty((self.n, 2 * len(self.segments)))
        H[:, 0::2] = arm * np.cos(self.angles)[:, None]
        H[:, 1::2] = arm * np.sin(self.angles)[:, None]
        return sealed(H)

    @cached_property
    def least_tension(self) -> Array:
        """H (H^T H)^-1 (n, 2 m), 1/m: the smallest tensions that make a moment, per N m of it."""
        return sealed(self.H @ np.linalg.inv(self.H.T @ self.H))

    @cached_property
    def bending(self) -> Array:
        """EI / L of every entry of u (2 m,), N m."""
        return sealed(np.repeat([s.EI / s.L for s in self.segments], 2))

    @cached_property
    def chord_loss(self) -> Array:
        """c (n, 2 m), m: chords between disks shorten tendon i by sum_j c_ij u_j^2, c = L / (24 disks^2)."""
        loss = np.array([s.L / (24 * s.disks**2) for s in self.segments]) * (self.guides is Guides.DISKS)
        return sealed(np.repeat(loss * self.runs, 2, axis=1))

    @property
    def mass(self) -> float:
        """Mass of everything that moves with the arm, kg."""
        return math.fsum(s.line_mass * s.L + s.end_mass for s in self.segments)


def _surrounds(angles: list[float]) -> bool:
    """Whether pulling at these angles can push the tip in every direction: no gap of half a turn or more."""
    if len(angles) < 3:
        return False
    ordered = sorted(a % (2 * math.pi) for a in angles)
    gaps = np.diff([*ordered, ordered[0] + 2 * math.pi])
    return bool(gaps.max() < math.pi - 1e-6)


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not 0 < value < math.inf:
            raise ConfigError(f"{name} = {value} must be positive and finite")


def _not_negative(**values: float) -> None:
    for name, value in values.items():
        if not 0 <= value < math.inf:
            raise ConfigError(f"{name} = {value} must not be negative")
