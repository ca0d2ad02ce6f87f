"""Data of one UAV as CSV: position, attitude, state and predictions."""

import csv
import io
from datetime import UTC, datetime

import numpy as np

from fleet.frames import to_geodetic
from viewer.store.place import UNIT_M, Place
from viewer.store.received.datatime import is_dated
from viewer.timeline.recording import Tape

COLUMNS = (
    *("t_s", "utc", "lat_deg", "lon_deg", "alt_m", "phi_deg", "theta_deg", "psi_deg", "Va_m_s"),
    *("state", "mode", "armed", "link", "fit_percent", "horizon_s", "predicted_at_s", "alerts"),
)
FORMULA = ("=", "+", "-", "@", "\t", "\r")  # first characters of a formula in a spreadsheet


def table(tape: Tape, place: Place) -> str:
    """Return every recorded row of a UAV with its state at that time.

    Args:
        recording: its recording
        scene_frame: frame of the scene
    Returns:
        CSV with a header; times in seconds since 1970, angles in degrees
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    n = len(tape)
    t, x = tape.t[:n].copy(), tape.x[:n].astype(float)
    ned = x[:, [1, 0, 2]] * [UNIT_M, UNIT_M, -UNIT_M]
    for at, row, (lat, lon, alt) in zip(t, x, to_geodetic(place.origin, ned), strict=True):
        turn = np.degrees(row[3:6])
        when = datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds") if is_dated(at) else ""
        where = [f"{at:.3f}", when, f"{lat * 1e-7:.7f}", f"{lon * 1e-7:.7f}", f"{alt * 1e-3:.2f}"]
        writer.writerow([*where, *(f"{angle:.2f}" for angle in turn), f"{row[6]:.2f}", *_known(tape, float(at))])
    return out.getvalue()


def _known(tape: Tape, t: float) -> list[str]:
    how, told = tape.stood_at(t), next((one for one in reversed(tape.told) if one.t <= t), None)
    horizon = [f"{told.until:.1f}", f"{told.t:.3f}"] if told is not None else ["", ""]
    if how is None:
        return ["", "", "", "", "", *horizon, ""]
    said = "; ".join(alert.sentence for alert in how.alerts.values())
    fit = "" if how.fit is None else f"{how.fit:.0f}"
    words = [how.state.value, how.mode, "armed" if how.armed else "disarmed", how.link.value, fit]
    return [plain(word) for word in (*words, *horizon, said)]


def plain(word: str) -> str:
    """Prefix received text with an apostrophe when a spreadsheet would read it as a formula."""
    return f"'{word}" if word.startswith(FORMULA) and not word.lstrip("+-").replace(".", "", 1).isdecimal() else word
