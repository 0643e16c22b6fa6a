"""What counts as a hazard, and what is only not known."""

import math
from collections.abc import Callable

from arm_companion.mission import hazards
from arm_companion.mission.facts import Facts
from arm_companion.mission.situation import Parameters, Situation
from arm_companion.mission.state import Phase
from tests.unit.mission_rig import T0, memory, vehicle

Hovering = Callable[..., Facts]


def test_the_motors_of_an_autopilot_that_has_never_been_heard_are_not_said_to_stand(
    parameters: Parameters, hovering: Hovering
) -> None:
    for age, told in ((0.3, True), (9.0, True), (math.inf, False)):
        facts = vehicle(armed=False, heartbeat_age_s=age)(hovering())
        s = Situation(memory(Phase.PERCHED), facts, T0, parameters)
        assert (hazards.disarmed(s) is not None) is told
        assert (hazards.motors_stopped(s) is not None) is told
        stood = Situation(memory(Phase.PERCHED, armed=False), facts, T0, parameters)
        assert hazards.motors_stopped(stood) is None, "it does not stop twice"
