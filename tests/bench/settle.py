"""The plant's chain of links, held at both ends and left to settle: MuJoCo's way to the same answer."""

import xml.etree.ElementTree as ET

import mujoco
import numpy as np

from arm_companion.config import Config
from arm_companion.sim import mjcf

_AT_REST = 2e-5  # rad/s or m/s, of any hinge
_LONGEST = 20_000  # steps
_DAMPING = 4.0  # times the plant's: about critical, the quickest way to rest


class SettlingChain:
    """The arm between a fixed carrier and a vise; every answer starts from where the last one came to rest."""

    def __init__(self, config: Config, pull: np.ndarray) -> None:
        self.arm = config.arm
        self.model = model = mujoco.MjModel.from_xml_string(_held(mjcf.model_xml(config), config))
        self.data = mujoco.MjData(model)
        model.dof_damping[:] *= _DAMPING
        self.tip = model.body(mjcf.link(self.arm.disks)).id
        self.base = model.body(mjcf.ARM_BASE).id
        self.k = mjcf.tendon_stiffness(self.arm)
        hinges = [i for i in range(model.njnt) if model.joint(i).name.startswith(mjcf.BENDING)]
        self.hinges, self.places = np.array(hinges), model.jnt_qposadr[hinges]
        self.bending = float(model.jnt_stiffness[hinges[0]])
        self.pull = pull
        self.data.eq_active[0] = 0
        mujoco.mj_forward(model, self.data)
        self._rest()
        # The vise takes the tip where it hangs.
        self.start = self.data.xpos[self.tip].copy()
        self.data.mocap_pos[:] = self.start
        self.data.mocap_quat[:] = self.data.xquat[self.tip]
        self.data.eq_active[0] = 1
        self._rest()

    def solve(self, base_move: np.ndarray) -> np.ndarray:
        """Wrench (6,) on the carrier at the base point after the base moved (3,), m, base axes."""
        R = self.data.xmat[self.base].reshape(3, 3)
        self.data.mocap_pos[:] = self.start - R @ base_move
        self._rest()
        mujoco.mj_rnePostConstraint(self.model, self.data)
        wrench = self.data.cfrc_int[self.base]  # torque, force by the airframe on the arm, about the tree's centre
        root = self.model.body_rootid[self.base]
        centre = self.data.subtree_com[root] - self.data.xpos[self.base]
        force = -wrench[3:]
        torque = -wrench[:3] + np.cross(centre, force)
        return np.concatenate((R.T @ force, R.T @ torque))

    def _rest(self) -> None:
        model, data, arm = self.model, self.data, self.arm
        excess = mjcf.chord_excess(arm)
        for step in range(_LONGEST):
            stretch = data.ten_length - model.tendon_lengthspring[:, 1]
            total = float(np.maximum(0.0, self.k * stretch).sum())
            bend = data.qpos[self.places]
            model.jnt_stiffness[self.hinges] = self.bending + 2 * excess * total
            rest = arm.length_m - arm.tendons.pretension_n / self.k - excess * float(bend @ bend)
            model.tendon_lengthspring[:, 1] = rest - self.pull
            mujoco.mj_step(model, data)
            if step > 50 and float(np.abs(data.qvel).max()) < _AT_REST:
                break
        mujoco.mj_forward(model, data)


def _held(xml: str, config: Config) -> str:
    """The plant's world with the airframe fixed and a vise, switched off, for the end link."""
    world = ET.fromstring(xml)  # our own text
    body = world.find("worldbody")
    airframe = next(b for b in body.iter("body") if b.get("name") == mjcf.AIRFRAME)
    airframe.remove(airframe.find("freejoint"))
    ET.SubElement(body, "body", name="vise", mocap="true")
    for mocap in body.findall("body"):
        if mocap.get("name") == mjcf.BAR:
            body.remove(mocap)
    equality = ET.SubElement(world, "equality")
    last = mjcf.link(config.arm.disks)
    ET.SubElement(
        equality, "weld", body1="vise", body2=last, relpose="0 0 0 1 0 0 0", solref="0.002 1", solimp="0.99 0.999 1e-4"
    )
    return ET.tostring(world, encoding="unicode")
