"""Texts of the page as HTML. Received texts are escaped here."""

from collections import Counter
from collections.abc import Iterable
from html import escape
from math import isfinite
from typing import NamedTuple

import numpy as np

from fleet.contract import Alert, AlertKind, DiagnosisOutcome, Mismatch, TwinState
from viewer.store.inbox import rate_text, time_of_day, timestamp
from viewer.store.store import FleetStore
from viewer.store.vehicle import StatusRecord, Vehicle
from viewer.text.missed_events import encode_click
from viewer.theme.events import EventKind
from viewer.theme.palette import STATE_STYLE, STATE_TEXT, Palette

MAX_SHOWN = 12  # segments and causes shown of one UAV
MAX_TEXT = 600  # characters of a text
_OUTCOME_TEXT = {
    DiagnosisOutcome.NAMED: "named",
    DiagnosisOutcome.SUSPECTED: "suspected",
    DiagnosisOutcome.UNKNOWN: "unknown physics",
}


def in_force(mismatch: Mismatch | None) -> bool:
    """Return whether a mismatch is named or unknown; a suspected mismatch does not count."""
    return mismatch is not None and mismatch.outcome in (DiagnosisOutcome.NAMED, DiagnosisOutcome.UNKNOWN)


def short_text(mismatch: Mismatch) -> str:
    """Return a short description, not escaped."""
    if mismatch.outcome is DiagnosisOutcome.UNKNOWN:
        return f"unknown physics in {mismatch.causes[0].channel[:40]}" if mismatch.causes else "unknown physics"
    names = [
        cause.name[:40].replace("_", " ") + (f" of the {cause.surface[:20]}" if cause.surface else "")
        for cause in mismatch.causes[:3]
        if cause.name != "unknown"
    ]
    return " and ".join(names) or _OUTCOME_TEXT.get(mismatch.outcome, "")


def located_spans(mismatch: Mismatch | None, newest: float) -> list[tuple[float, float]]:
    """Return its located spans, (begin, end) in data time [s]; the last one extends to `newest`."""
    if mismatch is None or mismatch.outcome is DiagnosisOutcome.NONE:
        return []
    pairs = [pair for cause in mismatch.causes[:MAX_SHOWN] for pair in cause.segments[:MAX_SHOWN]][:MAX_SHOWN]
    finite = [(begin, end) for begin, end in pairs if isfinite(begin) and isfinite(end)]
    return [(begin, newest if end >= mismatch.t - 5.0 else min(end, newest)) for begin, end in finite]


def is_located(t: np.ndarray, mismatch: Mismatch | None) -> np.ndarray:
    """Return a mask (n,) of the increasing times (n,) that lie in a located span."""
    inside = np.zeros(len(t), bool)
    for begin, end in located_spans(mismatch, float(t[-1])) if len(t) else []:
        inside |= (t >= begin) & (t <= end)
    return inside


def mismatch_html(mismatch: Mismatch | None, palette: Palette) -> str:
    """Return the mismatch with its evidence as HTML; empty without a mismatch."""
    if mismatch is None or mismatch.outcome is DiagnosisOutcome.NONE:
        return ""
    colour = palette.mismatch if in_force(mismatch) else palette.identifying
    head = f"{'▲' if in_force(mismatch) else '△'} mismatch {_OUTCOME_TEXT[mismatch.outcome]}"
    proof = key_value_table(_proof(mismatch))
    model = "included in the prediction model" if mismatch.adapted else "not in the prediction model"
    return (
        f'<div class="say mismatch" style="border-color:{colour}"><b style="color:{colour}">{head}</b> '
        f'<span class="soft">{model}</span><br>{escape(mismatch.sentence[:MAX_TEXT])}{proof}</div>'
    )


def key_value_table(pairs: Iterable[tuple[str, str]], attributes: str = "") -> str:
    """Return names and values as an HTML table; the caller escapes them."""
    rows = "".join(f'<tr><td class="soft key">{k}</td><td class="value">{v}</td></tr>' for k, v in pairs)
    return f"<table{attributes}>{rows}</table>"


def _proof(mismatch: Mismatch) -> list[tuple[str, str]]:
    pairs = (
        ("residual", mismatch.fit_before, mismatch.fit_after, "σ of nominal flight, held-out data"),
        ("force error", mismatch.force_before, mismatch.force_after, "m/s², held-out data"),
        ("5 s free run", mismatch.attitude_error_before, mismatch.attitude_error_after, "°"),
    )
    return [
        (name, f"{before:.2f} → <b>{after:.2f}</b> {unit}")
        for name, before, after, unit in pairs
        if before is not None and after is not None and isfinite(before) and isfinite(after)
    ]


