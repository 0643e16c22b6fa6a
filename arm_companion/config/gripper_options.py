"""Options of a gripper at the arm's tip, and of the one in the simulated world."""

import dataclasses
from dataclasses import dataclass

from arm_companion.config.options import option
from arm_companion.config.servo_options import ServosConfig
from arm_companion.errors import ConfigError

_LEAST_TRAVEL_TICKS = 100


@dataclass(frozen=True)
class GripperConfig:
    """[gripper] Two jaws at the tip, which `grasp.kind = "gripper"` closes across the object's axis."""

    by: str = option(
        "who moves the jaws: a servo more on the bus of the tendons, or the autopilot, told by DO_GRIPPER",
        "servo",
        choices=("servo", "autopilot"),
    )
    depth_m: float = option(
        "from the end disk to the middle between the jaws, along the arm", 0.045, unit="m", lower=0.0, upper=0.5
    )
    timeout_s: float = option("time to open, and to close", 5.0, unit="s", lower=0.5, upper=60.0)
    servo_id: int = option("id of its servo", 5, lower=0, upper=252)
    open_ticks: int = option("position of its servo with the jaws open", 1024, lower=0, upper=4095)
    closed_ticks: int = option("position with the jaws closed on nothing", 3072, lower=0, upper=4095)
    speed_rad_per_s: float = option("speed of its servo", 4.0, unit="rad/s", lower=0.05, upper=6.0)
    pwm: float = option(
        "most of the full duty that its servo puts out, which limits the force of the jaws", 0.35, lower=0.05, upper=0.7
    )
    load_min: float = option(
        "load of a servo that stands short of closed_ticks, share of full load, that means closed on something",
        0.15,
        lower=0.02,
        upper=0.6,
    )
    instance: int = option("which of the autopilot's grippers, param1 of DO_GRIPPER", 1, lower=1, upper=6)
    moving_s: float = option(
        "an autopilot's gripper, which tells nothing but that it took the command, counts as open or closed after",
        2.0,
        unit="s",
        lower=0.1,
        upper=30.0,
    )

    def __post_init__(self) -> None:
        if abs(self.closed_ticks - self.open_ticks) < _LEAST_TRAVEL_TICKS:
            raise ConfigError(
                f"open_ticks = {self.open_ticks} and closed_ticks = {self.closed_ticks} are the same: at least "
                f"{_LEAST_TRAVEL_TICKS} ticks must lie between them"
            )
        if self.by == "autopilot" and self.moving_s >= self.timeout_s:
            raise ConfigError(f"moving_s = {self.moving_s:g} is not below gripper.timeout_s = {self.timeout_s:g}")
        if self.load_min >= self.pwm:
            raise ConfigError(f"load_min = {self.load_min:g} is never reached with pwm = {self.pwm:g}")

    @property
    def middle_ticks(self) -> int:
        """Half-way between open and closed: its turn is the one about this."""
        return (self.open_ticks + self.closed_ticks) // 2


@dataclass(frozen=True)
class SimGripperConfig:
    """[sim.gripper] The jaws as they really are in the plant."""

    opening_m: float = option("between the open jaws", 0.1, unit="m", lower=0.01, upper=0.5)
    length_m: float = option("of the jaws, from the end disk on", 0.065, unit="m", lower=0.01, upper=0.3)
    jaw_kg: float = option("mass of each, a part of arm.mass.end_disk_kg", 0.012, unit="kg", lower=0.001, upper=0.5)


def with_gripper(servos: ServosConfig, gripper: GripperConfig | None) -> ServosConfig:
    """All servos on the bus: the tendons' in their order, and then the gripper's.

    Raises:
        ConfigError: the gripper's id is a tendon's.
    """
    if gripper is None:
        return servos
    if gripper.servo_id in servos.ids:
        raise ConfigError(f"gripper.servo_id = {gripper.servo_id} is one of servos.ids")
    return dataclasses.replace(
        servos,
        ids=(*servos.ids, gripper.servo_id),
        directions=(*servos.directions, 1),
        zero_ticks=(*servos.zero_ticks, gripper.middle_ticks),
        coupling=(),  # among tendons, which the bus knows nothing of
    )
