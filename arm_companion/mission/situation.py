"""One cycle as the guards and actions see it: facts, memory, parameters and what follows from them."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from arm_companion.arm.reaction import GRAVITY
from arm_companion.arm.statics import bend_of_differences
from arm_companion.config.schema import Config
from arm_companion.errors import ModelError
from arm_companion.geometry.se3 import Pose
from arm_companion.mission.facts import Bar, Control, Facts, Order, TendonState, Vec3
from arm_companion.mission.gripper_facts import JawState
from arm_companion.mission.motion import add, dot, norm, rotate, scale, sub, turn_by_yaw, unrotate
from arm_companion.mission.parameters import Parameters, column
from arm_companion.mission.state import MOVES_VEHICLE, Phase, State
from arm_companion.values import replace

_ABOVE = -0.5  # z of the arm's base axis in body axes
_NEAR_M = 0.15
_TINY_RAD = 1e-9
_COMES_TO_REST_S = 3.0  # of set-points that may get lost
_ELSEWHERE_M = 0.5  # from where an object was taken: it is set down here, and not brought back


@dataclass(frozen=True)
class Situation:
    """Facts, memory and parameters of one cycle; only what does not depend on memory is cached."""

    state: State
    facts: Facts
    t: float
    parameters: Parameters

    def remembering(self, state: State) -> "Situation":
        """The same cycle with other memory; the cached properties, which follow from the facts alone, go along."""
        return replace(self, state=state)

    @cached_property
    def config(self) -> Config:
        """The whole configuration."""
        return self.parameters.config

    @property
    def dt(self) -> float:
        """Seconds since the previous step, at most a tenth: a stall must not become a leap."""
        return min(max(self.t - self.state.t, 0.0), 0.1) if self.state.t else 0.0

    @property
    def stride(self) -> float:
        """Seconds by which the arm may move on in this cycle: as `dt`, but of no more than two cycles.

        Its tendons stood still while cycles were missed. Around a bar a tenth of a second of bending at one go pulls
        them past their limit before a cycle sees the tension.
        """
        return min(self.dt, 2.0 / self.config.rates.cycle_hz)

    @property
    def elapsed(self) -> float:
        """Seconds in the present phase."""
        return self.t - self.state.since

    # --- the vehicle ---

    @property
    def vehicle_heard(self) -> bool:
        """Whether the autopilot's heartbeat still comes."""
        return self.facts.vehicle.heartbeat_age_s <= self.config.vehicle.heartbeat_timeout_s

    @cached_property
    def vehicle_fresh(self) -> bool:
        """Whether position and attitude are new enough to act on."""
        v = self.facts.vehicle
        limit = self.config.vehicle.state_timeout_s
        return v.position_age_s <= limit and v.attitude_age_s <= limit and self.vehicle_heard

    @property
    def external(self) -> bool:
        """Whether our set-points fly the vehicle."""
        return self.facts.vehicle.control is Control.EXTERNAL

    @property
    def wants_stream(self) -> bool:
        """Whether set-points go out in this phase.

        PX4 accepts the switch to external control only with a stream, and leaves it without one. ArduPilot needs
        none, holds by itself, and takes any set-point for the end of a take-off. But it flies on for seconds with the
        velocity and acceleration of the last one, so that one which moves is followed by some that rest.
        """
        moved = self.state.moved_at
        resting = moved is not None and self.t - moved < _COMES_TO_REST_S
        return self.config.vehicle.autopilot == "px4" or self.state.phase in MOVES_VEHICLE or resting

    @property
    def pilot_took_over(self) -> bool:
        """Whether the autopilot left our mode since the previous step, whoever made it."""
        return self.state.control is Control.EXTERNAL and not self.external

    @property
    def mount(self) -> Pose:
        """T_ba: the arm's base on the airframe."""
        return self.parameters.mount

    @cached_property
    def gravity_a(self) -> Vec3:
        """Gravity in the arm's base axes, m/s^2."""
        down_b = unrotate(self.facts.vehicle.attitude_wb, (0.0, 0.0, GRAVITY))
        x, y, z = (float(g) for g in self.mount.rotation.T @ np.asarray(down_b))
        return x, y, z

    # --- the arm ---

    @property
    def arm_above(self) -> bool:
        """Whether the arm points up from the vehicle, so that the vehicle can hang by it."""
        return float(self.mount.rotation[2, 2]) < _ABOVE

    @property
    def pulls(self) -> tuple[float, ...]:
        """Measured tendon displacements, m."""
        return tuple(tendon.pull for tendon in self.facts.tendons)

    @property
    def tensions(self) -> tuple[float, ...]:
        """Estimated tendon tensions, N."""
        return tuple(tendon.tension for tendon in self.facts.tendons)

    @cached_property
    def servos(self) -> tuple[tuple[str, TendonState | JawState], ...]:
        """What moves every tendon and the gripper, with its name for people."""
        tendons = tuple((f"tendon {i + 1}", tendon) for i, tendon in enumerate(self.facts.tendons))
        return tendons if self.jaws is None else (*tendons, ("gripper", self.jaws))

    @property
    def jaws(self) -> JawState | None:
        """The gripper that has a servo on the bus; None: there is none."""
        return None if self.facts.gripper is None else self.facts.gripper.jaws

    @property
    def heard(self) -> bool:
        """Whether every servo has been heard, and the autopilot where it moves the gripper."""
        silent = not self.facts.tendons or any(servo.silent for _, servo in self.servos)
        unknown = self.config.gripper_by == "autopilot" and self.facts.vehicle.heartbeat_age_s == math.inf
        return not (silent or unknown)

    @property
    def servo_fault(self) -> str | None:
        """The first servo fault in words."""
        for name, servo in self.servos:
            if servo.error_bits:
                return f"{name}: servo hardware error 0x{servo.error_bits:02x}"
            if servo.silent:
                return f"{name}: servo does not answer"
            if not servo.homed:
                return f"{name}: servo lost its turns (arm straight? then CLEAR_ERRORS)"
            if servo.torque and not servo.ready:
                return f"{name}: servo does not follow goals"
        return None

    @property
    def tendon_fault(self) -> str | None:
        """The first tendon that broke or jumped, in words."""
        return next((watched.fault for watched in self.state.watch if watched.fault), None)

    @cached_property
    def bend(self) -> tuple[float, float]:
        """Bend that the measured displacements stand for, rad.

        Servos that are silent, or lost their turns, may tell displacements that no arm can have. No cycle may fail on
        them, for orders lead out of that: what counts then is their differences, and no more than an arm may bend.
        """
        pulls, model = np.asarray(self.pulls), self.parameters.model
        try:
            x, y = model.bend_for_pull(pulls).tolist()
        except ModelError:
            x, y = bend_of_differences(model.parameters, pulls).tolist()
            most = min(self.config.limits.bend_max_rad / max(math.hypot(x, y), _TINY_RAD), 1.0)
            x, y = most * x, most * y
        return x, y

    @property
    def at_bend_goal(self) -> bool:
        """Whether the commanded bend has come to its goal: in a wrap the full one, in a release the straight arm."""
        return self.state.bend == self.state.bend_goal

    @property
    def bend_error(self) -> float:
        """Distance between commanded and measured bend, rad."""
        return math.hypot(self.bend[0] - self.state.bend[0], self.bend[1] - self.state.bend[1])

    # --- the bar ---

    @property
    def grasping(self) -> bool:
        """Whether an object is the target, and not a bar to perch on."""
        return self.state.task is Order.GRASP

    @property
    def gripping(self) -> bool:
        """Whether the object is to be taken by the gripper, from above, and not by the arm around it."""
        return self.grasping and bool(self.config.gripper_by)

    @property
    def bar(self) -> Bar:
        """The target of the present task: the bar, or the object as a bar."""
        return self.object if self.grasping else self.perch_bar

    @property
    def perch_bar(self) -> Bar:
        """The newest bar received, else the configuration's, where the estimator now says it is."""
        bar = self.facts.bar
        if bar is None:
            perch = self.config.perch
            bar = Bar(_point(perch.bar_position_m), _level(perch.bar_axis_deg), perch.bar_radius_m)
        return self._after_jumps(bar, self.facts.bar_age_s)

    @property
    def object(self) -> Bar:
        """The newest object received, else the configuration's, as a bar: its axis is x of the grasp frame."""
        target, grasp = self.facts.grasp_target, self.config.grasp
        axis = _level(grasp.object_axis_deg)
        if target is None:
            bar = Bar(_point(grasp.object_position_m), axis, grasp.object_radius_m)
        else:
            if target.attitude_wo is not None:
                axis = rotate(target.attitude_wo, (1.0, 0.0, 0.0))
            bar = Bar(target.position_w, axis, target.radius, target.covariance_w, target.direction_sigma)
        return self._after_jumps(bar, self.facts.grasp_target_age_s)

    def _after_jumps(self, bar: Bar, age: float) -> Bar:
        """A target told `age` seconds ago, moved with what the estimator has jumped since."""
        point = bar.point_w
        for at, leap in self.state.vigil.jumps:
            if self.t - age <= at:
                point = add(point, leap)
        return bar if point is bar.point_w else replace(bar, point_w=point)

    def base_offset_w(self, yaw: float) -> Vec3:
        """From the vehicle's centre of mass to the arm's base while it hovers at `yaw`, world axes."""
        x, y, z = self.config.mount.position_m
        return turn_by_yaw((x, y, z), yaw)

    def place(self, before_contact: float) -> Vec3:
        """Vehicle position at which the straight arm is `before_contact` metres short of touching the bar.

        The arm hangs so that the bar meets it at the configured arc length. A gripper comes from above: from where
        the object is between its jaws.
        """
        bar = self.bar
        perch = self.config.perch
        if self.gripping:
            down = self.parameters.model.parameters.L + self.config.gripper.depth_m + before_contact
            return sub(sub(bar.point_w, scale(self.straight_w, down)), self.base_offset_w(self.state.heading))
        back = before_contact + bar.radius + perch.disk_radius_m
        base = sub(bar.point_w, scale(self.ahead, back))
        base = sub(base, scale(self.straight_w, perch.contact_arc_m))
        return sub(base, self.base_offset_w(self.state.heading))

    @property
    def near_bar(self) -> bool:
        """Whether the arm of a vehicle on its way from the stand-off may touch the bar at any moment."""
        return dot(sub(self.place(0.0), self.facts.vehicle.position_w), self.ahead) <= _NEAR_M

    @property
    def standoff(self) -> Vec3:
        """Vehicle position at the stand-off: before the target, or on the way back before the place of the one met."""
        distance = self.config.perch.standoff_m
        if self.state.phase is Phase.DEPART:
            if self.state.contact_w is None:
                return self.contact_w
            return sub(self.contact_w, scale(self.straight_w if self.gripping else self.ahead, distance))
        return self.place(distance)

    @property
    def setting_down(self) -> Vec3:
        """Vehicle position as low as it may go to set an object down: where it was taken, or below where it hovers."""
        place, here = self.probe, self.facts.vehicle.position_w
        reference = self.state.reference
        away = norm((place[0] - here[0], place[1] - here[1], 0.0)) > _ELSEWHERE_M
        x, y, _ = (reference.position if reference is not None else here) if away else place
        return x, y, place[2] + (0.0 if math.isnan(self.state.load.now) else self.config.grasp.place_search_m)

    @property
    def speed_back(self) -> float:
        """Of the reference on the way back to the stand-off, m/s."""
        return min(self.config.perch.approach_speed_m_per_s, self.config.limits.vehicle_speed_m_per_s)

    @property
    def straight_w(self) -> Vec3:
        """Where the straight arm of the hovering vehicle points, world axes: +z of its base, down when below."""
        return turn_by_yaw(column(self.mount.rotation, 2), self.state.heading)

    @property
    def ahead(self) -> Vec3:
        """Horizontal unit vector from the stand-off towards the bar."""
        return (math.cos(self.state.heading), math.sin(self.state.heading), 0.0)

    @property
    def towards_bar_a(self) -> tuple[float, float]:
        """Direction of bending, base axes, in which a vehicle that faces the bar wraps it."""
        return self.parameters.towards_bar_a

    @property
    def grip_needed(self) -> float:
        """Tension that means gripped at the present bend, N: beyond the full wrap a free arm's own tension grows too.

        The outer tendon keeps the least tension, the inner has twice the bend's moment on top (model.md).
        """
        perch = self.config.perch
        beyond = max(math.hypot(*self.state.bend) - perch.wrap_bend_rad, 0.0)
        return perch.grip_tension_n + 2.0 * self.tension_swing(beyond)

    def tension_swing(self, theta: float) -> float:
        """By how much a free bend `theta`, rad, tightens its inner tendon and slackens its outer one, N (model.md).

        tau_i = T0 + swing cos(phi_i - delta).
        """
        arm = self.parameters.model.parameters
        return theta * arm.EI / (2.0 * arm.r * arm.L)

    @property
    def probe(self) -> Vec3:
        """Vehicle position when the pull test began."""
        return self.state.anchor.position_w if self.state.anchor else self.facts.vehicle.position_w

    @property
    def held_radius(self) -> float:
        """Radius of the bar that the arm is wrapped around, m, whatever is told of bars since."""
        anchor = self.state.anchor
        return self.bar.radius if anchor is None or anchor.bar_radius is None else anchor.bar_radius

    @property
    def held_axis_w(self) -> Vec3:
        """Its direction, unit, world axes."""
        anchor = self.state.anchor
        return self.bar.axis_w if anchor is None or anchor.bar_axis_w is None else anchor.bar_axis_w

    @property
    def rest(self) -> Vec3:
        """Vehicle position in which the anchored arm asks for nothing."""
        return self.probe if self.state.rest is None else self.state.rest

    @property
    def contact_w(self) -> Vec3:
        """Vehicle position at which bar or object was met; unknown, the vehicle stays."""
        if self.state.contact_w is not None:
            return self.state.contact_w
        reference = self.state.reference
        return self.facts.vehicle.position_w if reference is None else reference.position

    def far(self, place: Vec3 | None) -> bool:
        """Whether a place that is remembered of a bar is too far away to be where the arm is wrapped now."""
        most = _ELSEWHERE_M + self.config.perch.contact_arc_m
        return place is not None and norm(sub(place, self.facts.vehicle.position_w)) > most

    def without_far_bar(self) -> State:
        """Memory in which a bar that is elsewhere is forgotten: of another flight, or in another frame."""
        state = self.state
        anchor = None if state.anchor is None else state.anchor.position_w
        if not any(self.far(place) for place in (state.contact_w, anchor, state.rest)):
            return state
        return replace(state, contact_w=None, anchor=None, rest=None)

    def heading_to_bar(self) -> float:
        """Heading across the bar's axis, on the side on which the vehicle is now, rad."""
        bar = self.bar
        across: Vec3 = (-bar.axis_w[1], bar.axis_w[0], 0.0)
        towards = sub(bar.point_w, self.facts.vehicle.position_w)
        if dot(across, towards) < 0.0:
            across = scale(across, -1.0)
        return math.atan2(across[1], across[0])

    @property
    def moved(self) -> Vec3:
        """Vehicle displacement since the anchor was set, m, world axes."""
        if self.state.anchor is None:
            return (0.0, 0.0, 0.0)
        return sub(self.facts.vehicle.position_w, self.state.anchor.position_w)

    @property
    def slipped(self) -> float:
        """How far the anchored vehicle is from where it was asked to be, m."""
        return norm(sub(self.moved, self.state.offset))


def _point(position: tuple[float, ...]) -> Vec3:
    x, y, z = position
    return x, y, z


def _level(heading_deg: float) -> Vec3:
    heading = math.radians(heading_deg)
    return (math.cos(heading), math.sin(heading), 0.0)


def at(s: Situation, goal: Vec3, tolerance: float) -> bool:
    """Whether the vehicle itself is within `tolerance` metres of `goal` and slow."""
    vehicle = s.facts.vehicle
    return norm(sub(vehicle.position_w, goal)) <= tolerance and norm(vehicle.velocity_w) <= tolerance
