"""The report as one HTML file that needs nothing else: pictures inside, no script, readable on a phone."""

import base64
import html
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Final

from arm_companion.report.figures import Picture
from arm_companion.report.flight import RecordedFlight, Said, Span
from arm_companion.report.words import Verdict

_STYLE: Final = """
:root { color: #1f2933; background: #ffffff; font: 16px/1.45 system-ui, sans-serif; }
body { max-width: 72rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.4rem; margin: 0 0 .2rem; } h2 { font-size: 1.1rem; margin: 1.6rem 0 .5rem; }
.sub { color: #52606d; margin: 0 0 1rem; overflow-wrap: anywhere; }
.verdict { border-left: .5rem solid; border-radius: .3rem; padding: .6rem 1rem; background: #f8fafc; }
.verdict strong { font-size: 1.15rem; } .verdict ul { margin: .4rem 0 0; padding-left: 1.2rem; }
.good { border-color: #0f766e; } .look { border-color: #d97706; } .bad { border-color: #b91c1c; }
.line { width: 100%; height: 3.2rem; display: block; border-radius: .3rem; }
.pictures { display: grid; gap: 1rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); }
figure { margin: 0; } figure img { width: 100%; height: auto; display: block; }
figcaption b { display: block; } figcaption { font-size: .9rem; color: #52606d; margin-bottom: .3rem; }
.wide { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { text-align: left; padding: .3rem .6rem .3rem 0; border-bottom: 1px solid #e5e7eb; vertical-align: top; }
td:first-child, td:nth-child(3):not(:last-child) { white-space: nowrap; font-variant-numeric: tabular-nums; }
.critical td, .error td { color: #b91c1c; font-weight: 600; } .warning td { color: #b45309; font-weight: 600; }
details summary { cursor: pointer; } details td { overflow-wrap: anywhere; }
"""
_WORDS: Final = {"good": "Nothing to report", "look": "Have a look", "bad": "Something went wrong"}
_COLOURS: Final = ("#cbd5e1", "#94a3b8")
_PERCHED: Final = "#f59e0b"


def page(flight: RecordedFlight, verdict: Verdict, pictures: Sequence[Picture], title: str) -> str:
    """The whole page."""
    began = datetime.fromtimestamp(flight.began_ns * 1e-9, UTC)
    about = f"{began:%Y-%m-%d %H:%M:%S} UTC · {flight.seconds:.1f} s · {flight.cycles} cycles"
    points = "".join(f"<li>{_text(point)}</li>" for point in verdict.points)
    shown = "".join(
        f"<figure><figcaption><b>{_text(p.title)}</b>{_text(p.caption)}</figcaption>"
        f'<img alt="{_text(p.title)}" src="data:image/png;base64,{base64.b64encode(p.png).decode()}"></figure>'
        for p in pictures
    )
    warnings = [said for said in flight.said if said.level != "info"]
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{_text(title)}</title><style>{_STYLE}</style></head><body>
<h1>{_text(title)}</h1><p class="sub">{_text(about)}</p>
<div class="verdict {verdict.grade}"><strong>{_WORDS[verdict.grade]}: {_text(verdict.headline)}</strong>
<ul>{points}</ul></div>
<h2>States</h2>{_timeline(flight.spans, flight.seconds)}
{_states(flight.spans)}
<h2>Warnings</h2>{_sentences(warnings) if warnings else "<p>None.</p>"}
<h2>Pictures</h2><p class="sub">Yellow: perched. Drawn at 20 Hz; the record has every cycle.</p>
<div class="pictures">{shown}</div>
<h2>Everything that was said</h2>{_sentences(flight.said) if flight.said else "<p>Nothing.</p>"}
<h2>Made with</h2><details><summary>versions, machine, calibration</summary>
{_table(("what", "value"), (("", item) for item in flight.versions.items()))}</details>
</body></html>
"""


def _states(spans: Sequence[Span]) -> str:
    rows = (("", (f"{s.begin:.2f} s", s.name, f"{s.end - s.begin:.1f} s", s.cause)) for s in spans)
    return _table(("at", "state", "for", "because"), rows)


def _timeline(spans: Sequence[Span], seconds: float) -> str:
    """A bar of the states, as SVG that stretches; its words are HTML's, so that they do not."""
    total = max(seconds, 1e-9)
    parts = []
    for i, span in enumerate(spans):
        colour = _PERCHED if span.name in ("PERCHED", "HANGING") else _COLOURS[i % 2]
        x, width = 1000.0 * span.begin / total, 1000.0 * (span.end - span.begin) / total
        label = f"{span.name}, {span.begin:.1f} s to {span.end:.1f} s"
        parts.append(
            f'<rect x="{x:.2f}" y="0" width="{max(width, 0.0):.2f}" height="30" fill="{colour}">'
            f"<title>{_text(label)}</title></rect>"
        )
    return (
        '<svg class="line" viewBox="0 0 1000 30" preserveAspectRatio="none" role="img" '
        f'aria-label="timeline of the states">{"".join(parts)}</svg>'
    )


def _sentences(said: Iterable[Said]) -> str:
    rows = ((s.level, (f"{s.t:.2f} s", s.level, s.text)) for s in said)
    return _table(("at", "level", "text"), rows)


def _table(head: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]]) -> str:
    heads = "".join(f"<th>{_text(cell)}</th>" for cell in head)
    body = "".join(
        f'<tr class="{_text(kind)}">' + "".join(f"<td>{_text(cell)}</td>" for cell in cells) + "</tr>"
        for kind, cells in rows
    )
    return f'<div class="wide"><table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>'


def _text(value: str) -> str:
    return html.escape(value)
