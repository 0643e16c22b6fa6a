"""Draws a flight off-screen and hands the pictures to ffmpeg: `python -m arm_companion.sim.film_render POSES FFMPEG`.

A process of its own, since OpenGL is chosen by an environment variable before MuJoCo is imported, and a driver that
crashes must not take the flight's verdict along. Without words it only tries whether there is OpenGL.
"""

import math
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import mujoco
import numpy as np
import numpy.typing as npt

from arm_companion.sim.film import HEIGHT, WIDTH
from arm_companion.sim.mjcf import AIRFRAME

_NEAR_M: Final = 1.5
_FOLLOW: Final = 0.1  # share of its way that the camera makes from frame to frame
_TRIAL: Final = "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"

Array = npt.NDArray[np.float64]


def studio(xml: str) -> Any:
    """The model with light and sky, light enough to be drawn by a processor."""
    spec = mujoco.MjSpec.from_string(xml)
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.62, 0.75, 0.9],
        rgb2=[0.9, 0.93, 0.96],
        width=64,
        height=64,
    )
    spec.worldbody.add_light(pos=[0.0, 0.0, 6.0], dir=[0.2, 0.3, -1.0], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    model = spec.compile()
    model.vis.global_.offwidth, model.vis.global_.offheight = WIDTH, HEIGHT
    model.vis.quality.offsamples = 0  # smoothing triples the time
    model.vis.quality.numslices = 16
    model.vis.headlight.ambient[:] = 0.4
    return model


class Stage:
    """The model in its poses, seen by a camera that keeps vehicle and bar in view."""

    def __init__(self, model: Any) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._airframe = model.body(AIRFRAME).id
        self._renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        self._camera = mujoco.MjvCamera()
        w, _, _, z = self._data.mocap_quat[0].tolist()
        along_bar = math.degrees(2.0 * math.atan2(z, w))
        self._camera.distance, self._camera.azimuth, self._camera.elevation = 1.25, along_bar + 25.0, -8.0
        self._look: Array | None = None

    def picture(self, qpos: Array, bar: Array) -> bytes:
        """One frame, RGB, `HEIGHT` rows of `WIDTH` pixels."""
        data = self._data
        data.qpos[:], data.mocap_pos[0] = qpos, bar
        mujoco.mj_kinematics(self._model, data)
        mujoco.mj_comPos(self._model, data)
        mujoco.mj_tendon(self._model, data)
        mujoco.mj_camlight(self._model, data)
        vehicle = data.xpos[self._airframe]
        goal = vehicle.copy()
        if np.linalg.norm(bar - vehicle) < _NEAR_M:
            goal = 0.5 * (vehicle + bar)
        self._look = goal if self._look is None else self._look + _FOLLOW * (goal - self._look)
        self._camera.lookat[:] = self._look
        self._renderer.update_scene(data, self._camera)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        pixels: bytes = self._renderer.render().tobytes()
        return pixels


def main(words: list[str]) -> int:
    """Draw, or try whether it could be done; the exit code is ffmpeg's."""
    if not words:
        mujoco.Renderer(mujoco.MjModel.from_xml_string(_TRIAL), 16, 16).render()
        return 0
    with np.load(Path(words[0])) as poses:
        xml, qpos, bar = str(poses["xml"]), poses["qpos"], poses["bar"]
    stage = Stage(studio(xml))
    with subprocess.Popen(words[1:], stdin=subprocess.PIPE) as encoder:  # noqa: S603 - as `film` puts it together
        if encoder.stdin is None:
            return 1
        try:
            for one, where in zip(qpos, bar, strict=True):
                encoder.stdin.write(stage.picture(one, where))
        except BrokenPipeError:  # it has said why
            pass
        encoder.stdin.close()
        return encoder.wait()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
