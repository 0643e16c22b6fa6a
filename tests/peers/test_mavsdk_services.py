"""MAVSDK's parameter and file clients against our component, over both parameter protocols."""

import asyncio
import contextlib
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any

import pytest
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk
from mavsdk.asyncio.plugins.ftp import FtpAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.plugins.param import ParamError, ProtocolVersion

from arm_companion.config import Config
from arm_companion.config.parameters import PARAMETERS
from arm_companion.drivers.component_metadata import metadata_files

pytestmark = pytest.mark.realtime

Serve = Callable[[], AbstractAsyncContextManager[Any]]


async def found(mavsdk: Mavsdk, port: int) -> Any:
    """The system that our component belongs to."""
    await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
    async with asyncio.timeout(10.0):
        while not (systems := await mavsdk.get_systems()):  # noqa: ASYNC110 - MAVSDK's threads set no event
            await asyncio.sleep(0.05)
    return systems[0]


@pytest.mark.parametrize("version", ["V1", "EXT"])
def test_parameters_are_listed_and_changed(serve: Serve, version: str) -> None:
    async def main() -> None:
        configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
        async with serve() as harness, Mavsdk(configuration) as mavsdk:
            param = ParamAsync(await found(mavsdk, harness.port))
            try:
                with contextlib.suppress(ParamError):  # MAVSDK 4.1 says UNKNOWN of a selection that it makes
                    await param.select_component(192, ProtocolVersion[version])
                async with asyncio.timeout(20.0):
                    table = await param.get_all_params()
                    await param.set_param_float("PERCH_STANDOFF", 0.75)
                    standoff = await param.get_param_float("PERCH_STANDOFF")
            finally:
                param.destroy()
            whole = {p.name: p.value for p in table.int_params}
            real = {p.name: p.value for p in table.float_params}
            assert sorted([*whole, *real]) == [p.name for p in PARAMETERS]
            assert whole["VEH_COMPID"] == 192
            assert real["LIM_BEND"] == pytest.approx(Config().limits.bend_max_rad)
            assert standoff == 0.75
            assert harness.component._settings.config.perch.standoff_m == 0.75

    asyncio.run(main())


@pytest.mark.parametrize("burst", [True, False])
def test_the_metadata_is_fetched(serve: Serve, tmp_path: Path, burst: bool) -> None:
    async def main() -> None:
        configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
        async with serve() as harness, Mavsdk(configuration) as mavsdk:
            ftp = FtpAsync(await found(mavsdk, harness.port))
            try:
                await ftp.set_target_compid(192)
                async with asyncio.timeout(30.0):
                    async for _ in ftp.download("/parameter.json", str(tmp_path), burst):
                        pass
            finally:
                ftp.destroy()
            assert (tmp_path / "parameter.json").read_bytes() == metadata_files(192)["/parameter.json"]

    asyncio.run(main())
