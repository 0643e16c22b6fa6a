"""Every option of the system: meaning, unit, bounds and default beside each other, by section in the modules below.

Keys follow the sections of the TOML files in `configs/`. SI units throughout; where a key's value is not SI,
its suffix says so.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from arm_companion.config.arm_options import (
    ArmConfig,
    ArmMassConfig,
    ArmTendonsConfig,
    BackboneConfig,
    MountConfig,
    SegmentConfig,
)
from arm_companion.config.flight_options import (
    KeepOutConfig,
    LimitsConfig,
    PerchConfig,
    RatesConfig,
    RecordConfig,
    SimBarConfig,
    SimConfig,
)
from arm_companion.config.grasp_options import GraspConfig, SimObjectConfig
from arm_companion.config.gripper_options import GripperConfig, SimGripperConfig, with_gripper
from arm_companion.config.hang_options import HangConfig
from arm_companion.config.link_options import STREAMED, LinkConfig, MavlinkConfig, VehicleConfig
from arm_companion.config.mqtt_options import MqttConfig
from arm_companion.config.options import section
from arm_companion.config.page_options import PageConfig
from arm_companion.config.reach_options import ReachConfig
from arm_companion.config.servo_options import CalibrationConfig, ServosConfig
from arm_companion.errors import ConfigError

__all__ = [
    "STREAMED",
    "ArmConfig",
    "ArmMassConfig",
    "ArmTendonsConfig",
    "BackboneConfig",
    "CalibrationConfig",
    "Config",
    "GraspConfig",
    "GripperConfig",
    "HangConfig",
    "KeepOutConfig",
    "LimitsConfig",
    "LinkConfig",
    "MavlinkConfig",
    "MountConfig",
    "MqttConfig",
    "PageConfig",
    "PerchConfig",
    "RatesConfig",
    "ReachConfig",
    "RecordConfig",
    "SegmentConfig",
    "ServosConfig",
    "SimBarConfig",
    "SimConfig",
    "SimGripperConfig",
    "SimObjectConfig",
    "VehicleConfig",
]


_LEAST_APEX_M = 0.005


@dataclass(frozen=True)
class Config:
    """A whole configuration file."""

    arm: ArmConfig = section(ArmConfig)
    mount: MountConfig = section(MountConfig)
    vehicle: VehicleConfig = section(VehicleConfig)
    links: Mapping[str, LinkConfig] = field(default_factory=dict)
    mavlink: MavlinkConfig = section(MavlinkConfig)
    servos: ServosConfig = section(ServosConfig)
    calibration: CalibrationConfig = section(CalibrationConfig)
    limits: LimitsConfig = section(LimitsConfig)
    perch: PerchConfig = section(PerchConfig)
    hang: HangConfig = section(HangConfig)
    grasp: GraspConfig = section(GraspConfig)
    reach: ReachConfig = section(ReachConfig)
    gripper: GripperConfig = section(GripperConfig)
    rates: RatesConfig = section(RatesConfig)
    record: RecordConfig = section(RecordConfig)
    mqtt: MqttConfig = section(MqttConfig)
    page: PageConfig = section(PageConfig)
    sim: SimConfig = section(SimConfig)

    def __post_init__(self) -> None:
        # research needs no servos: an arm of three tendons, or of two segments, may leave them as they are
        if self.servos.ids != ServosConfig().ids:
            self.check_servos()
        if self.perch.wrap_bend_rad > self.limits.bend_max_rad:
            raise ConfigError(
                f"perch.wrap_bend_rad = {self.perch.wrap_bend_rad:g} is over limits.bend_max_rad = "
                f"{self.limits.bend_max_rad:g}"
            )
        least, pretension = self.limits.tension_min_n, self.arm.tendons.pretension_n
        if least > max(pretension, LimitsConfig().tension_min_n):  # research may do without a pretension
            raise ConfigError(
                f"limits.tension_min_n = {least:g} is over arm.tendons.pretension_n = {pretension:g}: a straight arm's "
                "tendons could not be let out, nor a bar let go"
            )
        keep_out = self.limits.keep_out
        if keep_out.half_angle_deg and math.hypot(*keep_out.apex_m) < _LEAST_APEX_M:
            raise ConfigError("limits.keep_out.apex_m is at the centre of mass: the cone would have no direction")
        if sum(link.role == "autopilot" for link in self.links.values()) > 1:
            raise ConfigError("links: more than one link has the role autopilot")
        with_gripper(self.servos, self.gripper_servo)
        if self.gripper_by == "autopilot" and self.gripper.instance == self.vehicle.component_id:
            raise ConfigError(
                f"gripper.instance = {self.gripper.instance} is vehicle.component_id: DO_GRIPPER for it means ourselves"
            )

    @property
    def gripper_by(self) -> str:
        """Who moves the gripper's jaws; empty: the arm has no gripper."""
        return self.gripper.by if self.grasp.kind == "gripper" else ""

    @property
    def gripper_servo(self) -> GripperConfig | None:
        """The gripper that has a servo on the bus; None: there is none."""
        return self.gripper if self.gripper_by == "servo" else None

    @property
    def bus_servos(self) -> ServosConfig:
        """Every servo on the bus: the tendons' in their order, and then the gripper's."""
        return with_gripper(self.servos, self.gripper_servo)

    def check_servos(self) -> None:
        """That every tendon has its servo, which only a flight needs.

        Raises:
            ConfigError: when not.
        """
        if len(self.servos.ids) != self.arm.tendon_count:
            raise ConfigError(f"servos.ids has {len(self.servos.ids)} entries for {self.arm.tendon_count} tendons")
