"""Options of every command that reads recordings: mission, parameters and column map from files."""

import argparse
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fleet.contract import Item, Mission, Params, Sample
from fleet.process.file_options import input_file
from fleet.telemetry.mavlink.microservices.parameter_file import read_parameters
from fleet.telemetry.mavlink.microservices.waypoints import read_waypoints

_NAMES = ("mission", "params", "columns")


def add_recording_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of recordings."""
    group = parser.add_argument_group("recordings")
    mission, params = input_file("a QGC WPL 110 file"), input_file("a parameter file")
    columns = input_file("a TOML file", "fleet.telemetry.onboard_logs.columns")
    group.add_argument(
        "--mission", type=mission, metavar="FILE", help="mission on board, QGC WPL 110, instead of the recorded one"
    )
    group.add_argument("--params", type=params, metavar="FILE", help="autopilot parameters, added to the recorded ones")
    group.add_argument(
        "--columns",
        type=columns,
        metavar="MAP",
        help="column map of .csv, .mat and .tar recordings: a TOML file, alfa or px4",
    )


@dataclass(frozen=True)
class RecordingOptions:
    """Data that a recording lacks.

    Attributes:
        mission: mission file; empty: the recorded mission
        params: parameter file; empty: none
        columns: column map, a TOML file or the name of a shipped one; empty: none
    """

    mission: str = ""
    params: str = ""
    columns: str = ""

    @classmethod
    def of(cls, args: argparse.Namespace) -> "RecordingOptions":
        """Return the options of a command line, absent ones empty."""
        return cls(*(str(getattr(args, name, None) or "") for name in _NAMES))

    def arguments(self) -> list[str]:
        """Return the options as arguments of another command."""
        return [f"--{name}={getattr(self, name)}" for name in _NAMES if getattr(self, name)]

    def supplement(self) -> "Supplement":
        """Read the files.

        Raises:
            ValueError: if one is invalid; the message names the line.
            OSError: if one cannot be read; check the path.
        """
        items = read_waypoints(Path(self.mission)) if self.mission else ()
        return Supplement(items, read_parameters(Path(self.params)) if self.params else {})


NO_OPTIONS = RecordingOptions()


@dataclass
class _Vehicle:
    """What was sent of one aircraft."""

    seq: int = -1
    started: bool = False


@dataclass
class Supplement:
    """Mission and parameters that replace or complete the recorded ones, for all aircraft of a recording.

    Attributes:
        items: mission; empty: the recorded one
        values: parameters, with precedence over the recorded ones
    """

    items: Sequence[Item] = ()
    values: dict[str, float] = field(default_factory=dict)
    _vehicles: dict[int, _Vehicle] = field(default_factory=dict)

    def apply(self, messages: Iterable[Any]) -> Iterator[Any]:
        """Yield the messages of a step with the supplied mission and parameters."""
        for message in messages:
            uav = getattr(message, "uav", None)
            if uav is None or not (self.items or self.values):
                yield message
                continue
            vehicle = self._vehicles.setdefault(uav, _Vehicle())
            if not vehicle.started:
                vehicle.started = True
                yield from self._first(uav, message.t)
            if isinstance(message, Mission) and self.items:
                continue
            if isinstance(message, Params) and self.values:
                message = Params(uav=uav, t=message.t, values=message.values | self.values, complete=message.complete)
            yield message
            if isinstance(message, Sample) and message.leg is not None and self.items:
                seq = int(message.leg.x.numpy()[-1, 0])
                if seq != vehicle.seq:
                    vehicle.seq = seq
                    yield self._mission(uav, message.t, seq)

    def _first(self, uav: int, t: float) -> Iterator[Any]:
        if self.items:
            yield self._mission(uav, t, -1)
        if self.values:
            yield Params(uav=uav, t=t, values=dict(self.values), complete=True)

    def _mission(self, uav: int, t: float, seq: int) -> Mission:
        return Mission(uav=uav, t=t, items=tuple(self.items), seq=seq, complete=True)
