"""Limits of detection: the smallest magnitude of each effect that a diagnosis names with 90 % probability.

The table `detection_limits.json` is measured, not derived: `python -m fleet.blind_test.limits` builds it from results
of `fleet prove`. It has one source for each aircraft and reference of the diagnosis, with its provenance.
"""

from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

import msgspec

FORMAT = "parauav.detection_limits.1"
TABLE = Path(__file__).with_suffix(".json")
PROBABILITY = 0.9
MIN_FLIGHTS = 4  # flights with an effect that say something about it
# depend on the size of the aircraft or on its card
_OF_ONE_AIRCRAFT = ("dCD", "dCD_relative", "dmass_kg", "dmass_relative", "dx_m", "dx_relative")
_MAX_SPEED_RATIO = 1.7  # flights of another speed are of another kind of aircraft
_SHARES = ("loss", "scale", "fraction", "density_ratio", "lift_loss")
_UNITS = {"mps": "m/s", "mps2": "m/s2", "dps": "deg/s", "deg": "deg", "m": "m", "s": "s", "kg": "kg"}


class DetectionLimit(msgspec.Struct, frozen=True):
    """Limit of one effect and part.

    Attributes:
        effect, part: name, and surface or axis or empty
        parameter: of the report whose magnitude it is; of a ratio its distance from 1
        limit: magnitude named with 90 % probability; None: not reached up to `largest`
        largest: largest magnitude tried
        named, flights: flights with this effect that were named, and all
    """

    effect: str
    part: str
    parameter: str
    limit: float | None
    largest: float
    named: int
    flights: int


class LimitSource(msgspec.Struct, frozen=True):
    """Limits of one aircraft under one reference.

    Attributes:
        aircraft: name
        reference: model, other flights or own past
        vane: the accelerometer is fast enough to measure flow angles
        speed: median airspeed [m/s]
        flights: altered or simulated flights with one effect; recordings: distinct flights they come from
        seeds: of the blind tests; made: date
        limits: one for each effect and part
    """

    aircraft: str
    reference: str
    vane: bool
    speed: float
    flights: int
    recordings: int
    seeds: tuple[int, ...]
    made: str
    limits: tuple[DetectionLimit, ...]

    @property
    def origin(self) -> str:
        """Return the provenance as text."""
        of = f"{self.flights} flights with one concealed effect"
        return f"{self.aircraft}, {of} from {self.recordings} recordings, reference {self.reference}, {self.made}"


class LimitTable(msgspec.Struct, frozen=True):
    """All sources."""

    format: str = FORMAT
    sources: tuple[LimitSource, ...] = ()


@cache
def load_table(path: Path = TABLE) -> LimitTable:
    """Read the table; empty where there is none.

    Raises:
        ValueError: if the file is no table; rebuild it.
    """
    if not path.exists():
        return LimitTable()
    try:
        table = msgspec.json.decode(path.read_bytes(), type=LimitTable)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path.name}: found {error}, expected a table of limits; rebuild it") from None
    if table.format != FORMAT:
        raise ValueError(f"{path.name}: found format {table.format!r}, expected {FORMAT}; rebuild it")
    return table


def find_source(table: LimitTable, vane: bool, own_past: bool, speed: float) -> LimitSource | None:
    """Return the source nearest in speed of the same telemetry and reference; None without one."""
    same = [
        source
        for source in table.sources
        if source.vane == vane
        and (source.reference == "own past") == own_past
        and 1.0 / _MAX_SPEED_RATIO < speed / source.speed < _MAX_SPEED_RATIO
    ]
    return min(same, key=lambda source: abs(source.speed - speed), default=None)


def describe_size(parameter: str, size: float) -> str:
    """Format a magnitude with its unit, from the suffix of its parameter."""
    if parameter in _SHARES:
        return f"{100.0 * size:.2g} %"
    unit = _UNITS.get(parameter.rpartition("_")[2], "") if "_" in parameter else ""
    return f"{size:.2g} {unit}".rstrip()


def describe_limits(limits: Iterable[DetectionLimit]) -> str:
    """List limits in a sentence, e.g. `thrust_loss 9 %, gyro_bias (p) 1.2 deg/s`."""
    texts = []
    for one in limits:
        if one.limit is not None:
            part = f" ({one.part})" if one.part else ""
            texts.append(f"{one.effect}{part} {describe_size(one.parameter, one.limit)}")
    return ", ".join(texts)


def report_sentences(source: LimitSource | None, named: Sequence[str]) -> tuple[str, ...]:
    """Return what would have been named in a flight besides `named`, and what would not, with the origin."""
    if source is None:
        return ()
    others = [one for one in source.limits if one.effect not in named and one.parameter not in _OF_ONE_AIRCRAFT]
    never = sorted({_label(one) for one in others if one.limit is None and one.flights >= MIN_FLIGHTS})
    above = describe_limits(others)
    sentences = []
    if above:
        sentences.append(f"would have been named here with {PROBABILITY:.0%} probability above: {above}")
    if never:
        sentences.append(f"not named reliably at any magnitude tried: {', '.join(never)}")
    return (*sentences, f"limits of detection measured on {source.origin}") if sentences else ()


def _label(one: DetectionLimit) -> str:
    return f"{one.effect} ({one.part})" if one.part else one.effect
