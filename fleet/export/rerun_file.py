"""Write messages of the bus as a recording of Rerun (`.rrd`): map, 3-D scene, horizon as a curve, and a log of alerts.

rerun-sdk is optional (extra `rerun`, 170 MB): it is imported when a file is written.
Source: Rerun documentation, "Archetypes".
"""

import math
from collections import Counter
from contextlib import AbstractContextManager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from fleet.contract import Alert, Message, Prediction, Sample
from fleet.export.foxglove import alert_text
from fleet.export.geometry import coordinates, cut_line, enu, position_rows, predicted_path
from fleet.frames import Origin, to_ned

_COLOUR = (43, 196, 154)  # of a verified model on the viewer
_REGION_COLOUR = (*_COLOUR, 64)
_TIMELINE = "time"
_MAX_T = 4e9  # latest time that is written as a date [s since 1970]
_LINE_PX = -2.0  # Rerun reads a negative radius as a size on the screen


def check_rerun() -> None:
    """Check that rerun-sdk is installed.

    Raises:
        ValueError: when it is not; the text has the command that installs it.
    """
    if find_spec("rerun") is None:
        raise ValueError(
            "FILE: found no package rerun-sdk, expected it for a .rrd file; "
            "install it with `pip install --no-deps --require-hashes -r requirements-rerun.lock`"
        )


class RerunExport(AbstractContextManager):
    """A recording of Rerun; use it in a `with` statement, whose end completes the file.

    Entities: `uav/ID/location` (GeoPoints), `uav/ID/position` (Points3D), `uav/ID/prediction/map` (GeoLineStrings),
    `uav/ID/prediction/path` (LineStrips3D), `uav/ID/prediction/region` (Ellipsoids3D), `uav/ID/horizon_s` (Scalars),
    `alerts` (TextLog). The 3-D ones are east, north, up from the first position [m]. A prediction ends at its horizon.

    Args:
        path: file to write
    Attributes:
        counts: rows written, by archetype
        invalid: messages left out because their arrays or their time are invalid

    Raises:
        ValueError: when rerun-sdk is not installed.
    """

    def __init__(self, path: Path) -> None:
        check_rerun()
        import rerun

        self.counts: Counter[str] = Counter()
        self.invalid = 0
        self._rerun, self._stream = rerun, rerun.RecordingStream("ParaUAV")
        self._stream.save(path)
        self._stream.set_log_tick_enabled(False)
        self._stream.set_log_time_enabled(False)
        self._origin: Origin | None = None
        self._valid_until: dict[int, float] = {}  # by UAV: end of the newest prediction [s since 1970]

    def add(self, message: Message) -> None:
        """Write one message."""
        if isinstance(message, Sample):
            self._add_positions(message)
        elif isinstance(message, Alert):
            level = self._rerun.TextLogLevel.WARN if message.active else self._rerun.TextLogLevel.INFO
            self._log(message.t, "alerts", self._rerun.TextLog(alert_text(message), level=level))
        elif isinstance(message, Prediction):
            self._add_prediction(message)

    def _add_positions(self, message: Sample) -> None:
        t, rows = position_rows(message)
        valid = (t >= 0) & (t < _MAX_T)
        t, rows = t[valid], rows[valid]
        if not len(t):
            return
        self._origin = self._origin or Origin(*(int(value) for value in rows[0]))
        geo, points = self._rerun.GeoPoints, self._rerun.Points3D
        up = to_ned(self._origin, *rows.T)[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
        index = [self._rerun.TimeColumn(_TIMELINE, timestamp=t)]
        name = f"uav/{message.uav}"
        self._stream.send_columns(f"{name}/location", index, geo.columns(positions=rows[:, :2] * 1e-7))
        self._stream.send_columns(f"{name}/position", index, points.columns(positions=up))
        self.counts.update(GeoPoints=len(t), Points3D=len(t))

    def _add_prediction(self, message: Prediction) -> None:
        try:
            path = predicted_path(message)
        except ValueError:
            path, self.invalid = None, self.invalid + 1
        if path is None or not 0 <= message.t < _MAX_T:
            return
        rerun, uav, t = self._rerun, message.uav, message.t
        self._origin = self._origin or path.origin
        self._end_prediction(uav, before=t)
        ahead = np.unique(np.append(path.ahead[path.ahead < path.horizon_s], path.horizon_s))
        marks = path.marks()
        ned, (centres, half_axes) = path.at(ahead)[0], path.at(marks)
        on_map = [[[lat, lon] for lon, lat, _ in part] for part in cut_line(coordinates(path.origin, ned))]
        turns = [
            rerun.RotationAxisAngle(axis=[0, 0, 1], radians=math.pi / 2 - heading) for heading in path.headings(marks)
        ]
        prefix = f"uav/{uav}/prediction"
        line = {"radii": _LINE_PX, "colors": [_COLOUR]}
        self._log(t, f"{prefix}/map", rerun.GeoLineStrings(lat_lon=on_map, **line))
        self._log(t, f"{prefix}/path", rerun.LineStrips3D([enu(path, ned, self._origin)], **line))
        if len(marks):
            region = rerun.Ellipsoids3D(
                half_sizes=half_axes,
                centers=enu(path, centres, self._origin),
                rotation_axis_angles=turns,
                colors=[_REGION_COLOUR],
                fill_mode="solid",
            )
            self._log(t, f"{prefix}/region", region)
        self._log(t, f"uav/{uav}/horizon_s", rerun.Scalars(path.horizon_s))
        self._valid_until[uav] = t + path.horizon_s

    def _end_prediction(self, uav: int, before: float = math.inf) -> None:
        """Clear the prediction of a UAV at its horizon unless a newer one replaced it."""
        if (end := self._valid_until.pop(uav, math.inf)) < before:
            self._log(end, f"uav/{uav}/prediction", self._rerun.Clear(recursive=True))

    def _log(self, t: float, entity: str, content: Any) -> None:
        if not 0 <= t < _MAX_T:
            self.invalid += 1
            return
        self._stream.set_time(_TIMELINE, timestamp=t)
        self._stream.log(entity, content)
        self.counts[type(content).__name__] += 1

    def __exit__(self, *_: object) -> None:
        for uav in list(self._valid_until):
            self._end_prediction(uav)
        self._stream.disconnect()
