"""A servo's own clock against ours: a loss of power shows, a stall of this process does not."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from arm_companion.drivers.servo_health import ServoRecord
from arm_companion.protocol.control_table import TICK_CLOCK_MODULUS_MS, Echo

BOOTED = -12.3


def echo(read_at: float) -> Echo:
    """What a servo that was switched on at `BOOTED` tells when it reads its clock at `read_at`, s."""
    return Echo(0, int((read_at - BOOTED) * 1000) % TICK_CLOCK_MODULUS_MS, 0, 0)


@given(st.lists(st.tuples(st.floats(0.005, 1.5), st.floats(0.001, 2.0), st.floats(0.0, 1.0)), min_size=2, max_size=12))
def test_whenever_between_question_and_answer_the_clock_was_read_it_is_the_same_servo(
    asked: list[tuple[float, float, float]],
) -> None:
    record, now = ServoRecord(1, missed=0), 100.0
    for pause, took, share in asked:
        question = now + pause
        now = question + took
        record.take_echo(echo(question + share * took), question, now)
    assert not record.turns_lost
    assert record.counters.power_losses == 0


@given(st.floats(0.2, 1.0), st.floats(0.3, 30.0))
def test_a_clock_that_started_afresh_shows(pause: float, ran: float) -> None:
    record = ServoRecord(1, missed=0)
    record.take_echo(echo(100.0), 99.999, 100.001)
    later = 100.0 + pause
    # it had run for `ran` seconds longer when it was switched off and on
    record.take_echo(echo(later - ran - pause), later - 0.001, later + 0.001)
    assert record.turns_lost


@pytest.mark.parametrize("late", [0.07, 0.5])
def test_an_answer_that_waited_in_the_port_is_no_loss_of_power(late: float) -> None:
    """What a process that was not scheduled sees: the answer is there, and came who knows when."""
    record = ServoRecord(1, missed=0)
    for i, waited in enumerate((0.0, late, 0.0)):
        asked = 100.0 + i
        record.take_echo(echo(asked + 0.001), asked, asked + 0.002 + waited)
    assert not record.turns_lost
