"""What `arm-companion sim --json` prints: a verdict as one object."""

import math
from typing import Any


def summary(scenario: str, verdict: Any, result: Any, wall_s: float) -> dict[str, Any]:
    """The command-line contract of `sim --json`."""
    held = verdict.held
    errors = {move.name: move.error_m for move in verdict.moves}  # the same move with and without compensation
    samples = result.flight.samples
    contract = {
        "scenario": scenario,
        "verdict": verdict.verdict,
        "reason": verdict.reason,
        "states": [{"name": name, "seconds": round(seconds, 3)} for name, seconds in verdict.states],
        "wrench_rms_error_n": number(held.force_error_n if held else math.nan),
        "wrench_rms_n": number(held.true_force_n if held else math.nan),
        "wrench_two_sigma_share": number(held.covered if held else math.nan),
        "pose_error_with_m": number(errors.get("pull x", math.nan)),
        "pose_error_without_m": number(errors.get("pull x, not compensated", math.nan)),
        "moves": [{"name": m.name, "made_m": number(m.made_m), "error_m": number(m.error_m)} for m in verdict.moves],
        "excursion_after_release_m": number(verdict.excursion_m),
        "cycles": result.cycles,
        "missed_cycles": result.missed,
        "lost_s": round(result.lost_s, 3),
        "wall_s": round(wall_s, 3),
        "simulated_s": round(samples[-1].t - samples[0].t, 3) if samples else 0.0,
    }
    further = {"grasp": _grasp_summary, "abort": _abort_summary, "reach": _reach_summary}.get(scenario, lambda _: {})
    return contract | further(verdict)


def _abort_summary(verdict: Any) -> dict[str, Any]:
    """What a flight with aborts has besides."""
    return {
        "aborts": [
            {"state": a.state, "let_go_s": number(a.let_go_s), "sank_m": number(a.sank_m)} for a in verdict.aborts
        ]
    }


def _reach_summary(verdict: Any) -> dict[str, Any]:
    """What a flight to points has besides."""
    return {
        "points": [
            {
                "asked_m": list(p.asked_w),
                "off_m": number(p.off_m),
                "worst_m": number(p.worst_m),
                "seconds": number(p.took_s),
            }
            for p in verdict.points
        ]
    }


def _grasp_summary(verdict: Any) -> dict[str, Any]:
    """What a grasp has besides: the errors are those of the height while the load came on, RMS."""
    errors = {pick_up.name: pick_up.error_m for pick_up in verdict.pick_ups}
    return {
        "pose_error_with_m": number(errors.get("grasp", math.nan)),
        "pose_error_without_m": number(errors.get("grasp, not compensated", math.nan)),
        "pick_ups": [
            {
                "name": p.name,
                "error_m": number(p.error_m),
                "aside_m": number(p.aside_m),
                "seconds": number(p.seconds),
            }
            for p in verdict.pick_ups
        ],
        "payload_mass_kg": number(verdict.weighed_kg),
        "payload_mass_sigma_kg": number(verdict.weighed_sigma_kg),
        "payload_mass_true_kg": number(verdict.mass_kg),
        "payload_mass_error": number(verdict.mass_error),
        "placed_off_m": number(verdict.placed_m),
    }


def number(value: float) -> float | None:
    """To six digits after the point; JSON has no word for what is no finite number."""
    return round(value, 6) if math.isfinite(value) else None
