"""The physics: an airframe with a continuum arm, a bar and the ground, stepped by MuJoCo.

The mechanics here are the plant's own (`mjcf`); nothing is shared with the model that the daemon flies with.
NED outside, MuJoCo's z-up world inside: every world vector changes sign in y and z at this border, while body
vectors are FRD on both sides. The world's origin is the airframe's centre of mass where it stands on its skids.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from arm_companion.config.schema import Config
from arm_companion.errors import ModelError
from arm_companion.sim import mjcf
from arm_companion.sim.jaws import Jaws
from arm_companion.sim.ports import NOTHING, PlantTruth, RigidState, RotorCommand, Touch, Vec3

# Rotor drag of a small quadrotor is near linear in the air speed: 2 m/s of wind push with 0.5 N.
_DRAG_N_PER_M_S = 0.25
_ROTARY_DRAG_NM_PER_RAD_S = 0.01

_CUT_M = 100.0  # longer than any servo winds up

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Pose:
    """Where everything is, in MuJoCo's own terms: enough to draw it."""

    qpos: Array
    bar: Array  # (3,), m, MuJoCo's world


class Plant:
    """The simulated world. One `step` advances it by `config.sim.step_s`; nothing in it is random.

    A tendon's tension is max(0, T0 + k (l - L + pull)): elastic, pull-only, with l the length of its path along
    the arm and k the stiffness of tendon and servo in series.
    """

    def __init__(self, config: Config) -> None:
        self._stiffness = mjcf.tendon_stiffness(config.arm)
        self._wind = mjcf.up(config.sim.wind_m_per_s)
        self._push: Vec3 = (0.0, 0.0, 0.0)
        self._model = model = mujoco.MjModel.from_xml_string(mjcf.model_xml(config))
        self._data = mujoco.MjData(model)
        self._damping = float(model.tendon_damping[0])
        self._dt = float(model.opt.timestep)
        self._airframe = model.body(mjcf.AIRFRAME).id
        self._base = model.body(mjcf.ARM_BASE).id
        self._object = model.body(mjcf.OBJECT).id if config.sim.object.mass_kg else -1
        # what the arm holds in this world: the object, where there is one, else the bar
        self._bar = model.body(mjcf.BAR).id if self._object < 0 else self._object
        self._ground = {0} if self._object < 0 else {0, model.body(mjcf.CRADLES).id}
        self._tip = model.site(mjcf.TIP).id
        self._disks = np.array([model.geom(mjcf.disk(i)).id for i in range(config.arm.disks + 1)])
        self._mount = model.geom(mjcf.MOUNT).id
        # for every geom: whether it is one of these
        geoms = np.arange(model.ngeom)
        self._of_airframe = model.geom_bodyid == self._airframe
        self._of_ground = np.isin(model.geom_bodyid, list(self._ground))
        self._outside = self._of_ground | (model.geom_bodyid == self._bar)
        self._rotors = np.isin(geoms, [model.geom(mjcf.rotor(i)).id for i in range(4)])
        # Number of the link that owns each geom, base 0, and -1 where a geom is no part of the arm.
        self._link_of_geom = np.full(model.ngeom, -1)
        for i in range(config.arm.disks + 1):
            body = self._base if i == 0 else model.body(mjcf.link(i)).id
            self._link_of_geom[model.geom_bodyid == body] = i
        self.jaws = Jaws(config, model, self._data) if config.gripper_by else None
        if self.jaws is not None:  # they are a part of the end disk
            self._link_of_geom[self.jaws.geoms] = config.arm.disks
        # bending and torsion hinges of every link: the torsion is the third, whichever bending axis comes first
        hinges = [i for i in range(model.njnt) if model.joint(i).name.startswith((mjcf.BENDING, mjcf.TORSION))]
        first, angle = hinges[0], model.jnt_qposadr[hinges[0]]
        self._bend = self._data.qpos[angle : angle + len(hinges)].reshape(-1, 3)[:, :2]
        self._hinge_stiffness = model.jnt_stiffness[first : first + len(hinges)].reshape(-1, 3)[:, :2]
        self._bending_stiffness = float(self._hinge_stiffness[0, 0])
        self._excess = mjcf.chord_excess(config.arm)
        self._straight_rest = config.arm.length_m - config.arm.tendons.pretension_n / self._stiffness
        # views of MuJoCo's own memory, made once because a step asks for them all
        self._qpos, self._qvel, self._applied = self._data.qpos, self._data.qvel, self._data.qfrc_applied[:6]
        self._cut, self._acceleration = self._data.cfrc_int[self._base], self._data.qacc
        self._centre, self._place = self._data.subtree_com[self._airframe], self._data.xpos[self._airframe]
        self._turn = self._data.xmat[self._airframe].reshape(3, 3).T
        self._lengths, self._rest = self._data.ten_length, model.tendon_lengthspring[:, 1]
        self._tendon_damping = model.tendon_damping
        self._longer = np.zeros(model.ntendon)  # m, by what has happened to each tendon
        self._velocity_before = np.zeros(model.nv)
        self._truth: PlantTruth | None = None
        self._wrenches: list[tuple[Vec3, Vec3]] = []  # of the steps since the mean was asked for
        self._touch = self._touched = NOTHING
        mujoco.mj_forward(model, self._data)
        self._set_pulls((0.0,) * model.ntendon)
        self._data.qacc[:] = 0.0
        self._wrench = self._interface_wrench()

    @property
    def time(self) -> float:
        """Simulated time since construction, s."""
        return float(self._data.time)

    def step(self, rotors: RotorCommand, pulls: Sequence[float]) -> None:
        """Advance by one physics step.

        Args:
            rotors: thrust and torque on the airframe during the step.
            pulls: m of each tendon taken in from where the straight arm has its pretension.

        Raises:
            ModelError: when the motion has diverged or a command is no finite number.
            ValueError: when there is not one pull for each tendon.
        """
        w, x, y, z = self._qpos[3:7].tolist()
        vx, vy, vz, p, q, r = self._qvel[:6].tolist()
        if len(pulls) != len(self._rest):
            raise ValueError(f"{len(pulls)} pulls for {len(self._rest)} tendons")
        if not math.isfinite(sum((vx, vy, vz, p, q, r, rotors.thrust_n, *rotors.torque_b, *pulls))):
            raise ModelError(f"the plant diverged at {self.time:.3f} s, or was commanded what is no number")
        thrust = -rotors.thrust_n
        self._applied[:] = (
            thrust * 2 * (x * z + w * y) - _DRAG_N_PER_M_S * (vx - self._wind[0]) + self._push[0],
            thrust * 2 * (y * z - w * x) - _DRAG_N_PER_M_S * (vy - self._wind[1]) + self._push[1],
            thrust * (1 - 2 * (x * x + y * y)) - _DRAG_N_PER_M_S * (vz - self._wind[2]) + self._push[2],
            rotors.torque_b[0] - _ROTARY_DRAG_NM_PER_RAD_S * p,
            rotors.torque_b[1] - _ROTARY_DRAG_NM_PER_RAD_S * q,
            rotors.torque_b[2] - _ROTARY_DRAG_NM_PER_RAD_S * r,
        )
        self._set_pulls(pulls)
        self._velocity_before[:] = self._qvel
        self._truth = None
        mujoco.mj_step(self._model, self._data)
        self._wrench = self._interface_wrench()
        self._wrenches.append(self._wrench)
        self._touched = self._touched.and_then(self._touch)

    def state(self) -> RigidState:
        """True motion of the airframe now; the specific force is the last step's mean."""
        *position, w, x, y, z = self._qpos[:7].tolist()
        vx, vy, vz, p, q, r = self._qvel[:6].tolist()
        acceleration = (self._qvel[:3] - self._velocity_before[:3]) / self._dt
        acceleration[2] += mjcf.GRAVITY
        return RigidState(
            position_w=mjcf.up(position),
            velocity_w=mjcf.up((vx, vy, vz)),
            attitude_wb=_upright(-x, w, -z, y),  # (0, 1, 0, 0) * (w, x, y, z)
            rate_b=(p, q, r),
            specific_force_b=_vec3(_matrix(w, x, y, z).T @ acceleration),
        )

    def pose(self) -> Pose:
        """Where everything is now."""
        return Pose(self._qpos.copy(), self._data.mocap_pos[0].copy())

    def tensions(self) -> tuple[float, ...]:
        """Tension in N of each tendon, as it acted during the last step."""
        return tuple((self._stiffness * np.maximum(0.0, self._lengths - self._rest)).tolist())

    def truth(self) -> PlantTruth:
        """What only a simulation can know: wrench and contacts are those of the last step."""
        if self._truth is None:
            self._truth = self._measure()
        return self._truth

    def mean_wrench(self) -> tuple[Vec3, Vec3]:
        """Force and torque of `truth` as means over the steps since this was asked last.

        A wrap that slips strikes for milliseconds: one step's force says nothing of what the airframe felt.
        """
        if not self._wrenches:
            return self._wrench
        force, torque = np.add.reduce(self._wrenches) / len(self._wrenches)
        self._wrenches.clear()
        return _vec3(force), _vec3(torque)

    def touched(self) -> Touch:
        """What the airframe touched in the steps since this was asked last: a bump is over within milliseconds."""
        touched, self._touched = self._touched, NOTHING
        return touched

    def move_bar(self, position_w: Sequence[float]) -> None:
        """Put the bar elsewhere, with its heading kept.

        Args:
            position_w: a point on its axis, m, NED.
        """
        self._data.mocap_pos[0] = mjcf.up(position_w)

    def blow(self, wind_w: Sequence[float]) -> None:
        """Let the wind blow like this from now on.

        Args:
            wind_w: m/s, NED.
        """
        self._wind = mjcf.up(wind_w)

    def push(self, force_w: Sequence[float]) -> None:
        """Push the airframe at its centre of mass until told otherwise.

        Args:
            force_w: N, NED; zeros end the push.
        """
        self._push = mjcf.up(force_w)

    def cut_tendon(self, i: int) -> None:
        """Cut tendon `i`, counted from 0: it pulls no more, whatever its servo does."""
        self._longer[i] = _CUT_M

    def slip_tendon(self, i: int, longer: float) -> None:
        """Let tendon `i` jump: from now on it is `longer` m longer (negative: shorter) for the same pull."""
        self._longer[i] += longer

    def lose_object(self) -> None:
        """Let the object slip out of the arm: from now on the two do not meet."""
        geom = self._model.geom(mjcf.OBJECT)
        geom.conaffinity[0] &= ~mjcf.ARM_GROUP
        for i in np.flatnonzero(self._link_of_geom >= 0):
            self._model.geom_conaffinity[i] &= ~int(geom.contype[0])

    def _set_pulls(self, pulls: Sequence[float]) -> None:
        """Set the tendon springs' rest lengths, beyond which a tendon pulls; a slack tendon does not damp either.

        The arcs between the disks are longer than the hinged chain by `chord_excess` for every squared radian of
        a hinge: that goes into the rest length, and its derivative, tension times angle, is a spring in the hinge.
        """
        lengths, rest, bend = self._lengths, self._rest, self._bend
        total = self._stiffness * sum(longer for longer in (lengths - rest).tolist() if longer > 0.0)
        self._hinge_stiffness[:] = self._bending_stiffness + 2 * self._excess * total
        straight = self._straight_rest - self._excess * float(np.einsum("ij,ij->", bend, bend))
        np.subtract(straight + self._longer, pulls, out=rest)
        np.multiply(lengths > rest, self._damping, out=self._tendon_damping)

    def _measure(self) -> PlantTruth:
        model, data = self._model, self._data
        force, torque = self._wrench
        contact, net, wrap = self._bar_contact()
        geoms = data.contact.geom
        ground = self._of_ground[geoms].any(axis=1)
        thing = (model.geom_bodyid[geoms] == self._object).any(axis=1)
        tension = self.tensions()
        mujoco.mj_kinematics(model, data)  # the tip where it is after the step, as in `state`
        return PlantTruth(
            force_b=force,
            torque_b=torque,
            contact_force_n=contact,
            contact_net_w=net,
            wrap_angle=wrap,
            tension=tension,
            tip_position_w=mjcf.up(data.site_xpos[self._tip].tolist()),
            body_contact=self._touch.body,
            mount_only=self._touch.mount_only,
            rotor_contact=self._touch.rotor,
            object_position_w=None if self._object < 0 else mjcf.up(data.xpos[self._object].tolist()),
            object_supported=bool(np.any(thing & ground)),
        )

    def _interface_wrench(self) -> tuple[Vec3, Vec3]:
        """Force and torque of the arm on the airframe about its centre of mass, body axes.

        Newton-Euler from the tip to the base, at the step's start but with the accelerations that the step
        really made: under implicit integration they differ from the forward dynamics' own.
        """
        model, data = self._model, self._data
        velocity = self._qvel.copy()
        np.subtract(velocity, self._velocity_before, out=self._acceleration)
        self._acceleration /= self._dt
        self._qvel[:] = self._velocity_before
        mujoco.mj_rnePostConstraint(model, data)
        self._qvel[:] = velocity
        # torque, force of the airframe on the arm, about the tree's centre
        tx, ty, tz, fx, fy, fz = self._cut.tolist()
        x, y, z = (self._centre - self._place).tolist()
        force = (-fx, -fy, -fz)
        torque = (z * fy - y * fz - tx, x * fz - z * fx - ty, y * fx - x * fy - tz)
        self._touch = NOTHING
        if data.ncon and self._of_airframe[data.contact.geom].any():
            self._touch = self._look_at_airframe()
            pushed, twisted = self._arm_against_airframe()
            force, torque = _vec3(pushed + force), _vec3(twisted + torque)
        turn = self._turn.tolist()
        return _turned(turn, force), _turned(turn, torque)

    def _look_at_airframe(self) -> Touch:
        """What the airframe touches in this step."""
        geoms = self._data.contact.geom
        touching = self._outside[geoms].any(axis=1) & self._of_airframe[geoms].any(axis=1)
        by_mount = (geoms == self._mount).any(axis=1)
        return Touch(
            by_mount=bool((touching & by_mount).any()),
            elsewhere=bool((touching & ~by_mount).any()),
            rotor=bool(self._rotors[geoms].any()),
        )

    def _arm_against_airframe(self) -> tuple[Array, Array]:
        """Force and torque, world axes up, about the airframe's centre of mass, of links that lie against it."""
        model, data = self._model, self._data
        force, torque, result = np.zeros(3), np.zeros(3), np.zeros(6)
        for i in range(data.ncon):
            contact = data.contact[i]
            one, other = contact.geom
            first = model.geom_bodyid[one] == self._airframe
            link = self._link_of_geom[other if first else one]
            if not (first or model.geom_bodyid[other] == self._airframe) or link < 0 or contact.efc_address < 0:
                continue
            mujoco.mj_contactForce(model, data, i, result)
            # the contact's frame points from its first geom to its second, and the force acts on the second
            push = (-1.0 if first else 1.0) * contact.frame.reshape(3, 3).T @ result[:3]
            force += push
            torque += np.cross(contact.pos - data.xpos[self._airframe], push)
        return force, torque

    def _bar_contact(self) -> tuple[float, Vec3, float]:
        """Sum of normal forces, net force on the arm (NED) and wrap angle of the arm's contacts with the bar."""
        model, data = self._model, self._data
        total, net = 0.0, np.zeros(3)
        touching: set[int] = set()
        result = np.zeros(6)
        for i in range(data.ncon):
            contact = data.contact[i]
            one, other = contact.geom
            bar_first = model.geom_bodyid[one] == self._bar
            if not bar_first:
                one, other = other, one
            number = int(self._link_of_geom[other])
            if model.geom_bodyid[one] != self._bar or number < 0 or contact.efc_address < 0:
                continue
            mujoco.mj_contactForce(model, data, i, result)
            if result[0] <= 0.0:
                continue
            total += result[0]
            # the contact's frame points from its first geom to its second
            net += (1.0 if bar_first else -1.0) * contact.frame.reshape(3, 3).T @ result[:3]
            touching.add(number)
        return float(total), mjcf.up(net.tolist()), self._span(touching)

    def _span(self, touching: set[int]) -> float:
        """Angle about the bar's axis from the first touching disk to the last, counted along the arm."""
        if not touching:
            return 0.0
        data = self._data
        disks = data.geom_xpos[self._disks[min(touching) : max(touching) + 1]]
        _, y, z = data.xmat[self._bar].reshape(3, 3).T @ (disks - data.xpos[self._bar]).T
        angles = np.unwrap(np.arctan2(z, y))
        return float(abs(angles[-1] - angles[0]))


def _matrix(w: float, x: float, y: float, z: float) -> Array:
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
    )


def _upright(w: float, x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """The one of a rotation's two quaternions that has w >= 0."""
    return (w, x, y, z) if w >= 0 else (-w, -x, -y, -z)


def _turned(rotation: list[list[float]], v: Vec3) -> Vec3:
    x, y, z = v
    a, b, c = rotation
    return (a[0] * x + a[1] * y + a[2] * z, b[0] * x + b[1] * y + b[2] * z, c[0] * x + c[1] * y + c[2] * z)


def _vec3(v: Array) -> Vec3:
    x, y, z = v.tolist()
    return (x, y, z)
