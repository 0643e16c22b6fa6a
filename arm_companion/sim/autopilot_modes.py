"""Arming, flight modes, take-off, landing and failsafes: who may fly, and where to.

`FlightModes` knows nothing of MAVLink's bytes. Requests come in with the loop's time and are answered with a
MAV_RESULT; `demand` turns the present mode into a set-point for the controller; `tick` watches the stream of
external set-points.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from arm_companion.protocol.dialect import mav
from arm_companion.sim import autopilot_flavours as flavours
from arm_companion.sim.autopilot_flavours import Flavour, Mode
from arm_companion.sim.flight_control import ZERO, Estimate, MotionSetpoint
from arm_companion.sim.ports import Vec3

Say = Callable[[int, str], None]
"""Tells people something: MAV_SEVERITY and one sentence."""

_SPOOL_UP_S = 1.0
_RAMP_S = 2.0  # until the vertical loop is fully released
_CLIMB_M_PER_S = 1.5
_SINK_M_PER_S = 0.7
_TOUCH_DOWN_M_PER_S = 0.3
_SLOW_BELOW_M = 1.0
_TAKEN_OFF_WITHIN_M = 0.1
_GROUND_CONTACT_S = 0.35
_LANDED_S = 0.7
_LOWER_LIMIT_LANDED_S = 1.0  # ArduPilot's LAND_DETECTOR_TRIGGER_SEC
_LOWER_LIMIT_SHARE = 0.125  # of hover thrust, under which its motors count as at their lower limit
_STOPPING_S = 0.7  # a held position lies ahead of a moving vehicle by its speed times this
_STREAM_GAP_S = 0.5  # slower than 2 Hz is no stream
_STREAM_STEADY_S = 1.0
_LOSS_ACTIONS = {
    0: Mode.POSITION,
    1: Mode.ALTITUDE,
    2: Mode.MANUAL,
    3: Mode.RETURN,
    4: Mode.LAND,
    5: Mode.HOLD,
}


@dataclass(frozen=True, slots=True)
class Demand:
    """What the controller shall do."""

    setpoint: MotionSetpoint
    release: float  # of the vertical loop while taking off, 0 to 1
    touching: bool  # the ground has been felt: no lift


class SetpointStream:
    """The external set-points as they come in."""

    def __init__(self) -> None:
        self.setpoint: MotionSetpoint | None = None
        self._last = -math.inf
        self._since = -math.inf

    def take(self, setpoint: MotionSetpoint, now: float) -> None:
        """A valid set-point arrived."""
        if now - self._last > _STREAM_GAP_S:
            self._since = now
        self.setpoint, self._last = setpoint, now

    def age(self, now: float) -> float:
        """Seconds since the last set-point."""
        return now - self._last

    def steady(self, now: float) -> bool:
        """Whether it came faster than 2 Hz for the last second."""
        return self.age(now) <= _STREAM_GAP_S and now - self._since >= _STREAM_STEADY_S


class FlightModes:
    """The mode machine.

    Attributes:
        mode: what flies now, and what the heartbeat shows.
        armed, landed: as the autopilot believes.
        failsafe: a failsafe has taken over from the asked mode.
        emergency: the blind descent of `fail`; only a pilot or the ground ends it.
        ready: the estimator has converged and the checks pass; set by the owner.
        estimate, flown: last estimate, and the set-point flown from it (None: the rotors stand).
        home: place of the last arming.
        thrust_share: commanded thrust over hover thrust; set by the owner.
    """

    def __init__(self, flavour: Flavour, parameters: Mapping[str, float], say: Say) -> None:
        self._flavour = flavour
        self._parameters = parameters
        self._say = say
        self.estimate = Estimate()
        self.home: Vec3 = ZERO
        self.thrust_share = 0.0
        self.boot()

    def boot(self) -> None:
        """Power-up: disarmed, in the first mode, with nothing heard yet."""
        self.flown: MotionSetpoint | None = None
        self.ready = False
        self.stream = SetpointStream()
        self.mode = self._asked = self._flavour.boot_mode
        self.armed, self.landed = False, True
        self.failsafe = self.emergency = False
        self._stream_lost = False
        self._anchor: tuple[Vec3, float] | None = None  # position and yaw that are held
        self._goal_z: float | None = None  # of a take-off in progress
        self._armed_s = self._contact_s = self._landed_s = self._limit_s = 0.0
        self._release = 0.0
        self._was_airborne = False

    @property
    def landed_state(self) -> int:
        """MAV_LANDED_STATE."""
        if self.landed:
            return int(mav.MAV_LANDED_STATE_ON_GROUND)
        if self._goal_z is not None:
            return int(mav.MAV_LANDED_STATE_TAKEOFF)
        if self.mode is Mode.LAND:
            return int(mav.MAV_LANDED_STATE_LANDING)
        return int(mav.MAV_LANDED_STATE_IN_AIR)

    # Requests --------------------

    def arm(self, now: float, *, force: bool = False) -> int:
        """Start the rotors, if the checks allow it."""
        if self.armed:
            return int(mav.MAV_RESULT_ACCEPTED)
        reason = self._arming_refusal(now)
        if reason and not force:
            self._say(mav.MAV_SEVERITY_CRITICAL, f"Arming denied: {reason}")
            return self._flavour.refused
        self.armed, self.landed, self._was_airborne = True, True, False
        self._armed_s = self._landed_s = 0.0
        self.home = self.estimate.position_w
        self._say(mav.MAV_SEVERITY_INFO, "Armed by external command")
        return int(mav.MAV_RESULT_ACCEPTED)

    def _arming_refusal(self, now: float) -> str:
        if not self.ready:
            return "estimator not ready"
        if self.mode in (Mode.LAND, Mode.RETURN):
            return "switch to another mode first"
        if self._flavour.is_px4 and self.mode is Mode.EXTERNAL and not self.stream.steady(now):
            return "no offboard signal"
        return ""

    def disarm(self, *, force: bool = False) -> int:
        """Stop the rotors; in the air only by force."""
        if self.armed and not self.landed and not force:
            self._say(mav.MAV_SEVERITY_CRITICAL, "Disarming denied: not landed")
            return self._flavour.refused
        if self.armed:
            self._stop("Disarmed by external command")
        return int(mav.MAV_RESULT_ACCEPTED)

    def request_mode(self, mode: Mode, now: float) -> int:
        """Somebody on a link asks for a mode."""
        if self.emergency:
            return self._flavour.refused
        if mode is Mode.EXTERNAL and self._flavour.is_px4 and not self.stream.steady(now):
            self._say(mav.MAV_SEVERITY_CRITICAL, "Offboard refused: set-points must stream above 2 Hz for 1 s")
            return self._flavour.refused
        if mode is Mode.TAKEOFF:
            return self.takeoff(-self.home[2] + self._parameters[flavours.TAKEOFF_ALTITUDE])
        self._ask(mode)
        return int(mav.MAV_RESULT_ACCEPTED)

    def takeoff(self, height_m: float) -> int:
        """Climb to `height_m` over the origin; PX4 climbs at least to its configured height over home."""
        refused = self.emergency or (
            not self._flavour.is_px4 and (self.mode is not Mode.EXTERNAL or not self.armed or not self.landed)
        )
        if refused:
            return self._flavour.refused
        if self._flavour.is_px4:
            least, now = self._parameters[flavours.TAKEOFF_ALTITUDE] - self.home[2], -self.estimate.position_w[2]
            if height_m < now:  # as one over home is, given for one over the sea
                self._say(mav.MAV_SEVERITY_WARNING, "Already higher than takeoff altitude")
                least = height_m = now
            elif height_m < least - 0.1:
                self._say(mav.MAV_SEVERITY_WARNING, f"Takeoff altitude below minimum, climbing to {least:.1f} m")
            height_m = max(height_m, least)
            self._ask(Mode.TAKEOFF)
        else:
            self._ask(Mode.EXTERNAL)
            self.stream.setpoint = None
        self._goal_z = -height_m
        return int(mav.MAV_RESULT_ACCEPTED)

    def take_over(self, mode: Mode) -> None:
        """The pilot moves the mode switch: always obeyed, also in an emergency."""
        self.emergency = False
        self._ask(mode)
        self._say(mav.MAV_SEVERITY_INFO, f"Pilot took over: {mode.value}")

    def fail(self) -> None:
        """An emergency (lost estimator, lost power): the vehicle, if it flies, sinks where it is."""
        if not self.armed:
            return
        self._ask(Mode.LAND)
        self.failsafe = self.emergency = True
        self._say(mav.MAV_SEVERITY_EMERGENCY, "Failsafe: emergency descent")

    def set_external(self, setpoint: MotionSetpoint | None, now: float) -> None:
        """A set-point came in; None is one that stops the vehicle (ArduPilot, position with acceleration)."""
        if self._flavour.is_px4:
            if setpoint is not None:
                self.stream.take(setpoint, now)
                self._watch_stream(now)
        elif not self.landed:  # on the ground ArduPilot ignores set-points until it has been told to take off
            self._goal_z = None
            if setpoint is None:
                self.stream.setpoint, self._anchor = None, None
            else:
                self.stream.take(setpoint, now)

    # Time --------------------

    def tick(self, now: float) -> None:
        """Watch the set-point stream; call at 50 Hz or more."""
        self._watch_stream(now)

    def _watch_stream(self, now: float) -> None:
        if self._asked is not Mode.EXTERNAL or self.emergency:
            return
        age = self.stream.age(now)
        if not self._flavour.is_px4:
            if self.stream.setpoint is not None and age > self._parameters[flavours.GUIDED_TIMEOUT]:
                self.stream.setpoint, self._anchor = None, None  # brakes, and stays in GUIDED
            return
        lost = age > self._parameters[flavours.OFFBOARD_LOSS_TIMEOUT]
        if lost and not self.armed:
            self._ask(self._flavour.boot_mode)
            return
        if lost and not self._stream_lost:
            action = int(self._parameters[flavours.OFFBOARD_LOSS_ACTION])
            fallback = _LOSS_ACTIONS.get(action, Mode.HOLD)
            self._say(mav.MAV_SEVERITY_CRITICAL, f"Failsafe: offboard signal lost, {fallback.value}")
            self._enter(fallback)
        elif not lost and self._stream_lost:
            self._say(mav.MAV_SEVERITY_INFO, "Offboard signal regained")
            self._enter(Mode.EXTERNAL)
        self._stream_lost = self.failsafe = lost

    def demand(self, estimate: Estimate, dt: float) -> Demand | None:
        """Where to fly in the next `dt` seconds; None stops the rotors."""
        self.estimate, self.flown = estimate, None
        if not self.armed:
            return None
        self._armed_s += dt
        if self.landed:
            self._wait_on_ground(dt)
            if self.landed:
                return None
        self._release = min(self._release + dt / _RAMP_S, 1.0)
        self.flown = setpoint = self._setpoint(estimate)
        self._feel_ground(estimate, setpoint, dt)
        return Demand(setpoint, self._release, touching=self._contact_s >= _GROUND_CONTACT_S)

    def _wait_on_ground(self, dt: float) -> None:
        """Armed and landed: take off once asked, or disarm when nothing comes."""
        self._landed_s += dt
        if self._armed_s >= _SPOOL_UP_S and self._wants_up():
            self.landed, self._was_airborne = False, True
            self._anchor, self._contact_s, self._limit_s, self._release = None, 0.0, 0.0, 0.0
            self._say(mav.MAV_SEVERITY_INFO, "Takeoff detected")
            return
        if self._landed_s >= self._disarm_delay_s():
            self._stop("Disarmed by landing" if self._was_airborne else "Disarmed by auto preflight disarming")

    def _disarm_delay_s(self) -> float:
        if self._flavour.is_px4:
            key = flavours.DISARM_LANDED if self._was_airborne else flavours.DISARM_PREFLIGHT
        elif self._was_airborne and self.mode in (Mode.LAND, Mode.RETURN):
            return 0.0
        else:
            key = flavours.DISARM_DELAY
        return self._parameters[key]

    def _wants_up(self) -> bool:
        if self._goal_z is not None:
            return True
        setpoint = self.stream.setpoint
        if self.mode is not Mode.EXTERNAL or setpoint is None:
            return False
        z, climb = setpoint.position_w[2], setpoint.velocity_w[2]
        return (z is not None and z < self.estimate.position_w[2] - 0.2) or (climb is not None and climb < -0.3)

    def _feel_ground(self, estimate: Estimate, setpoint: MotionSetpoint, dt: float) -> None:
        """Asked to sink and not sinking means ground; rotors idle then, and soon it counts as landed."""
        if not self._flavour.is_px4 and self._at_lower_limit(estimate, dt):
            self._land()
            return
        sink = setpoint.velocity_w[2]
        asked = sink is not None and sink >= 0.9 * _TOUCH_DOWN_M_PER_S and setpoint.position_w[2] is None
        north, east, down = estimate.velocity_w
        still = abs(down) < 0.4 * _TOUCH_DOWN_M_PER_S and math.hypot(north, east) < 0.5
        self._contact_s = self._contact_s + dt if asked and still else 0.0
        if self._contact_s >= _LANDED_S:
            self._land()

    def _land(self) -> None:
        self.landed, self._landed_s, self._goal_z = True, 0.0, None
        self._say(mav.MAV_SEVERITY_INFO, "Landing detected")

    def _at_lower_limit(self, estimate: Estimate, dt: float) -> bool:
        """ArduPilot believes in a landing in every mode: motors at their lower limit, and at rest, for a second."""
        low = self._release == 1.0 and self.thrust_share < _LOWER_LIMIT_SHARE
        self._limit_s = self._limit_s + dt if low and math.hypot(*estimate.velocity_w) < 0.5 else 0.0
        return self._limit_s >= _LOWER_LIMIT_LANDED_S

    def _setpoint(self, estimate: Estimate) -> MotionSetpoint:
        if self._anchor is None:
            p, v = estimate.position_w, estimate.velocity_w
            ahead = (p[0] + _STOPPING_S * v[0], p[1] + _STOPPING_S * v[1], p[2] + 0.4 * v[2])
            self._anchor = (ahead if self._release == 1.0 else p, estimate.yaw)
        (north, east, down), yaw = self._anchor
        if self._goal_z is not None:
            return self._climb(estimate, self._goal_z)
        if self.mode is Mode.EXTERNAL and self.stream.setpoint is not None:
            return self._external(self.stream.setpoint, estimate)
        if self.mode in (Mode.LAND, Mode.RETURN):
            if self.mode is Mode.RETURN:
                if math.dist((self.home[0], self.home[1]), estimate.position_w[:2]) > 0.3:
                    return MotionSetpoint((self.home[0], self.home[1], down), ZERO, ZERO, yaw)
                north, east = self.home[0], self.home[1]
            low = self.home[2] - estimate.position_w[2] < _SLOW_BELOW_M
            sink = _TOUCH_DOWN_M_PER_S if low else _SINK_M_PER_S
            return MotionSetpoint((north, east, None), (0.0, 0.0, sink), ZERO, yaw)
        if self.mode in (Mode.ALTITUDE, Mode.MANUAL):  # sticks centred: height held, no hold of place
            return MotionSetpoint((None, None, down), (None, None, 0.0), ZERO, yaw)
        return MotionSetpoint((north, east, down), ZERO, ZERO, yaw)

    def _climb(self, estimate: Estimate, goal_z: float) -> MotionSetpoint:
        """Straight up at a speed that shrinks towards the goal; then hold there."""
        (north, east, _), yaw = self._anchor or (estimate.position_w, estimate.yaw)
        left = estimate.position_w[2] - goal_z
        if left < _TAKEN_OFF_WITHIN_M:
            self._goal_z = None
            self._anchor = ((north, east, min(goal_z, estimate.position_w[2])), yaw)
            if self._flavour.is_px4:
                self.mode = self._asked = Mode.HOLD
            return MotionSetpoint(self._anchor[0], ZERO, ZERO, yaw)
        climb = min(_CLIMB_M_PER_S, 0.2 + left)
        return MotionSetpoint((north, east, None), (0.0, 0.0, -climb), ZERO, yaw)

    def _external(self, setpoint: MotionSetpoint, estimate: Estimate) -> MotionSetpoint:
        """The streamed set-point; ArduPilot without a commanded yaw turns its nose to where it flies."""
        if self._flavour.is_px4 or setpoint.yaw is not None or setpoint.yaw_rate:
            return setpoint
        north, east, _ = estimate.velocity_w
        yaw = math.atan2(east, north) if math.hypot(north, east) > 0.2 else None
        return MotionSetpoint(setpoint.position_w, setpoint.velocity_w, setpoint.acceleration_w, yaw)

    # Changes --------------------

    def _ask(self, mode: Mode) -> None:
        self._asked = mode
        self._stream_lost = self.failsafe = False
        self._enter(mode)

    def _enter(self, mode: Mode) -> None:
        self.mode = mode
        self._anchor, self._goal_z = None, None
        self._contact_s = 0.0

    def _stop(self, reason: str) -> None:
        self.armed, self.landed = False, True
        self._goal_z, self._anchor = None, None
        self._say(mav.MAV_SEVERITY_INFO, reason)
        finished = self.mode in (Mode.TAKEOFF, Mode.LAND, Mode.RETURN) and self._flavour.is_px4
        if finished or self.emergency or self._stream_lost:
            self.emergency = False
            self._ask(self._flavour.boot_mode)
