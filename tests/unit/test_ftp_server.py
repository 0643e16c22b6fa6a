"""The file server: whole files by read and by burst, nothing but files, and no client in another's way."""

import asyncio
import json
import zlib
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given

from arm_companion.drivers.component_metadata import metadata_files
from arm_companion.drivers.ftp_server import BURST_S, MOST_SESSIONS
from arm_companion.errors import ProtocolError
from arm_companion.protocol.dialect import mav
from arm_companion.protocol.ftp import DATA, PAYLOAD, Failure, FtpPayload, Opcode, crc32, unpack
from tests.conftest import MavlinkPeer
from tests.unit.component_rig import ServiceRig, serve

FILES = metadata_files(192)
CONTENT = FILES["/parameter.json"]


async def ask(peer: MavlinkPeer, request: FtpPayload, wait: float = 0.05) -> list[FtpPayload]:
    """The answers to a request."""
    before = len(peer.all("FILE_TRANSFER_PROTOCOL"))
    peer.send(mav.MAVLink_file_transfer_protocol_message(0, 1, 192, request.pack()))
    await asyncio.sleep(wait)
    return [unpack(bytes(m.payload)) for m in peer.all("FILE_TRANSFER_PROTOCOL")[before:]]


async def open_file(peer: MavlinkPeer, sequence: int = 1, path: bytes = b"/parameter.json") -> FtpPayload:
    (answer,) = await ask(peer, FtpPayload(sequence, Opcode.OPEN_FILE_RO, data=path))
    return answer


def test_a_file_is_read_piece_by_piece() -> None:
    async def body(rig: ServiceRig) -> None:
        opened = await open_file(rig.ground)
        assert (opened.opcode, opened.sequence) == (Opcode.ACK, 2)
        assert int.from_bytes(opened.data, "little") == len(CONTENT)
        got, sequence = b"", 3
        while True:
            request = FtpPayload(sequence, Opcode.READ_FILE, opened.session, len(got), size=DATA)
            (answer,) = await ask(rig.ground, request)
            if answer.opcode == Opcode.NAK:
                break
            got += answer.data
            sequence += 2
        assert answer.data[0] == Failure.END_OF_FILE
        assert got == CONTENT
        assert json.loads(got)["parameters"]

    serve(body)


