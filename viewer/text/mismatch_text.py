"""Texts and time spans of a mismatch on the page. Received texts are escaped here."""

from html import escape
from math import isfinite

import numpy as np

from fleet.contract import DiagnosisOutcome, Mismatch
from viewer.theme.palette import Palette

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
    names = " and ".join(
        _cause_text(cause.name, cause.surface) for cause in mismatch.causes[:3] if cause.name != "unknown"
    )
    if mismatch.outcome is DiagnosisOutcome.UNKNOWN:
        return f"unknown physics in {mismatch.causes[0].channel[:40]}" if mismatch.causes else "unknown physics"
    return names or _OUTCOME_TEXT.get(mismatch.outcome, "")


def _cause_text(name: str, surface: str) -> str:
    return name[:40].replace("_", " ") + (f" of the {surface[:20]}" if surface else "")


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
    rows = "".join(f'<tr><td class="soft key">{k}</td><td class="value">{v}</td></tr>' for k, v in _proof(mismatch))
    model = "included in the prediction model" if mismatch.adapted else "not in the prediction model"
    return (
        f'<div class="say mismatch" style="border-color:{colour}"><b style="color:{colour}">{head}</b> '
        f'<span class="soft">{model}</span><br>{escape(mismatch.sentence[:MAX_TEXT])}<table>{rows}</table></div>'
    )


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
