"""Bar of the timeline as HTML: event marks, the time shown and drag handlers."""

from collections.abc import Iterable
from html import escape
from math import inf

from viewer.store.inbox import time_of_day
from viewer.theme.events import EventKind, TimelineEvent
from viewer.theme.palette import Palette
from viewer.timeline.past import STEPS_S, LeadTimeError
from viewer.timeline.recordings import TimelineRange

WIDTH = 1000  # width of the drawing; the page scales it
# kinds marked of other UAVs
SEVERE = {EventKind.ALERT, EventKind.MISMATCH, EventKind.LINK_LOST, EventKind.NO_MODEL, EventKind.TELEMETRY_LOST}
MAX_MARKS = 150  # newest marks drawn of one row
TICKS_S = (10, 30, 60, 120, 300, 600, 1800, 3600)  # between ticks, at most twelve


def strip(
    own: Iterable[TimelineEvent],
    others: Iterable[TimelineEvent],
    span: TimelineRange,
    t: float | None,
    palette: Palette,
) -> str:
    """Return the bar as SVG: own events above, severe ones of the other UAVs below; `t` [s since 1970], None: live."""
    severe = [event for event in others if event.kind in SEVERE]
    marks = _marks(list(own), span, palette, 3, 11) + _marks(severe, span, palette, 18, 5)
    at = WIDTH * span.fraction(span.end if t is None else t)
    ticks = "".join(f'<rect x="{x:.1f}" y="23" width="1" height="4" class="tick"/>' for x in _ticks(span))
    return (
        f'<svg class="strip" viewBox="0 0 {WIDTH} 28" preserveAspectRatio="none">'
        f'<rect x="0" y="14" width="{WIDTH}" height="4" rx="2" class="rail"/>'
        f'<rect x="0" y="14" width="{at:.1f}" height="4" rx="2" fill="{palette.predicting}"/>{ticks}{marks}'
        f'<rect x="{min(at, WIDTH - 3):.1f}" y="0" width="3" height="28" fill="{palette.ink}"/></svg>'
    )


def _marks(events: list[TimelineEvent], span: TimelineRange, palette: Palette, top: int, height: int) -> str:
    shown = [event for event in events if span.begin <= event.t <= span.end][-MAX_MARKS:]
    return "".join(
        f'<rect x="{WIDTH * span.fraction(event.t) - 2.5:.1f}" y="{top}" width="5" height="{height}" '
        f'fill="{palette.event(event.kind)}" class="mark" data-kind="{event.kind.value}">'
        f"<title>{time_of_day(event.t)} {event.kind.glyph} {escape(event.text)}</title></rect>"
        for event in shown
    )


def _ticks(span: TimelineRange) -> list[float]:
    duration = span.end - span.begin
    step = next((s for s in TICKS_S if duration / s <= 12), duration)
    first = -(-span.begin // step) * step
    return [WIDTH * span.fraction(first + k * step) for k in range(int((span.end - first) / max(step, 1e-9)) + 1)]


def drag_attributes(send: str) -> str:
    """Return HTML attributes that send the relative position of a press or drag; `send` is page code with `{}`."""
    fraction = "((event.clientX-r.left)/r.width).toFixed(5)"
    code = f"var r=this.getBoundingClientRect();{send.format(fraction)}"
    return f'onpointerdown="{code}" onpointermove="if(event.buttons&1){{{code}}}"'


def comparison_html(
    lead_errors: list[LeadTimeError], issued_t: float | None, shown_t: float, palette: Palette, claimed_s: float = inf
) -> str:
    """Describe the prediction errors at each look-ahead; `claimed_s` is the horizon from the time shown [s]."""
    if issued_t is None:
        return "no prediction at this time"
    if claimed_s < STEPS_S[0]:
        return f"horizon shorter than {STEPS_S[0]:.0f} s at this time"
    if not lead_errors:
        return "prediction not yet compared with the flight"
    parts = "".join(
        f'<span class="miss"><b>+{error.ahead:g} s</b> {error.distance:.1f} m '
        f'<span style="color:{palette.verified if error.inside else palette.mismatch}">'
        f"{'✓ inside' if error.inside else '✕ outside'}</span></span>"
        for error in lead_errors
    )
    age = f" {shown_t - issued_t:.0f} s before" if shown_t - issued_t > 1 else ""
    return f"error of the prediction{age}: {parts}"


def duration_text(seconds: float) -> str:
    """Format a duration: 2:13."""
    minutes, rest = divmod(int(max(seconds, 0.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def size_text(n: int) -> str:
    """Format a size in bytes."""
    return f"{n / 1e6:.1f} MB" if n >= 1e5 else f"{n / 1e3:.0f} kB"
