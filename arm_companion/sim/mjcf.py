"""The plant's MuJoCo model, written as MJCF from the configuration.

Axes: MuJoCo's world is z up with x north and y west, so NED turns into it by half a turn about x (`NED_TO_UP`).
Every body keeps its own axes: FRD for the airframe, the base frame of the arm (z from base to tip, x through
tendon 1) for base and links. Only what is expressed in the world changes sign at the border.

The arm is a chain of `disks` rigid links. Link i carries disk i and half an interval of backbone on either side;
the hinges between links sit in the middle of the intervals, one for each bending axis and one for torsion, with
the stiffness of one interval of rod (E I n / L and G J n / L). The order of the two bending hinges alternates, so
that the twist which two finite rotations leave behind cancels from one interval to the next.

Each tendon is a straight chord from hole to hole. Between two real disks, joined by an arc of angle phi, that chord
is l (1 - phi^2/24) - r phi long; between two disks joined by one hinge it is l (1 - phi^2/8) - r phi. The plant adds
the missing l phi^2/12 at run time (`chord_excess`), as length and as the force that belongs to it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from arm_companion.config.schema import ArmConfig, Config, MountConfig
from arm_companion.sim.jaws import jaws_length, jaws_mass, jaws_xml

NED_TO_UP = (1.0, -1.0, -1.0)  # diagonal of the half turn about x, its own inverse

AIRFRAME = "airframe"
FLIGHT = "flight"
MOUNT = "mount"
ARM_BASE = "arm base"
BAR = "bar"
OBJECT = "object"
CRADLES = "cradles"
TIP = "tip"
BENDING, TORSION = "bending", "torsion"  # first word of a hinge's name

GRAVITY = 9.81
# Share of critical damping grows with frequency: strain-rate damping of backbone and tendons, which gives the
# hanging arm's first mode (about 20 rad/s) 4 % and the chain's own stiff modes no chance to ring.
_BACKBONE_DAMPING_S = 0.003
_TENDON_DAMPING_S = 0.001
# Inertia in kg m^2 that each hinge adds against relative rotation. It lowers the chain's fastest modes, which no
# one sees, to what the step resolves; against the arm's slow modes (2e-4) it weighs under 1 %. Between links it
# is an internal couple, so it changes neither momentum nor the wrench on the airframe.
_ARMATURE = 1e-5

# A quadrotor of the 500 mm class; radii of gyration scale its inertia with the mass.
_GYRATION_M = (0.105, 0.105, 0.14)
_BODY_HALF_SIZE = (0.07, 0.07, 0.03)
_ROTOR_OFFSET = (0.18, 0.18, -0.05)
_ROTOR_RADIUS = 0.127
_FOOT_OFFSET = (0.16, 0.2)
_FOOT_RADIUS = 0.01
_LEAST_LEG = 0.2
_GROUND_MARGIN = 0.05
_BAR_HALF_LENGTH = 0.75
_DISK_HALF_THICKNESS = 0.002
_CRADLE_SHARE = 0.35  # of the object's length, from its middle to each cradle
_PLANK = (0.012, 0.03, 0.004)  # half sizes of a cradle's two planks, m

# Collision classes. The arm does not meet itself, and its first links, which the mount shields, not the airframe.
_GROUND, _BAR, _ARM, _AIRFRAME, _FEET = 1, 2, 4, 8, 16
ARM_GROUP = _ARM
_SHIELDED_LINKS = 3


@dataclass(frozen=True)
class Rod:
    """What the backbone's section gives: bending stiffness, torsion stiffness and mass per length."""

    bending: float  # E I, N m^2
    torsion: float  # G J, N m^2
    density: float  # kg/m


def rod(arm: ArmConfig) -> Rod:
    """Section of the round backbone, with the tendons' own mass spread along it."""
    d, e = arm.backbone.diameter_m, arm.backbone.youngs_modulus_pa
    second_moment = math.pi * d**4 / 64
    shear = e / (2 * (1 + arm.backbone.poisson_ratio))
    density = arm.mass.backbone_density_kg_m3 * math.pi * d**2 / 4 + arm.mass.tendons_kg / arm.length_m
    return Rod(e * second_moment, shear * 2 * second_moment, density)


