"""What the arm is doing, for telemetry."""

import math

from arm_companion.mission import actions, gripper, hazards
from arm_companion.mission.facts import ArmFault, ArmFlag, CalibrationState, Control, StatusReport
from arm_companion.mission.motion import ZERO
from arm_companion.mission.sharing import SHARING
from arm_companion.mission.situation import Situation
from arm_companion.mission.state import CALIBRATES, CARRYING, Phase, Prediction

_OVERLOAD = 0x20  # hardware-error bit of a servo
_TOUCHES = CARRYING | SHARING | {Phase.CONTACT, Phase.WRAP, Phase.CLOSE, Phase.VERIFY, Phase.PERCHED, Phase.UNLOAD}
_WANTED = ArmFault.TENDON_SLACK | ArmFault.MODEL | ArmFault.NOT_CALIBRATED
"""What is no trouble in a calibration, but its way, or what it mends."""

_BEHAVIOUR = {
    Phase.STARTUP: "startup",
    Phase.STOWED: "stowed",
    Phase.READYING: "ready",
    Phase.READY: "ready",
    Phase.STOWING: "stow",
    Phase.CALIBRATING: "calibrate",
    Phase.EASING: "calibrate",
    Phase.HOLDING: "hold",
    Phase.HANG_HOLD: "hold",
    Phase.TIP_MOVE: "jog",
    Phase.TIP_HOLD: "jog",
}


def status_report(s: Situation, prediction: Prediction) -> StatusReport:
    """ARM_STATUS of this cycle."""
    theta, delta = _polar(prediction.bend)
    goal_theta, goal_delta = _polar(s.state.bend)
    return StatusReport(
        behaviour=_BEHAVIOUR.get(s.state.phase, s.state.task.value),
        state=s.state.phase.name,
        state_number=s.state.phase.value,
        progress=actions.progress(s) if s.state.running else 255,
        flags=_flags(s),
        error_bits=s.state.errors | _present_faults(s),
        theta=theta,
        delta=delta,
        tip_position_a=prediction.tip_a,
        goal_theta=goal_theta,
        goal_delta=goal_delta,
        calibration=CalibrationState.RUNNING if s.state.phase is Phase.CALIBRATING else s.facts.calibration.state,
    )


def _flags(s: Situation) -> ArmFlag:
    """Facts that hold now."""
    tendons, state = s.facts.tendons, s.state
    servos = [servo for _, servo in s.servos]
    held = (
        (ArmFlag.SERVOS_CONNECTED, bool(tendons) and not any(servo.silent for servo in servos)),
        (ArmFlag.TORQUE_ON, bool(tendons) and all(servo.torque for servo in servos)),
        (ArmFlag.CALIBRATED, s.facts.calibration.state is CalibrationState.VALID),
        (ArmFlag.VEHICLE_CONNECTED, s.vehicle_heard),
        (ArmFlag.VEHICLE_STATE_FRESH, s.vehicle_fresh),
        (ArmFlag.EXTERNAL_CONTROL, s.external),
        (ArmFlag.SETPOINTS_SENT, actions.setpoint(s) is not None),
        (
            ArmFlag.FEEDFORWARD,
            state.lean != ZERO or (state.feedforward and state.phase is Phase.PERCHED and state.offset != ZERO),
        ),
        (ArmFlag.TARGET_KNOWN, (s.facts.grasp_target if s.grasping else s.facts.bar) is not None),
        (ArmFlag.CONTACT, state.phase in _TOUCHES),
        (ArmFlag.ANCHORED, state.phase in (Phase.PERCHED, Phase.HANGING)),
        (ArmFlag.GRIPPER_CLOSED, gripper.holds(s)),
    )
    return ArmFlag(sum(flag for flag, holds in held if holds))


def _present_faults(s: Situation) -> ArmFault:
    """Causes of failure that are there now, whether or not a row has acted on them."""
    vehicle, tendons = s.facts.vehicle, s.facts.tendons
    servos = [servo for _, servo in s.servos]
    there = (
        (ArmFault.VEHICLE_LOST, not s.vehicle_heard),
        (ArmFault.VEHICLE_STATE_STALE, not s.vehicle_fresh),
        (ArmFault.AUTOPILOT_FAILSAFE, vehicle.control is Control.FAILSAFE),
        (ArmFault.SERVO_SILENT, any(servo.silent for servo in servos)),
        (ArmFault.ESTIMATOR_JUMP, hazards.estimator_jumped(s) is not None),
        (ArmFault.SETPOINT_REJECTED, hazards.astray(s) is not None),
        (ArmFault.GROUND_LOST, hazards.ground_lost(s) is not None),
        (ArmFault.OVERHEAT, hazards.hot(s) is not None),
        (ArmFault.OVERLOAD, any(servo.error_bits & _OVERLOAD for servo in servos)),
        (ArmFault.LOW_VOLTAGE, hazards.low_voltage(s) is not None),
        (ArmFault.MODEL, hazards.model_blind(s) is not None),
        (ArmFault.CYCLE_OVERRUN, hazards.overrun(s) is not None),
        (ArmFault.SERVO_FAULT, any(servo.error_bits or not servo.homed for servo in servos)),
        (
            ArmFault.TENDON_SLACK,
            any(t.torque and t.tension + 2.0 * t.tension_sigma < s.config.limits.tension_min_n for t in tendons),
        ),
        (ArmFault.TENDON_BROKEN, any(watched.broken for watched in s.state.watch)),
        (ArmFault.TENSION_DISAGREES, any(watched.jumped for watched in s.state.watch)),
        (ArmFault.NOT_CALIBRATED, bool(s.facts.calibration.refusal)),
        (ArmFault.TENDON_OVER_TENSION, any(t.tension > s.config.limits.tension_max_n for t in tendons)),
    )
    present = ArmFault(sum(fault for fault, holds in there if holds))
    return present & ~_WANTED if s.state.phase in CALIBRATES else present


def _polar(u: tuple[float, float]) -> tuple[float, float]:
    theta = math.hypot(*u)
    return theta, math.atan2(u[1], u[0]) if theta > 0.0 else 0.0
