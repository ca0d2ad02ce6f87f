"""Texts and time spans of a mismatch on the page. Received texts are escaped here."""

from html import escape
from math import isfinite

import numpy as np

from fleet.contract import Found, Mismatch
from viewer.theme.palette import Palette

MOST = 12  # segments and causes shown of one UAV
MOST_WORDS = 600  # characters of a text
_WORD = {Found.NAMED: "named", Found.SUSPECTED: "suspected", Found.UNKNOWN: "unknown physics"}


def in_force(found: Mismatch | None) -> bool:
    """Return whether a mismatch is named or unknown; a suspected mismatch does not count."""
    return found is not None and found.outcome in (Found.NAMED, Found.UNKNOWN)


def short(found: Mismatch) -> str:
    """Return a short description, not escaped."""
    names = " and ".join(_where(one.name, one.surface) for one in found.causes[:3] if one.name != "unknown")
    if found.outcome is Found.UNKNOWN:
        return f"unknown physics in {found.causes[0].channel[:40]}" if found.causes else "unknown physics"
    return names or _WORD.get(found.outcome, "")


def _where(name: str, surface: str) -> str:
    return name[:40].replace("_", " ") + (f" of the {surface[:20]}" if surface else "")


def spans(found: Mismatch | None, newest: float) -> list[tuple[float, float]]:
    """Return its located spans, (begin, end) in data time [s]; the last one extends to `newest`."""
    if found is None or found.outcome is Found.NONE:
        return []
    pairs = [pair for one in found.causes[:MOST] for pair in one.segments[:MOST]][:MOST]
    sound = [(begin, end) for begin, end in pairs if isfinite(begin) and isfinite(end)]
    return [(begin, newest if end >= found.t - 5.0 else min(end, newest)) for begin, end in sound]


def within(t: np.ndarray, found: Mismatch | None) -> np.ndarray:
    """Return a mask (n,) of the increasing times (n,) that lie in a located span."""
    inside = np.zeros(len(t), bool)
    for begin, end in spans(found, float(t[-1])) if len(t) else []:
        inside |= (t >= begin) & (t <= end)
    return inside


def card(found: Mismatch | None, palette: Palette) -> str:
    """Return the mismatch with its evidence as HTML; empty without a mismatch."""
    if found is None or found.outcome is Found.NONE:
        return ""
    colour = palette.mismatch if in_force(found) else palette.identifying
    head = f"{'▲' if in_force(found) else '△'} mismatch {_WORD[found.outcome]}"
    rows = "".join(f'<tr><td class="soft key">{k}</td><td class="value">{v}</td></tr>' for k, v in _proof(found))
    model = "included in the prediction model" if found.adapted else "not in the prediction model"
    return (
        f'<div class="say mismatch" style="border-color:{colour}"><b style="color:{colour}">{head}</b> '
        f'<span class="soft">{model}</span><br>{escape(found.sentence[:MOST_WORDS])}<table>{rows}</table></div>'
    )


def _proof(found: Mismatch) -> list[tuple[str, str]]:
    pairs = (
        ("residual", found.fit_before, found.fit_after, "σ of nominal flight, held-out data"),
        ("force error", found.force_before, found.force_after, "m/s², held-out data"),
        ("5 s free run", found.stray_before, found.stray_after, "°"),
    )
    return [
        (name, f"{before:.2f} → <b>{after:.2f}</b> {unit}")
        for name, before, after, unit in pairs
        if before is not None and after is not None and isfinite(before) and isfinite(after)
    ]