def test_bursts_send_all_of_it_paced() -> None:
    async def body(rig: ServiceRig) -> None:
        opened = await open_file(rig.ground)
        request = FtpPayload(10, Opcode.BURST_READ_FILE, opened.session, size=DATA // 4)
        first = await ask(rig.ground, request, wait=0.035)
        assert len(first) <= 4
        await asyncio.sleep(2.0 * BURST_S)
        got, bursts = b"", 1
        answers = [unpack(bytes(m.payload)) for m in rig.ground.all("FILE_TRANSFER_PROTOCOL")][1:]
        while True:
            assert [a.sequence for a in answers] == list(
                range(request.sequence + 1, request.sequence + 1 + len(answers))
            )
            got += b"".join(a.data for a in answers if a.opcode == Opcode.ACK)
            assert [a.burst_complete for a in answers[:-1]] == [False] * (len(answers) - 1)
            if answers[-1].opcode == Opcode.NAK:
                break
            assert answers[-1].burst_complete, "a burst that stops before the end of the file says so"
            request = FtpPayload(answers[-1].sequence + 1, request.opcode, opened.session, len(got), size=DATA // 4)
            answers = await ask(rig.ground, request, wait=2.0 * BURST_S)
            bursts += 1
        assert bursts > 1
        assert got == CONTENT
        assert (answers[-1].data[0], answers[-1].offset) == (Failure.END_OF_FILE, len(CONTENT))

    serve(body)


def test_a_request_that_comes_twice_gets_the_same_answer() -> None:
    async def body(rig: ServiceRig) -> None:
        first = await open_file(rig.ground)
        assert await open_file(rig.ground) == first
        assert rig.component.files.counters.repeated == 1
        assert (await open_file(rig.ground, sequence=5)).session != first.session

    serve(body)


def test_a_client_that_starts_anew_gets_its_own_file() -> None:
    async def body(rig: ServiceRig) -> None:
        await open_file(rig.ground)
        other = await open_file(rig.ground, path=b"/general.json")  # a second run, from 1 again
        assert int.from_bytes(other.data, "little") == len(FILES["/general.json"])

    serve(body)


def test_the_directory_is_listed_to_its_end() -> None:
    async def body(rig: ServiceRig) -> None:
        (answer,) = await ask(rig.ground, FtpPayload(1, Opcode.LIST_DIRECTORY, data=b"/"))
        entries = answer.data.rstrip(b"\0").split(b"\0")
        assert entries == [f"F{name[1:]}\t{len(data)}".encode() for name, data in FILES.items()]
        (end,) = await ask(rig.ground, FtpPayload(3, Opcode.LIST_DIRECTORY, offset=len(entries), data=b"/"))
        assert (end.opcode, end.data[0]) == (Opcode.NAK, Failure.END_OF_FILE)

    serve(body)


@pytest.mark.parametrize(
    ("opcode", "data", "failure"),
    [
        (Opcode.OPEN_FILE_RO, b"/etc/passwd", Failure.FILE_NOT_FOUND),
        (Opcode.OPEN_FILE_RO, b"/../general.json", Failure.FILE_NOT_FOUND),
        (Opcode.OPEN_FILE_RO, b"\xff\xfe", Failure.FILE_NOT_FOUND),
        (Opcode.LIST_DIRECTORY, b"/etc", Failure.FILE_NOT_FOUND),
        (Opcode.CREATE_FILE, b"/x", Failure.FILE_PROTECTED),
        (Opcode.REMOVE_FILE, b"/general.json", Failure.FILE_PROTECTED),
        (Opcode.RENAME, b"/general.json\0/x", Failure.FILE_PROTECTED),
        (Opcode.READ_FILE, b"", Failure.INVALID_SESSION),
        (Opcode.TERMINATE_SESSION, b"", Failure.INVALID_SESSION),
        (77, b"", Failure.UNKNOWN_COMMAND),
    ],
)
def test_everything_else_is_refused(opcode: int, data: bytes, failure: Failure) -> None:
    async def body(rig: ServiceRig) -> None:
        (answer,) = await ask(rig.ground, FtpPayload(1, opcode, data=data))
        assert (answer.opcode, answer.answers, answer.data) == (Opcode.NAK, opcode, bytes((failure,)))

    serve(body)


def test_sessions_belong_to_their_client_and_the_oldest_makes_room() -> None:
    async def body(rig: ServiceRig) -> None:
        mine = await open_file(rig.ground)
        rig.ground.codec.system_id = 7
        (answer,) = await ask(rig.ground, FtpPayload(1, Opcode.READ_FILE, mine.session))
        assert answer.data[0] == Failure.INVALID_SESSION
        await ask(rig.ground, FtpPayload(3, Opcode.RESET_SESSIONS))
        rig.ground.codec.system_id = 255
        assert (await ask(rig.ground, FtpPayload(3, Opcode.READ_FILE, mine.session)))[0].opcode == Opcode.ACK
        numbers = {(await open_file(rig.ground, 5 + 2 * i)).session for i in range(3 * MOST_SESSIONS)}
        assert numbers == set(range(MOST_SESSIONS))
        (reset,) = await ask(rig.ground, FtpPayload(101, Opcode.RESET_SESSIONS))
        assert reset.opcode == Opcode.ACK
        (gone,) = await ask(rig.ground, FtpPayload(103, Opcode.READ_FILE, mine.session))
        assert gone.data[0] == Failure.INVALID_SESSION

    serve(body)


def test_answers_of_others_and_rubbish_are_not_answered() -> None:
    async def body(rig: ServiceRig) -> None:
        assert await ask(rig.ground, FtpPayload(1, Opcode.ACK)) == []
        assert await ask(rig.ground, FtpPayload(1, Opcode.NAK)) == []
        rubbish: Any = [255] * PAYLOAD
        rig.ground.send(mav.MAVLink_file_transfer_protocol_message(0, 1, 192, rubbish))
        await asyncio.sleep(0.05)
        assert rig.ground.all("FILE_TRANSFER_PROTOCOL") == []
        assert rig.component.files.counters.bad == 1

    serve(body)


@given(
    st.integers(0, 0xFFFF),
    st.integers(0, 255),
    st.integers(0, 255),
    st.integers(0, 2**32 - 1),
    st.binary(max_size=DATA),
)
def test_payloads_come_back(sequence: int, opcode: int, session: int, offset: int, data: bytes) -> None:
    packed = FtpPayload(sequence, opcode, session, offset, data, answers=4, burst_complete=True).pack()
    assert len(packed) == PAYLOAD
    read = unpack(packed)
    assert (read.sequence, read.opcode, read.session, read.offset) == (sequence, opcode, session, offset)
    assert (read.data, read.answers, read.burst_complete) == (data, 4, True)


@given(st.binary(max_size=300))
def test_no_bytes_break_the_reader(data: bytes) -> None:
    try:
        assert len(unpack(data).data) <= DATA
    except ProtocolError:
        assert len(data) < 12 or data[4] > DATA


def test_too_much_data_is_refused_and_the_checksum_is_mavlinks() -> None:
    with pytest.raises(ProtocolError, match="do not fit"):
        FtpPayload(1, Opcode.ACK, data=bytes(DATA + 1)).pack()
    # start value 0, no inversions: the common CRC-32 is the same with its two inversions taken back
    assert crc32(b"123456789") == 0x2DFD2D88
    assert zlib.crc32(b"123456789") == 0xCBF43926
    general = json.loads(FILES["/general.json"])
    assert general["metadataTypes"] == [
        {"type": 1, "uri": "mftp://[;comp=192]/parameter.json", "fileCrc": crc32(CONTENT)}
    ]