MAX_ROWS = 50
LOW_FIT = 50.0  # below this fit the residual exceeds half of the motion, RMS; a verified model has little power [%]
SHORT_HORIZON_S = 10.0  # a shorter horizon is reported [s]
FULL_BAR_S = 10.0  # smallest horizon of a full bar in the table [s]


class StatusLabel(NamedTuple):
    """Status of a UAV as glyph, text and colour."""

    glyph: str
    text: str
    colour: str


def status_label(vehicle: Vehicle, palette: Palette, now: float) -> StatusLabel:
    """Return the status of a UAV: state of its twin, mismatch, alert or end of recording."""
    if vehicle.ended:
        return StatusLabel(EventKind.END.glyph, "recording ended", palette.event(EventKind.END))
    record = vehicle.record(now)
    if record.state is not TwinState.LINK_LOST and in_force(vehicle.mismatch):
        return StatusLabel("▲", "mismatch", palette.mismatch)
    if record.state is not TwinState.LINK_LOST and vehicle.alerts:
        return StatusLabel("▲", next(iter(vehicle.alerts.values())).kind.value.replace("_", " "), palette.mismatch)
    glyph, colour, text = state_style(record)
    return StatusLabel(glyph, text, getattr(palette, colour))


def state_style(record: StatusRecord) -> tuple[str, str, str]:
    """Return glyph, `Palette` field and text of a state.

    A verified model has the colour of verification only with a fit of `LOW_FIT` and, where there is a prediction, a
    horizon of `SHORT_HORIZON_S` or more: verification alone states only that the model is better than none.
    """
    glyph, colour = STATE_STYLE[record.state]
    text = STATE_TEXT[record.state]
    if record.state is TwinState.VERIFIED:
        if record.fit is None or record.fit < LOW_FIT:
            return glyph, STATE_STYLE[TwinState.PREDICTING][1], "low fit"
        if record.prediction_age_s is not None and not record.horizon_open and record.horizon_s < SHORT_HORIZON_S:
            return glyph, STATE_STYLE[TwinState.PREDICTING][1], "short horizon"
    return glyph, colour, text


def fit_colour(fit: float | None, palette: Palette) -> str:
    """Return the colour of a verified model by its fit [%]."""
    return palette.verified if fit is not None and fit >= LOW_FIT else palette.predicting


_STATE_RANK = {state: rank for rank, state in enumerate(STATE_STYLE)}


def severity(vehicle: Vehicle, now: float) -> tuple[bool, int, float, int]:
    """Return a sort key: alerts first, then worst state, then shortest horizon; ended recordings last."""
    record = vehicle.record(now)
    rank = len(STATE_STYLE) if vehicle.ended else _STATE_RANK[record.state]
    return (not (vehicle.alerts or in_force(vehicle.mismatch)), rank, record.horizon_s, vehicle.uav)


def horizon_text(record: StatusRecord) -> str:
    """Format the horizon: 34 s, ≥ 180 s where it does not end, – where there is none."""
    if not record.horizon_s:
        return "–"
    return f"{'≥ ' if record.horizon_open else ''}{record.horizon_s:.0f} s"


def fit_text(record: StatusRecord) -> str:
    """Format the mean fit: 88 %, – before the first."""
    return "–" if record.fit is None else f"{record.fit:.0f} %"


def lost_text(record: StatusRecord) -> str:
    """Describe a lost link."""
    return f"{STATE_TEXT[TwinState.LINK_LOST]} {age_text(record.sample_age_s)}"


def alert_sentence(alert: Alert, vehicle: Vehicle, now: float) -> str:
    """Return the text of an alert, not escaped; ages, horizons and probabilities in it are the present ones.

    An alert is published once. Where a proposal against it states the present probability, that one is shown, else
    the text of the alert with the time of which it is.
    """
    record, proposal = vehicle.record(now), vehicle.proposals.get(alert.about)
    if alert.kind is AlertKind.LINK_LOST:
        return f"no sample for {age_text(record.sample_age_s)}; the twin predicts without telemetry"
    if alert.kind is AlertKind.SHORT_HORIZON:
        least = f"{SHORT_HORIZON_S:.0f} s"
        if record.horizon_s >= SHORT_HORIZON_S:
            return f"confidence horizon {horizon_text(record)}; it was shorter than {least}"
        return f"confidence horizon {horizon_text(record)}; an error of 10 % within {least} is more likely than not"
    if proposal is not None and proposal.message.probability is not None and proposal.message.t >= alert.t:
        other = f" with uav-{alert.other}" if alert.other >= 0 else ""
        risk = f"risk {100 * proposal.message.probability:.0f} % with the present plan"
        return f"{alert.kind.value.replace('_', ' ')}{other}: {risk}"
    return f"at {time_of_day(alert.t)}: {alert.sentence}"