def moving_mass(arm: ArmConfig) -> float:
    """Mass in kg of everything from the arm's base disk on: backbone, tendons, spacer disks, end disk."""
    return rod(arm).density * arm.length_m + arm.mass.disk_kg * (arm.disks - 1) + arm.mass.end_disk_kg


def tendon_stiffness(arm: ArmConfig) -> float:
    """Stiffness in N/m of one tendon, pulley to end disk, in series with its servo."""
    tendons = arm.tendons
    axial = tendons.youngs_modulus_pa * math.pi * tendons.diameter_m**2 / 4
    own = axial / (arm.length_m + tendons.routing_length_m)
    return 1 / (1 / own + 1 / tendons.servo_stiffness_n_per_m)


def stand_height(config: Config) -> float:
    """Height in m of the centre of mass over the ground when standing: the skids keep the straight arm clear."""
    mount, arm = config.mount, config.arm
    down = _rotation(mount)[2][2]  # z of the body along z of the base
    reach = mount.position_m[2] + max(0.0, down) * (arm.length_m + jaws_length(config)) + config.perch.disk_radius_m
    return max(_LEAST_LEG, reach + _GROUND_MARGIN)


def model_xml(config: Config) -> str:
    """The whole world as MJCF.

    Args:
        config: arm, mount, vehicle, disk radius, bar and step are taken from here.
    """
    bar = config.sim.bar
    x, y, z = up(bar.position_m)
    heading = -bar.axis_deg  # clockwise from north seen from above is negative about z up
    stand = stand_height(config)
    return f"""
<mujoco model="arm companion plant">
  <compiler angle="degree" autolimits="true" eulerseq="XYZ"/>
  <option timestep="{config.sim.step_s}" gravity="0 0 {-GRAVITY}" integrator="implicitfast"
          cone="elliptic" impratio="10" solver="Newton" iterations="20" tolerance="1e-9">
    <flag autoreset="disable" multiccd="disable"/>
  </option>
  <default>
    <geom contype="0" conaffinity="0"/>
    <default class="bar">
      <geom contype="{_BAR}" conaffinity="{_ARM | _AIRFRAME}" priority="1" solref="0.004 1" mass="0"/>
    </default>
  </default>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 1" pos="0 0 {-stand}" contype="{_GROUND}"
          conaffinity="{_FEET | _AIRFRAME | _ARM}" rgba=".75 .75 .72 1"/>
    <body name="{BAR}" mocap="true" pos="{x} {y} {z}" euler="0 0 {heading}">
      <geom name="{BAR}" class="bar" type="capsule" size="{bar.radius_m}" rgba=".45 .3 .15 1"
            fromto="{-_BAR_HALF_LENGTH} 0 0 {_BAR_HALF_LENGTH} 0 0" friction="{bar.friction} 0.005 0.0001"/>
    </body>
    <body name="{AIRFRAME}" quat="0 1 0 0">
      <freejoint name="{FLIGHT}"/>
{_airframe(config, stand)}
      <body name="{ARM_BASE}" pos="{_join(config.mount.position_m)}" quat="{_join(_quaternion(config.mount))}">
{_arm(config)}
      </body>
    </body>
{_object(config, stand)}
  </worldbody>
  <tendon>
{_tendons(config.arm)}
  </tendon>
</mujoco>"""


def chord_excess(arm: ArmConfig) -> float:
    """Length in m that every tendon gains over the hinged chain's, per squared radian of each bending hinge."""
    return arm.length_m / arm.disks / 12


def link(i: int) -> str:
    """Name of the body that carries disk i (1 is next to the base, `disks` the end disk)."""
    return f"link {i}"


def disk(i: int) -> str:
    """Name of the geom of disk i; 0 is the base disk."""
    return f"disk {i}"


def tendon(i: int) -> str:
    """Name of tendon i, counted from 0 in the configuration's order."""
    return f"tendon {i}"


def rotor(i: int) -> str:
    """Name of the disk that the propeller i, counted from 0, sweeps."""
    return f"rotor {i}"


