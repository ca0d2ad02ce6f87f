"""Write messages of the bus as an MCAP file with Foxglove schemas."""

import json
from collections import Counter
from contextlib import AbstractContextManager
from typing import IO, Any

from mcap.writer import Writer

from fleet.contract import Alert, Message, Prediction, Sample
from fleet.export.foxglove import (
    SCHEMAS,
    location_fix,
    log,
    map_prediction,
    nanoseconds,
    scene_prediction,
)
from fleet.export.geometry import position_rows, predicted_path
from fleet.frames import Origin


class McapExport(AbstractContextManager):
    """An MCAP file; use it in a `with` statement, whose end writes the index.

    Args:
        file: opened for writing
    Attributes:
        counts: messages written, by schema
        invalid: messages left out because their arrays are invalid
    """

    def __init__(self, file: IO[bytes]) -> None:
        self.counts: Counter[str] = Counter()
        self.invalid = 0
        self._writer = Writer(file)
        self._writer.start(library="ParaUAV")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._origin: Origin | None = None

    def add(self, message: Message) -> None:
        """Write one message."""
        uav = message.uav
        if isinstance(message, Sample):
            for t, position in zip(*position_rows(message), strict=True):
                fix = location_fix(float(t), uav, tuple(position.tolist()))
                self._write(f"/uav/{uav}/location", "foxglove.LocationFix", float(t), fix)
        elif isinstance(message, Alert):
            self._write("/alerts", "foxglove.Log", message.t, log(message))
        elif isinstance(message, Prediction):
            self._add_prediction(message)

    def _add_prediction(self, message: Prediction) -> None:
        try:
            path = predicted_path(message)
        except ValueError:
            self.invalid += 1
            return
        if path is None:
            return
        self._origin = self._origin or path.origin
        prefix, t = f"/uav/{message.uav}", message.t
        self._write(f"{prefix}/prediction", "foxglove.GeoJSON", t, map_prediction(message, path))
        self._write(f"{prefix}/scene", "foxglove.SceneUpdate", t, scene_prediction(message, path, self._origin))

    def _write(self, topic: str, schema: str, t: float, content: dict[str, Any]) -> None:
        if (channel := self._channels.get(topic)) is None:
            if schema not in self._schemas:
                data = json.dumps(SCHEMAS[schema]).encode()
                self._schemas[schema] = self._writer.register_schema(schema, "jsonschema", data)
            channel = self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[schema])
        data, when = json.dumps(content, allow_nan=False).encode(), nanoseconds(t)
        self._writer.add_message(channel, log_time=when, data=data, publish_time=when)
        self.counts[schema.removeprefix("foxglove.")] += 1

    def __exit__(self, *_: object) -> None:
        self._writer.finish()
