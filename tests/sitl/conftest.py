"""Real flight stacks, named by the environment: each test runs once for every one that is named."""

import os

import pytest

from arm_companion.sim.isolation import NotIsolated, isolate
from arm_companion.sim.sitl import BINARY_VARIABLES

NAMED = [stack for stack, variable in BINARY_VARIABLES.items() if os.environ.get(variable)]


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """One that is named and does not start fails; where none is named there is nothing to run."""
    if "stack" in metafunc.fixturenames:
        nothing = pytest.param(
            "none", marks=pytest.mark.skip(reason=f"name one in {' or '.join(BINARY_VARIABLES.values())}")
        )
        metafunc.parametrize("stack", NAMED or [nothing], scope="module")


@pytest.fixture(scope="session", autouse=True)
def _own_network() -> None:
    """Flight stacks listen on all addresses: nobody but the tests is to reach them."""
    if NAMED:
        try:
            isolate()
        except NotIsolated as reason:
            print(f"{reason}: the flight stacks' ports are open")