def up(vector: Sequence[float]) -> tuple[float, float, float]:
    """World vector from NED to MuJoCo's z-up axes, or back."""
    return (vector[0] * NED_TO_UP[0], vector[1] * NED_TO_UP[1], vector[2] * NED_TO_UP[2])


def _object(config: Config, stand: float) -> str:
    """A cylinder that lies across two cradles on posts; an object of no mass does not exist."""
    thing = config.sim.object
    if not thing.mass_kg:
        return ""
    x, y, z = up(thing.position_m)
    post = max(z + stand - thing.radius_m * math.sqrt(2.0), 2.0 * _PLANK[2])  # length, from the ground up
    tangent = thing.radius_m + _PLANK[2]
    solid = f'contype="{_GROUND}" conaffinity="{_ARM | _AIRFRAME}" rgba=".6 .6 .55 1"'
    lines = [f'<body name="{CRADLES}" pos="{x} {y} {z}" euler="0 0 {-thing.axis_deg}">']
    for side in (-_CRADLE_SHARE * thing.length_m, _CRADLE_SHARE * thing.length_m):
        top = -thing.radius_m * math.sqrt(2.0)
        lines.append(
            f'<geom type="capsule" size="0.008" fromto="{side} 0 {top - post} {side} 0 {top - 0.016}" {solid}/>'
        )
        for slope in (45.0, -45.0):  # its upper face touches the cylinder
            a = math.radians(slope)
            place = f"{side} {-tangent * math.sin(a)} {-tangent * math.cos(a)}"
            lines.append(f'<geom type="box" size="{_join(_PLANK)}" pos="{place}" euler="{-slope} 0 0" {solid}/>')
    half = 0.5 * thing.length_m - thing.radius_m
    friction = f"{thing.friction} 0.005 0.0001"
    lines += [
        "</body>",
        f'<body name="{OBJECT}" pos="{x} {y} {z}" euler="0 0 {-thing.axis_deg}">',
        f'<freejoint name="{OBJECT}"/>',
        (
            f'<geom name="{OBJECT}" class="bar" type="capsule" size="{thing.radius_m}" mass="{thing.mass_kg}" '
            f'fromto="{-half} 0 0 {half} 0 0" conaffinity="{_ARM | _AIRFRAME | _GROUND}" friction="{friction}" '
            'rgba=".2 .4 .6 1"/>'
        ),
        "</body>",
    ]
    return _indent(lines, 4)


def _airframe(config: Config, stand: float) -> str:
    mass = config.vehicle.mass_kg - moving_mass(config.arm)
    inertia = [mass * k * k for k in _GYRATION_M]
    solid = f'contype="{_AIRFRAME}" rgba=".25 .3 .35 1"'
    x, y, z = _ROTOR_OFFSET
    neck = f"0 0 0 {_join(config.mount.position_m)}"  # the tendons run through it from servos to base disk
    lines = [
        f'<inertial pos="0 0 0" mass="{mass}" diaginertia="{_join(inertia)}"/>',
        f'<geom type="box" size="{_join(_BODY_HALF_SIZE)}" {solid}/>',
        f'<geom name="{MOUNT}" type="cylinder" size="{config.arm.pitch_radius_m}" fromto="{neck}" {solid}/>',
    ]
    for i, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, -1), (-1, 1))):
        lines.append(
            f'<geom name="{rotor(i)}" type="cylinder" size="{_ROTOR_RADIUS} 0.005" '
            f'pos="{sx * x} {sy * y} {z}" {solid}/>'
        )
        # The skids fold up in flight, as on camera drones: they meet the ground and nothing else.
        fx, fy = sx * _FOOT_OFFSET[0], sy * _FOOT_OFFSET[1]
        lines.append(
            f'<geom type="sphere" size="{_FOOT_RADIUS}" pos="{fx} {fy} {stand - _FOOT_RADIUS}" contype="{_FEET}"/>'
        )
    return _indent(lines, 6)


