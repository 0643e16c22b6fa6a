"""pymavlink's own parameter and file clients, and its signing, against our component over UDP."""

import asyncio
import contextlib
import json
from collections.abc import Callable, Iterator
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any

import pytest

from arm_companion.config import Config
from arm_companion.config.parameters import PARAMETERS
from arm_companion.drivers.component_metadata import metadata_files
from arm_companion.mission.facts import Order
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.signing import Signing

pytestmark = pytest.mark.realtime

Serve = Callable[[], AbstractAsyncContextManager[Any]]
KEY = bytes(range(32))


@pytest.fixture
def station(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], contextlib.AbstractContextManager[Any]]:
    """A maker of mavutil connections that have heard our heartbeat and made us their target."""
    monkeypatch.setenv("MAVLINK20", "1")
    from pymavlink import mavutil

    @contextlib.contextmanager
    def connect(port: int) -> Iterator[Any]:
        connection = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{port}", source_system=255, source_component=190, dialect="common"
        )
        try:
            assert connection.recv_match(type="HEARTBEAT", blocking=True, timeout=5.0) is not None
            connection.target_system, connection.target_component = 1, 192
            yield connection
        finally:
            connection.close()

    return connect


def run(serve: Serve, operate: Callable[[int], Any]) -> Any:
    """Let a client work in a thread against a running component; gives back the harness and its result."""

    async def main() -> Any:
        async with serve() as harness:
            return harness, await asyncio.to_thread(operate, harness.port)

    return asyncio.run(main())


def test_mavutil_downloads_all_parameters_and_mavparm_changes_them(serve: Serve, station: Any) -> None:
    from pymavlink import mavparm

    def operate(port: int) -> tuple[dict[str, float], bool, bool, Any]:
        with station(port) as connection:
            connection.param_fetch_all()
            seen: dict[str, float] = {}
            while len(seen) < len(PARAMETERS):
                value = connection.recv_match(type="PARAM_VALUE", blocking=True, timeout=2.0)
                assert value is not None, f"{len(seen)} of {len(PARAMETERS)} came"
                seen[value.param_id] = value.param_value
            table = mavparm.MAVParmDict()
            for name, value in seen.items():
                table[name] = value
            taken = table.mavset(connection, "PERCH_STANDOFF", 0.75, retries=2)
            whole = table.mavset(connection, "VEH_COMPID", 200, retries=2, parm_type=mav.MAV_PARAM_TYPE_INT32)
            connection.mav.param_request_read_send(1, 192, b"VEH_COMPID", -1)
            shown = connection.recv_match(type="PARAM_VALUE", blocking=True, timeout=2.0)
            return seen, taken, whole, shown

    harness, (seen, taken, whole, shown) = run(serve, operate)
    assert list(seen) == [parameter.name for parameter in PARAMETERS]
    assert seen["PERCH_STANDOFF"] == pytest.approx(Config().perch.standoff_m)
    assert (taken, whole) == (True, True)
    assert shown.param_type == mav.MAV_PARAM_TYPE_INT32
    values = {p.name: harness.component._settings.value(p) for p in PARAMETERS}
    assert (values["PERCH_STANDOFF"], values["VEH_COMPID"]) == (0.75, 200.0)


def test_mavftp_lists_and_fetches_the_metadata(serve: Serve, station: Any, tmp_path: Path) -> None:
    from pymavlink import mavftp

    def operate(port: int) -> tuple[list[Any], dict[str, bytes]]:
        with station(port) as connection:
            client = mavftp.MAVFTP(connection, 1, 192)
            assert client.cmd_list(["/"]).error_code == 0
            listed = [(entry.name, entry.size_b) for entry in client.list_result]
            fetched = {}
            for name in ("general.json", "parameter.json"):
                local = tmp_path / name
                client.cmd_get([f"/{name}", str(local)])
                assert client.process_ftp_reply("OpenFileRO", timeout=15).error_code == 0
                fetched[f"/{name}"] = local.read_bytes()
            return listed, fetched

    _, (listed, fetched) = run(serve, operate)
    files = metadata_files(192)
    assert fetched == files
    assert sorted(listed) == sorted((name[1:], len(data)) for name, data in files.items())
    assert json.loads(fetched["/parameter.json"])["parameters"][0]["name"] == PARAMETERS[0].name


def test_a_signing_station_commands_and_an_unsigned_one_does_not(serve: Serve, station: Any) -> None:
    from arm_companion.clock import unix_now

    def operate(port: int) -> list[Any]:
        with station(port) as connection:
            results = []
            for signs in (False, True):
                if signs:
                    connection.setup_signing(KEY, sign_outgoing=True)
                connection.mav.command_long_send(1, 192, mav.MAV_CMD_ARM_RELEASE, 0, *[0.0] * 7)
                results.append(connection.recv_match(type="COMMAND_ACK", blocking=True, timeout=1.0))
            beat = connection.recv_match(type="HEARTBEAT", blocking=True, timeout=3.0)
            return [*results, beat]

    async def main() -> None:
        async with serve() as harness:
            harness.link.secure(Signing(KEY), unix_now)
            unsigned, signed, beat = await asyncio.to_thread(operate, harness.port)
            assert unsigned is None
            assert signed is not None
            assert signed.result in (mav.MAV_RESULT_IN_PROGRESS, mav.MAV_RESULT_ACCEPTED)
            assert beat.get_signed()
            assert [r.order for r in harness.requests] == [Order.RELEASE]

    asyncio.run(main())
