"""The gripper of the plant: two jaws that slide on the end disk, each on a spring from where its drive wants it.

What is simplified: jaws slide in a straight line, driven through springs of equal stiffness, so that it is these that
centre an object and no gear; whatever turns the horn's motion into theirs has no mass, no play and no friction besides
the servo's own, and no cable of it runs through the arm. Pads, contact and friction are the engine's.
"""

import mujoco
import numpy as np
import numpy.typing as npt

from arm_companion.config.schema import Config, GripperConfig
from arm_companion.errors import ConfigError
from arm_companion.protocol.control_table import TICK_RAD

SIDES = (1.0, -1.0)
_STIFFNESS = 3000.0  # N/m, of each jaw's drive
_DAMPING = 6.0  # N s/m
_PAD = (0.004, 0.02)  # half sizes of a pad: thickness, width, m
_NO_SLIP = 10
_OUTPUT_S = 1.5  # from open to closed, of a gripper on the autopilot's output
_OUTPUT_FORCE_N = 30.0  # of both jaws, at which it stalls

Array = npt.NDArray[np.float64]


def jaw(i: int) -> str:
    """Name of body, joint and pad of jaw i, 0 or 1."""
    return f"jaw {i}"


def jaws_xml(config: Config, height: float, contype: int, affinity: int) -> list[str]:
    """Bodies of the jaws, in the axes of the link that carries the end disk `height` m up; none without a gripper."""
    if not config.gripper_by:
        return []
    real = config.sim.gripper
    thickness, width = _PAD
    lines = []
    for i, side in enumerate(SIDES):
        away = side * (0.5 * real.opening_m + thickness)
        spring = f'range="0 {0.5 * real.opening_m}" limited="true" stiffness="{_STIFFNESS}" damping="{_DAMPING}"'
        pad = f'size="{thickness} {width} {0.5 * real.length_m}" pos="{away} 0 {0.5 * real.length_m}"'
        solid = f'contype="{contype}" conaffinity="{affinity}" rgba=".3 .3 .35 1"'
        lines += [
            f'<body name="{jaw(i)}" pos="0 0 {height}">',
            f'<joint name="{jaw(i)}" type="slide" axis="{-side} 0 0" {spring}/>',
            f'<geom name="{jaw(i)}" type="box" {pad} mass="{real.jaw_kg}" {solid}/>',
            "</body>",
        ]
    return lines


def jaws_mass(config: Config) -> float:
    """Mass of both, kg, that the end disk's includes; 0 without a gripper.

    Raises:
        ConfigError: the end disk is lighter.
    """
    mass = 2.0 * config.sim.gripper.jaw_kg if config.gripper_by else 0.0
    if mass >= config.arm.mass.end_disk_kg:
        raise ConfigError(
            f"arm.mass.end_disk_kg = {config.arm.mass.end_disk_kg:g} does not hold both jaws, sim.gripper.jaw_kg each"
        )
    return mass


def jaws_length(config: Config) -> float:
    """How far they reach beyond the end disk, m; 0 without a gripper."""
    return config.sim.gripper.length_m if config.gripper_by else 0.0


class Jaws:
    """The jaws in MuJoCo's memory."""

    def __init__(self, config: Config, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        joints = [model.joint(jaw(i)) for i in range(len(SIDES))]
        self._at = np.array([model.jnt_qposadr[joint.id] for joint in joints])
        self.geoms = np.array([model.geom(jaw(i)).id for i in range(len(SIDES))])
        self._springs, self._qpos = model.qpos_spring, data.qpos
        self._way = 0.5 * config.sim.gripper.opening_m
        model.opt.noslip_iterations = _NO_SLIP  # else a load creeps in the pads, by a degree a second

    def drive(self, closed: float) -> None:
        """Pull towards a share of the way: 0 open, 1 closed."""
        self._springs[self._at] = closed * self._way

    @property
    def force(self) -> float:
        """Sum of what the drive exerts on both, N, positive when closing."""
        return float(_STIFFNESS * np.sum(self._springs[self._at] - self._qpos[self._at]))


class ServoDrive:
    """Jaws on the horn of a servo."""

    def __init__(self, config: GripperConfig, opening_m: float) -> None:
        self._open, self._travel = config.open_ticks, config.closed_ticks - config.open_ticks
        self._lever = 0.5 * opening_m / (self._travel * TICK_RAD)  # m of each jaw for a radian of the horn

    def closed(self, position: float) -> float:
        """Share of the way at a position of the horn, ticks."""
        return (position - self._open) / self._travel

    def torque(self, force: float) -> float:
        """What the jaws' force puts on the horn, N m, against growing positions."""
        return force * self._lever


class OutputDrive:
    """Jaws on an output of the autopilot: a motor with a speed and a force, that tells nothing."""

    def __init__(self) -> None:
        self.closed = 0.0

    def advance(self, *, closing: bool, force: float, dt: float) -> float:
        """Share of the way after `dt` s, with both jaws' present force, N."""
        step = dt / _OUTPUT_S
        if not closing:
            self.closed = max(self.closed - step, 0.0)
        elif force < _OUTPUT_FORCE_N:
            self.closed = min(self.closed + step, 1.0)
        return self.closed
