"""Data of one UAV as CSV: position, attitude, state and predictions."""

import csv
import io
from datetime import UTC, datetime

import numpy as np

from fleet.frames import to_geodetic
from viewer.store.place import UNIT_M, SceneFrame
from viewer.store.received.datatime import is_dated
from viewer.timeline.recording import UavRecording

COLUMNS = (
    *("t_s", "utc", "lat_deg", "lon_deg", "alt_m", "phi_deg", "theta_deg", "psi_deg", "Va_m_s"),
    *("state", "mode", "armed", "link", "fit_percent", "horizon_s", "predicted_at_s", "alerts"),
)
FORMULA = ("=", "+", "-", "@", "\t", "\r")  # first characters of a formula in a spreadsheet


def table(recording: UavRecording, scene_frame: SceneFrame) -> str:
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
    n = len(recording)
    t, x = recording.t[:n].copy(), recording.x[:n].astype(float)
    ned = x[:, [1, 0, 2]] * [UNIT_M, UNIT_M, -UNIT_M]
    for at, row, (lat, lon, alt) in zip(t, x, to_geodetic(scene_frame.origin, ned), strict=True):
        angles_deg = np.degrees(row[3:6])
        when = datetime.fromtimestamp(at, UTC).isoformat(timespec="milliseconds") if is_dated(at) else ""
        where = [f"{at:.3f}", when, f"{lat * 1e-7:.7f}", f"{lon * 1e-7:.7f}", f"{alt * 1e-3:.2f}"]
        writer.writerow(
            [*where, *(f"{angle:.2f}" for angle in angles_deg), f"{row[6]:.2f}", *_state_fields(recording, float(at))]
        )
    return out.getvalue()


def _state_fields(recording: UavRecording, t: float) -> list[str]:
    record, forecast = (
        recording.state_at(t),
        next((prediction for prediction in reversed(recording.predictions) if prediction.t <= t), None),
    )
    horizon = [f"{forecast.horizon_s:.1f}", f"{forecast.t:.3f}"] if forecast is not None else ["", ""]
    if record is None:
        return ["", "", "", "", "", *horizon, ""]
    alerts = "; ".join(alert.sentence for alert in record.alerts.values())
    fit = "" if record.fit is None else f"{record.fit:.0f}"
    fields = [record.state.value, record.mode, "armed" if record.armed else "disarmed", record.link.value, fit]
    return [escape_formula(field) for field in (*fields, *horizon, alerts)]


def escape_formula(text: str) -> str:
    """Prefix received text with an apostrophe when a spreadsheet would read it as a formula."""
    return f"'{text}" if text.startswith(FORMULA) and not text.lstrip("+-").replace(".", "", 1).isdecimal() else text
