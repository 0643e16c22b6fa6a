"""Options of the arm itself: geometry, material, tendons, where it sits on the airframe."""

import dataclasses
from dataclasses import dataclass

from arm_companion.config.options import option, section
from arm_companion.errors import ConfigError


@dataclass(frozen=True)
class BackboneConfig:
    """[arm.backbone] The elastic rod in the arm's middle."""

    diameter_m: float = option("diameter", 0.0016, unit="m", lower=1e-4, upper=0.02)
    youngs_modulus_pa: float = option("Young's modulus", 60e9, unit="Pa", lower=1e6, upper=1e12)
    poisson_ratio: float = option("Poisson's ratio", 0.33, lower=0.0, upper=0.499)


@dataclass(frozen=True)
class ArmTendonsConfig:
    """[arm.tendons] The cables from the pulleys to the end disk."""

    angles_deg: tuple[float, ...] = option(
        "angle of each tendon about the base z axis, the paper's order",
        (0.0, -90.0, -180.0, -270.0),
        unit="deg",
    )
    diameter_m: float = option("diameter", 0.0006, unit="m", lower=1e-5, upper=0.01)
    youngs_modulus_pa: float = option("Young's modulus", 4e9, unit="Pa", lower=1e6, upper=1e12)
    routing_length_m: float = option("length between pulley and base disk", 0.1, unit="m", lower=0.0, upper=5.0)
    pretension_n: float = option("tension of the straight, unloaded arm", 4.0, unit="N", lower=0.0, upper=100.0)
    servo_stiffness_n_per_m: float = option(
        "compliance of servo and pulley in series with each tendon; inf-like values mean rigid",
        1e9,
        unit="N/m",
        lower=1.0,
        upper=1e12,
    )
    guide_friction: float = option(
        "Coulomb coefficient of the tendons in their guides; only the research commands use it, 0 is none",
        0.0,
        lower=0.0,
        upper=2.0,
    )


@dataclass(frozen=True)
class ArmMassConfig:
    """[arm.mass] What moves with the arm; the housing counts with the airframe."""

    disk_kg: float = option("each spacer disk", 0.003, unit="kg", lower=0.0, upper=1.0)
    end_disk_kg: float = option("end disk, a point mass at the tip", 0.006, unit="kg", lower=0.0, upper=1.0)
    backbone_density_kg_m3: float = option("backbone", 6450.0, unit="kg/m^3", lower=0.0, upper=30000.0)
    tendons_kg: float = option("all tendons inside the arm", 0.0005, unit="kg", lower=0.0, upper=1.0)


@dataclass(frozen=True)
class SegmentConfig:
    """[[arm.segments]] One more segment, carried by the last; its tendons run through all segments before it.

    What is absent is as in [arm]; a table that is there stands for itself, with its own defaults.
    """

    length_m: float | None = option("backbone length, to its end disk", None, unit="m", lower=0.02, upper=3.0)
    pitch_radius_m: float | None = option("radius of its pitch circle", None, unit="m", lower=1e-3, upper=0.2)
    disks: int | None = option("its disks, end disk included", None, lower=2, upper=200)
    backbone: BackboneConfig | None = None
    tendons: ArmTendonsConfig | None = None
    mass: ArmMassConfig | None = None


@dataclass(frozen=True)
class ArmConfig:
    """[arm] Geometry and material of the continuum arm: its only segment, or the one at the base."""

    length_m: float = option("backbone length, base disk to end disk", 0.25, unit="m", lower=0.02, upper=3.0)
    pitch_radius_m: float = option("radius of the tendons' pitch circle", 0.02, unit="m", lower=1e-3, upper=0.2)
    disks: int = option("disks without the base disk, end disk included", 10, lower=2, upper=200)
    pulley_radius_m: float = option("radius at which a tendon winds", 0.01, unit="m", lower=1e-3, upper=0.1)
    backbone: BackboneConfig = section(BackboneConfig)
    tendons: ArmTendonsConfig = section(ArmTendonsConfig)
    mass: ArmMassConfig = section(ArmMassConfig)
    segments: tuple[SegmentConfig, ...] = option("further segments, from base to tip; for research", ())

    def __post_init__(self) -> None:
        for tendons in (self.tendons, *(segment.tendons for segment in self.segments)):
            if tendons is not None and len(tendons.angles_deg) < 3:  # fewer cannot pull every way
                raise ConfigError(f"tendons.angles_deg has {len(tendons.angles_deg)} entries; at least 3 are needed")

    @property
    def chain(self) -> "tuple[ArmConfig, ...]":
        """Every segment as an arm of its own, from base to tip."""
        further = [
            dataclasses.replace(
                self,
                segments=(),
                **{
                    f.name: value
                    for f in dataclasses.fields(segment)
                    if (value := getattr(segment, f.name)) is not None
                },
            )
            for segment in self.segments
        ]
        return (dataclasses.replace(self, segments=()), *further)

    @property
    def tendon_count(self) -> int:
        """Of all segments together."""
        return sum(len(segment.tendons.angles_deg) for segment in self.chain)


@dataclass(frozen=True)
class MountConfig:
    """[mount] Where the arm sits on the airframe."""

    position_m: tuple[float, ...] = option(
        "arm base from the airframe's centre of mass, body axes (FRD)",
        (0.0, 0.0, 0.12),
        unit="m",
        lower=-2.0,
        upper=2.0,
        length=3,
    )
    rpy_deg: tuple[float, ...] = option(
        "roll, pitch, yaw that turn body axes into base axes; zero is an arm below, z down",
        (0.0, 0.0, 0.0),
        unit="deg",
        lower=-180.0,
        upper=180.0,
        length=3,
    )