def empty_html(store: FleetStore, now: float) -> str:
    """Return the page text without UAVs: what was received of gateway and workers, and what to check."""
    n, malformed = sum(tuple(store.counts.values())) - store.counts["strange"], store.counts["strange"]
    malformed_text = f"; {malformed} malformed" if malformed else ""
    rows = [
        ("gateway", escape(_gateway_text(store))),
        ("twin worker", escape("; ".join(store.worker_texts()) or _worker_text(store))),
        ("listening on", f"<code>{escape(store.sample_key)}</code> for {now - store.started:.0f} s"),
        ("received", f"{n} messages, none with the position of an aircraft{malformed_text}"),
    ]
    table_html = key_value_table(rows)
    return f'<div class="uav empty"><h1>No aircraft yet</h1><div class="soft">{table_html}</div></div>'


def _gateway_text(store: FleetStore) -> str:
    """Describe the newest gateway statistics, or what to check without any; not escaped."""
    gateway = store.gateway
    if gateway is None:
        return (
            "none found yet; its first start compiles for about a minute. If it takes longer, start `fleet up`, or "
            "`gateway` on this router"
        )
    links = ", ".join(link[:80] for link in gateway.links[:4]) or "no link"
    if gateway.uavs:
        return f"running ({links}); {len(gateway.uavs)} aircraft send, none has sent a position yet"
    return f"running ({links}); {gateway.sentence or 'no aircraft received yet'}"


def _worker_text(store: FleetStore) -> str:
    """Describe workers without a text of their own; not escaped."""
    return "ready" if store.sentences else "none found yet; start `twin_worker` on this router, or `fleet up`"


