"""A gripper that is moved by a servo of its own, the last one on the bus of the tendons.

Its travel is less than a turn, so the angle of its horn says where the jaws are, after a loss of power too. Its own PWM
limit bounds the force with which they close: an XL430 has no other means.
"""

import dataclasses
from collections.abc import Sequence

from arm_companion.config.schema import Config, GripperConfig, ServosConfig
from arm_companion.drivers.servo_health import ServoState
from arm_companion.drivers.servo_setup import Settings, settings_of
from arm_companion.mission.gripper_facts import GripperAction, GripperOrder, GripperState, JawState
from arm_companion.protocol import control_table as ct


def own_settings(config: Config) -> dict[int, Settings]:
    """What the gripper's servo is set to, by its id; empty: there is none."""
    gripper = config.gripper_servo
    return {} if gripper is None else {gripper.servo_id: _settings(config.servos, gripper)}


def _settings(servos: ServosConfig, gripper: GripperConfig) -> Settings:
    common = settings_of(servos, gripper.speed_rad_per_s)
    return dataclasses.replace(common, goal_pwm=round(gripper.pwm * ct.PWM_FULL), within_a_turn=True)


class GripperServo:
    """Jaws from a servo, and goals for it."""

    def __init__(self, config: GripperConfig) -> None:
        self._config = config
        self._travel = config.closed_ticks - config.open_ticks

    def state(self, servos: Sequence[ServoState], _now: float) -> GripperState:
        """The jaws as the last of all servos on the bus has them."""
        servo = servos[-1]
        sense = 1.0 if self._travel > 0 else -1.0
        return GripperState(
            JawState(
                closed=(servo.position - self._config.open_ticks) / self._travel,
                speed=servo.speed / self._travel,
                load=sense * servo.load,
                temperature=servo.temperature,
                voltage=servo.voltage,
                error_bits=servo.error_bits,
                silent=servo.silent,
                torque=servo.torque,
                ready=servo.ready,
                homed=not servo.turns_lost,
            )
        )

    def goals(self, order: GripperOrder | None, _now: float) -> tuple[int | None, ...]:
        """What follows the tendons' goals: where the servo is to be, ticks; None leaves it where it was told last."""
        if order is None:
            return (None,)
        closing = order.action is GripperAction.CLOSE
        return (self._config.closed_ticks if closing else self._config.open_ticks,)
