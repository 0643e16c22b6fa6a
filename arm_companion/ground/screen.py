"""The live terminal view: everything that the arm tells, on one screen; and one line of it where there is none."""

import math
from typing import Final

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text as Line

from arm_companion.ground.arm import Arm
from arm_companion.ground.reports import Kind, Payload, Status, Tendons, Wrench

STALE_S: Final = 2.0
_TEXTS: Final = 6
_FULL_N: Final = 60.0
"""Tension at which the bar is full."""

_STYLES: Final = {"warning": "yellow", "notice": "cyan", "info": "", "debug": "dim"}


class Rates:
    """Messages a second, from counts."""

    def __init__(self) -> None:
        self._before: dict[str, int] = {}
        self._at = -math.inf
        self.hertz: dict[str, float] = {}

    def take(self, now: float, counts: dict[str, int]) -> None:
        """Look at the counters; a new figure once a second."""
        span = now - self._at
        if span < 1.0:
            return
        if math.isfinite(self._at):
            self.hertz = {name: (count - self._before.get(name, 0)) / span for name, count in counts.items()}
        self._before, self._at = dict(counts), now


def screen(arm: Arm, url: str, rates: Rates) -> RenderableType:
    """Everything, for a terminal."""
    return Group(_head(arm, url), _status(arm), _tendons(arm), _wrench(arm), _texts(arm), _rates(rates))


def summary(arm: Arm) -> str:
    """The essentials in one line of plain text."""
    status, wrench = arm.status, arm.wrench
    parts = [f"{arm.system}/{arm.channel.component}"]
    if status is None:
        parts.append("no status yet")
    else:
        parts += [status.state, *([f"{status.progress} %"] if status.progress is not None else [])]
        parts.append(f"bend {_degrees(status.theta)} deg (asked {_degrees(status.goal_theta)})")
        parts += [f"errors {', '.join(status.errors)}"] if status.errors else []
    if arm.tendons is not None:
        parts.append("tension " + " ".join(_number(t.tension, 1) for t in arm.tendons.tendons) + " N")
    if wrench is not None and "force" in wrench.validity:
        parts.append("force " + " ".join(_number(f, 2) for f in wrench.force) + " N")
    if arm.payload is not None:
        parts.append(f"carries {_carried(arm.payload)}")
    if arm.silence > STALE_S:
        parts.append(f"SILENT for {arm.silence:.0f} s")
    return "  ".join(parts)


def _head(arm: Arm, url: str) -> RenderableType:
    silent = arm.silence > STALE_S
    line = Line(f"arm {arm.system}/{arm.channel.component}  {url}  {arm.way}  ")
    line.append(f"silent for {arm.silence:.0f} s" if silent else "heard", style="bold red" if silent else "green")
    return line


def _status(arm: Arm) -> RenderableType:
    status = arm.status
    if status is None:
        return Panel("no ARM_STATUS yet", title="state")
    table = Table.grid(padding=(0, 2))
    state = Line(f"{status.state}  ({status.behaviour})", style="bold")
    table.add_row("state", state)
    if status.progress is not None:
        table.add_row("progress", ProgressBar(total=100, completed=status.progress, width=30))
    plane = f"plane {_degrees(status.delta)} ({_degrees(status.goal_delta)})"
    table.add_row("bend, deg", f"{_degrees(status.theta)} (asked {_degrees(status.goal_theta)})   {plane}")
    table.add_row("tip, mm", "  ".join(_number(1e3 * p, 1) for p in status.tip_position))
    if status.control != (0, 0):
        table.add_row("control", "held by {}/{}".format(*status.control))
    if (payload := arm.payload) is not None:
        table.add_row("carries", _carried(payload))
    table.add_row("facts", ", ".join(status.flags) or "-")
    table.add_row("errors", Line(", ".join(status.errors) or "none", style="bold red" if status.errors else "green"))
    return Panel(table, title="state", title_align="left", border_style=_border(arm, Status))


def _tendons(arm: Arm) -> RenderableType:
    report = arm.tendons
    if report is None:
        return Panel("no ARM_TENDONS yet", title="tendons")
    table = Table(box=None, pad_edge=False)
    for heading in ("", "tension, N", "", "pull, mm", "asked", "load, %", "deg C", "V", ""):
        table.add_column(heading, justify="right" if heading else "left")
    for tendon in report.tendons:
        full = min(max(tendon.tension / _FULL_N, 0.0), 1.0) if math.isfinite(tendon.tension) else 0.0
        trouble = "silent" if tendon.silent else f"error 0x{tendon.hardware_error:02x}" if tendon.hardware_error else ""
        table.add_row(
            str(tendon.index + 1),  # people count from one, messages from zero
            f"{_number(tendon.tension, 1)} ±{_number(tendon.tension_sigma, 1)}",
            ProgressBar(total=1.0, completed=full, width=16),
            _number(1e3 * tendon.displacement, 2),
            _number(1e3 * tendon.goal, 2),
            _number(1e2 * tendon.load, 0),
            _number(tendon.temperature, 0),
            _number(tendon.voltage, 1),
            Line(trouble, style="bold red")
            if trouble
            else ("" if tendon.torque_on else Line("no torque", style="dim")),
        )
    return Panel(table, title="tendons", title_align="left", border_style=_border(arm, Tendons))


def _wrench(arm: Arm) -> RenderableType:
    wrench = arm.wrench
    if wrench is None:
        return Panel("no ARM_REACTION_WRENCH yet", title="wrench")
    table = Table(box=None, pad_edge=False)
    for heading in ("", "x", "y", "z", ""):
        table.add_column(heading, justify="right" if heading else "left")
    rows = (("force, N", "force", 2), ("torque, N m", "torque", 3))
    for label, name, digits in rows:
        values, sigmas = getattr(wrench, name), getattr(wrench, f"{name}_sigma")
        cells = [f"{_number(v, digits)} ±{_number(s, digits)}" for v, s in zip(values, sigmas, strict=True)]
        table.add_row(label, *cells, "" if name in wrench.validity else Line("not to be used", style="yellow"))
    title = f"on the airframe, body axes ({wrench.source})"
    return Panel(table, title=title, title_align="left", border_style=_border(arm, Wrench))


def _carried(payload: Payload) -> str:
    mass = f"{_number(1e3 * payload.mass, 0)} ±{_number(1e3 * payload.mass_sigma, 0)} g"
    return mass if payload.valid else f"{mass}, not weighed yet"


def _texts(arm: Arm) -> RenderableType:
    newest = list(arm.texts)[-_TEXTS:]
    lines = [Line(f"{t.severity}: {t.text}", style=_STYLES.get(t.severity, "bold red")) for t in newest]
    return Panel(Group(*lines) if lines else "-", title="said", title_align="left", border_style="dim")


def _rates(rates: Rates) -> RenderableType:
    return Line("  ".join(f"{name} {hertz:.0f}/s" for name, hertz in sorted(rates.hertz.items()) if hertz), style="dim")


def _border(arm: Arm, kind: Kind) -> str:
    return "red" if arm.age(kind) > STALE_S else "dim"


def _degrees(radians: float) -> str:
    return _number(math.degrees(radians), 1)


def _number(value: float, digits: int) -> str:
    return f"{value:z.{digits}f}" if math.isfinite(value) else "-"
