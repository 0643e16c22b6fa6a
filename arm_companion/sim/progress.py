"""What a person sees of a scenario: a line for everything that happens, and the verdict as one table."""

import asyncio
import math
from pathlib import Path
from typing import TextIO

from rich.console import Console
from rich.table import Table

from arm_companion.sim.abort_verdict import AbortVerdict
from arm_companion.sim.grasp_verdict import GraspVerdict
from arm_companion.sim.reach_scenario import ReachVerdict
from arm_companion.sim.trials import Outcome, Summary
from arm_companion.sim.verdict import Verdict


class Progress:
    """Prints each event with the time since the start."""

    def __init__(self, stream: TextIO) -> None:
        self.console = Console(file=stream, highlight=False)
        self._start: float | None = None

    def say(self, text: str) -> None:
        """One event, now."""
        now = asyncio.get_running_loop().time()
        self._start = now if self._start is None else self._start
        style = "bold" if text.startswith("state") else "yellow" if text.startswith("“") else ""
        self.console.print(
            f"[dim]{now - self._start:7.2f} s[/dim]  {text.replace('[', '(')}", style=style, soft_wrap=True
        )


def show_verdict(title: str, verdict: Verdict, console: Console, files: list[Path]) -> None:
    """The table at the end, the verdict, and where to look further."""
    table = Table(title=title, title_justify="left", show_header=True, header_style="bold")
    table.add_column("what")
    table.add_column("value", justify="right")
    table.add_column("remark")
    for name, seconds in verdict.states:
        table.add_row(f"in {name}", f"{seconds:.1f} s", "")
    table.add_section()
    _show_forces(verdict, table)
    table.add_section()
    if not math.isnan(verdict.hover_error_m):
        table.add_row("hover error while held", f"{_mm(verdict.hover_error_m)}", "RMS about the mean")
    for move in verdict.moves:
        table.add_row(
            move.name,
            f"{_mm(move.made_m)} made",
            f"asked {_mm(move.asked_m)}, error {_mm(move.error_m)}, arm's force {move.force_n:.1f} N",
        )
    if not math.isnan(verdict.excursion_m):
        table.add_row(
            "excursion after release", _mm(verdict.excursion_m), "greatest distance from where it was asked to be"
        )
    if isinstance(verdict, GraspVerdict):
        _show_grasp(verdict, table)
    if isinstance(verdict, ReachVerdict):
        _show_points(verdict, table)
    if isinstance(verdict, AbortVerdict):
        _show_aborts(verdict, table)
    console.print(table)
    style = "bold green" if verdict.success else "bold red"
    console.print(
        f"verdict: {verdict.verdict}" + (f" ({verdict.reason})" if verdict.reason else ""),
        style=style,
        soft_wrap=True,
    )
    for path in files:
        if path.exists():
            console.print(f"  {path}", soft_wrap=True)


def _show_forces(verdict: Verdict, table: Table) -> None:
    """What touched what, and what the daemon predicted of it."""
    mean, most = verdict.contact_force_n
    if not math.isnan(mean):
        table.add_row("contact force while held", f"{mean:.1f} N", f"greatest {most:.1f} N")
        table.add_row("arm around bar or object", f"{math.degrees(verdict.wrap_rad):.0f} deg", "median while held")
    for wrench in verdict.wrench:
        table.add_row(
            f"wrench on airframe, {wrench.span}",
            f"{wrench.force_error_n:.2f} N RMS error",
            f"true {wrench.true_force_n:.2f} N; torque error {wrench.torque_error_nm:.3f} "
            f"of {wrench.true_torque_nm:.3f} N m; "
            f"{wrench.covered:.0%} of {wrench.predictions} predictions within two sigma",
        )
    if verdict.leaned_s:
        table.add_row("mount against the bar", f"{verdict.leaned_s:.1f} s", "no wrench of the arm: nobody predicts it")


def _show_grasp(verdict: GraspVerdict, table: Table) -> None:
    """What a grasp has besides."""
    for pick_up in verdict.pick_ups:
        table.add_row(
            f"pick-up: {pick_up.name}",
            f"{_mm(pick_up.error_m)} RMS",
            f"from the height asked, at most {_mm(pick_up.worst_m)} too low; {_mm(pick_up.aside_m)} RMS aside; "
            f"{pick_up.seconds:.1f} s",
        )
    if not math.isnan(verdict.weighed_kg):
        table.add_row(
            "object weighed",
            f"{1e3 * verdict.weighed_kg:.0f} g",
            f"one sigma {1e3 * verdict.weighed_sigma_kg:.0f} g; true {1e3 * verdict.mass_kg:.0f} g, "
            f"error {verdict.mass_error:+.1%}",
        )
    table.add_row("object put down", _mm(verdict.placed_m), "from where it lay")


def _show_points(verdict: ReachVerdict, table: Table) -> None:
    """Where the tip was asked to be, and where it was."""
    for i, point in enumerate(verdict.points, 1):
        table.add_row(
            f"point {i}: {', '.join(f'{x:g}' for x in point.asked_w)} m",
            f"{_mm(point.off_m)} off",
            f"median of the tip's distance while kept there, at worst {_mm(point.worst_m)}; took {point.took_s:.1f} s",
        )


def _show_aborts(verdict: AbortVerdict, table: Table) -> None:
    """What a flight with aborts has besides."""
    for abort in verdict.aborts:
        table.add_row(
            f"abort in {abort.state}",
            f"{abort.let_go_s:.1f} s" if abort.let_go_s else "no touch",
            f"until the bar was let go; vehicle {_mm(abort.sank_m)} lower at most",
        )


def show_outcome(outcome: Outcome, done: str, stream: TextIO) -> None:
    """A line for one trial."""
    what = done if outcome.success else f"failed: {outcome.reason}"
    print(f"seed {outcome.seed}: {what} ({outcome.words})", file=stream, flush=True)


def show_summary(title: str, done: str, summary: Summary, stream: TextIO) -> None:
    """How many of the trials succeeded, with the interval that the true share lies in, and why the others did not."""
    trials = len(summary.outcomes)
    low, high = summary.interval
    table = Table(title=f"{title}, {trials} trials", title_justify="left", show_header=True, header_style="bold")
    table.add_column("what")
    table.add_column("trials", justify="right")
    table.add_column("share", justify="right")
    table.add_column("95 % interval (Wilson)", justify="right")
    share = f"{summary.success / trials:.0%}"
    table.add_row(done, str(summary.success), share, f"{low:.0%} to {high:.0%}")
    table.add_row("harm: limit, airframe or fall", str(summary.harmed), f"{summary.harmed / trials:.0%}", "")
    if not math.isnan(summary.covered):
        table.add_row("predicted force within two sigma", "", f"{summary.covered:.0%}", "of the held arm's, mean")
    table.add_section()
    for reason, count in summary.failures.items():
        table.add_row(reason.replace("[", "("), str(count), f"{count / trials:.0%}", "")
    Console(file=stream, highlight=False).print(table)


def _mm(metres: float) -> str:
    return "-" if math.isnan(metres) else f"{metres * 1e3:z.1f} mm"