def summary_html(fleet: list[Vehicle], store: FleetStore, palette: Palette, now: float) -> str:
    """Count the fleet by state, with the median horizon."""
    ordered = sorted(fleet, key=lambda vehicle: severity(vehicle, now)[:2])
    chips = "".join(
        f'<span class="chip"><b style="color:{label.colour}">{label.glyph}</b><b>{n}</b>'
        f'<span class="soft">{label.text}</span></span>'
        for label, n in Counter(status_label(vehicle, palette, now) for vehicle in ordered).items()
    )
    records = [record for vehicle in fleet if (record := vehicle.record(now)).horizon_s]
    records.sort(key=lambda record: (record.horizon_s, record.horizon_open))
    middle = horizon_text(records[len(records) // 2]) if records else ""
    median = f'<span class="dot"> · </span>median horizon {middle}' if middle else ""
    notes = "".join(f'<div class="soft">{escape(text)}</div>' for text in store.worker_texts())
    plural = "UAV" if len(fleet) == 1 else "UAVs"
    head = f"<h1>{len(fleet)} {plural}<small>{median}</small></h1>"
    return f'<div class="uav">{head}{chips}{_recording(fleet, now)}{notes}</div>'


def _recording(fleet: list[Vehicle], now: float) -> str:
    """Return the replay status: data time and rate of recordings."""
    played = [vehicle for vehicle in fleet if vehicle.recorded]
    if not played:
        return ""
    newest = max(played, key=lambda vehicle: (not vehicle.ended, vehicle.data_time(now)))
    rate = "ended" if newest.ended else f"played {rate_text(newest.time.rate)}" if newest.time.rate else "paused"
    return f'<div class="soft">Recording · <span class="now">{timestamp(newest.data_time(now))}</span> · {rate}</div>'


def table(fleet: list[Vehicle], palette: Palette, now: float, *, total: int, pick: str, selected: int | None) -> str:
    """Return the table of up to 50 UAVs, most severe first; `pick` is the click handler with `{}` for the UAV."""
    worst = sorted(fleet, key=lambda vehicle: severity(vehicle, now))[:MAX_ROWS]
    longest = max([FULL_BAR_S, *(vehicle.record(now).horizon_s for vehicle in worst)])
    rows = "".join(_row(vehicle, palette, now, pick, on=vehicle.uav == selected, longest=longest) for vehicle in worst)
    return (
        '<div class="uav list" tabindex="0" role="region" aria-label="Aircraft"><table><tr><td></td><th>UAV</th>'
        f'<th>status</th><th class="num">fit %</th><th class="num">horizon</th></tr>{rows}</table>'
        f'<div class="foot">{len(worst)} of {total} · alerts and worst state first, then shortest horizon '
        "· keys: tab Display</div></div>"
    )


def _row(vehicle: Vehicle, palette: Palette, now: float, pick: str, *, on: bool, longest: float) -> str:
    label, record = status_label(vehicle, palette, now), vehicle.record(now)
    text = lost_text(record) if label.text == STATE_TEXT[TwinState.LINK_LOST] else label.text
    if record.prediction_lag_s and record.state is not TwinState.LINK_LOST:
        text += f", {age_text(record.prediction_lag_s)} old"
    bar = f'<i><i style="width:{min(record.horizon_s / longest, 1) * 100:.0f}%;background:{label.colour}"></i></i>'
    percent, problem = fit_text(record).removesuffix(" %"), escape(_problem_text(vehicle, text, now))
    return (
        f'<tr class="pick{" on" if on else ""}" data-uav="{vehicle.uav}" title="{problem}" '
        f'onpointerdown="{pick.format(vehicle.uav)}">'
        f'<td style="color:{label.colour}">{label.glyph}</td><td>{vehicle.name}</td>'
        f'<td style="color:{label.colour}">{text}</td><td class="num">{percent}</td>'
        f'<td><div class="bar">{bar}<span class="num">{horizon_text(record)}</span>'
        "</div></td></tr>"
    )


def lag_text(record: StatusRecord) -> str:
    """Describe a late prediction."""
    return f"prediction {age_text(record.prediction_lag_s)} old"


def _problem_text(vehicle: Vehicle, status: str, now: float) -> str:
    """Return status, mismatch and alert texts of a UAV for the tooltip of its row; not escaped."""
    texts = [short_text(vehicle.mismatch)] if vehicle.mismatch is not None and in_force(vehicle.mismatch) else []
    sentences = (alert_sentence(alert, vehicle, now)[:200] for alert in vehicle.alerts.values())
    return "; ".join([status, *texts, *sentences])


def alerts_html(fleet: list[Vehicle], palette: Palette, now: float, pick: str = "") -> str:
    """Return active mismatches and alerts, newest first, at most 50 each; `pick` is the click handler."""
    mismatched = [(v, v.mismatch) for v in fleet if v.mismatch is not None and in_force(v.mismatch)]
    mismatched = sorted(mismatched, key=lambda item: -item[1].t)[:MAX_ROWS]
    mismatch_rows = [(v, "mismatch", mismatch.t, short_text(mismatch)) for v, mismatch in mismatched]
    alerts = sorted(((v, a) for v in fleet for a in v.alerts.values()), key=lambda item: -item[1].t)[:MAX_ROWS]
    alert_rows = [(v, a.kind.value.replace("_", " "), a.t, alert_sentence(a, v, now)) for v, a in alerts]
    cards = "".join(
        f'<div class="say pick" style="border-color:{palette.mismatch}" '
        f'onpointerdown="{pick.format(encode_click(vehicle.uav, t))}">'
        f'<b>▲ {vehicle.name}</b> <span class="soft">{escape(kind)}</span>'
        f'<span class="soft when">{time_of_day(t)}</span><br>{escape(text[:300])}</div>'
        for vehicle, kind, t, text in [*mismatch_rows, *alert_rows]
    )
    return f'<div class="uav">{cards or "<div class=soft>No active alerts.</div>"}</div>'


def legend_html(fleet: list[Vehicle], palette: Palette) -> str:
    """Return the legend of the lines and the measured coverage of the band; it is always visible."""
    n, coverage, quantile = fleet_coverage(fleet)
    coverage_text = f"coverage {coverage * 100:.0f} %, n = {n}" if n else "coverage not measured yet"
    parts = (
        f'<i class="line" style="background:{palette.actual}"></i>flown',
        f'<i class="line dash" style="color:{palette.ink}"></i>predicted',
        f'<i class="band" style="background:{palette.tube}"></i>{quantile * 100:.0f} % band: <b>{coverage_text}</b>',
        f'<i class="ring" style="border-color:{palette.horizon}"></i>horizon: error reaches 10 %',
        f'<i class="line dash" style="color:{palette.muted}"></i>beyond the horizon',
    )
    return f'<div class="legend">{"".join(f"<span>{part}</span>" for part in parts)}</div>'


def fleet_coverage(fleet: list[Vehicle]) -> tuple[int, float, float]:
    """Return the number of evaluated predictions, their coverage and the nominal coverage."""
    predictions = [v.prediction for v in fleet if v.prediction is not None]
    measured = [p for p in predictions if p.coverage_n > 0 and isfinite(p.coverage)]
    n = sum(p.coverage_n for p in measured)
    coverage = sum(p.coverage * p.coverage_n for p in measured) / n if n else 0.0
    return n, coverage, predictions[0].quantile if predictions else 0.9


def age_text(seconds: float) -> str:
    """Format an age."""
    if not isfinite(seconds):
        return "never received"
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