def _arm(config: Config) -> str:
    arm, section = config.arm, rod(config.arm)
    interval = arm.length_m / arm.disks
    lines = [_backbone(section, 0.0, interval / 2, _ARM), _disk(config, 0, 0.0, 0.0), *_holes(arm, "base", 0.0)]
    origin = interval / 2  # of a link in its parent: the middle of the interval between them
    for i in range(1, arm.disks + 1):
        last = i == arm.disks
        affinity = 0 if i <= _SHIELDED_LINKS else _AIRFRAME
        after = 0.0 if last else interval / 2
        mass = arm.mass.end_disk_kg - jaws_mass(config) if last else arm.mass.disk_kg
        middle = interval / 2  # height of the disk in its link
        lines += [
            f'<body name="{link(i)}" pos="0 0 {origin}">',
            *_hinges(section, interval, i),
            _backbone(section, 0.0, middle + after, _ARM, affinity),
            _disk(config, i, middle, mass, affinity),
            *_holes(arm, str(i), middle),
        ]
        origin = interval
    lines += [f'<site name="{TIP}" pos="0 0 {interval / 2}"/>', *jaws_xml(config, interval / 2, _ARM, _AIRFRAME)]
    lines += ["</body>"] * arm.disks
    return _indent(lines, 8)


def _hinges(section: Rod, interval: float, i: int) -> list[str]:
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    lines = []
    for name in "xyz" if i % 2 else "yxz":
        role = TORSION if name == "z" else BENDING
        k = (section.torsion if name == "z" else section.bending) / interval
        lines.append(
            f'<joint name="{role} {name} {i}" axis="{axes[name]}" stiffness="{k}" '
            f'damping="{k * _BACKBONE_DAMPING_S}" armature="{_ARMATURE}"/>'
        )
    return lines


def _backbone(section: Rod, start: float, end: float, contype: int, affinity: int = 0) -> str:
    return (
        f'<geom type="capsule" size="0.001" fromto="0 0 {start} 0 0 {end}" mass="{section.density * (end - start)}" '
        f'contype="{contype}" conaffinity="{affinity}" rgba=".6 .6 .65 1"/>'
    )


def _disk(config: Config, i: int, height: float, mass: float, affinity: int = 0) -> str:
    size = f"{config.perch.disk_radius_m} {_DISK_HALF_THICKNESS}"
    return (
        f'<geom name="{disk(i)}" type="cylinder" size="{size}" pos="0 0 {height}" '
        f'mass="{mass}" contype="{_ARM}" conaffinity="{affinity}" rgba=".8 .45 .1 1"/>'
    )


def _holes(arm: ArmConfig, name: str, height: float) -> list[str]:
    lines = []
    for t, angle in enumerate(arm.tendons.angles_deg):
        x = arm.pitch_radius_m * math.cos(math.radians(angle))
        y = arm.pitch_radius_m * math.sin(math.radians(angle))
        lines.append(f'<site name="hole {t} {name}" pos="{x} {y} {height}" size="0.001"/>')
    return lines


def _tendons(arm: ArmConfig) -> str:
    k = tendon_stiffness(arm)
    names = ["base", *(str(i) for i in range(1, arm.disks + 1))]
    lines = []
    for t in range(len(arm.tendons.angles_deg)):
        lines.append(
            f'<spatial name="{tendon(t)}" stiffness="{k}" damping="{k * _TENDON_DAMPING_S}" '
            f'springlength="0 {arm.length_m}" width="0.0006">'
        )
        lines += [f'  <site site="hole {t} {name}"/>' for name in names]
        lines.append("</spatial>")
    return _indent(lines, 4)


def _rotation(mount: MountConfig) -> list[list[float]]:
    """Axes of the arm base in body axes, as columns: R_z(yaw) R_y(pitch) R_x(roll)."""
    w, x, y, z = _quaternion(mount)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def _quaternion(mount: MountConfig) -> tuple[float, float, float, float]:
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(a), math.sin(a)) for a in (math.radians(angle) / 2 for angle in mount.rpy_deg)
    )
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _join(values: tuple[float, ...] | list[float]) -> str:
    return " ".join(repr(float(v)) for v in values)


def _indent(lines: list[str], columns: int) -> str:
    return "\n".join(" " * columns + line for line in lines)
