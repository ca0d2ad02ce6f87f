"""Decode and validate the payload of a query: a `WhatIf`, or an error that names what is wrong."""

from collections.abc import Iterator
from math import isfinite, pi

import msgspec

from fleet.contract import MAX_ITEMS, WhatIf, WhatIfStart
from twin_worker.prediction.autopilot_parameters import range_error

MAX_BYTES = 1 << 18  # of a payload
_MAX_PARAMS = 2_000
_MAX_SPEED, _MAX_WIND = 300.0, 100.0  # [m/s]
_MIN_ALTITUDE, _MAX_ALTITUDE = -500_000, 100_000_000  # [mm above mean sea level]
_DECODER = msgspec.msgpack.Decoder(WhatIf)


def read_query(payload: bytes) -> WhatIf:
    """Decode and validate one query.

    Raises:
        ValueError: when it violates the contract or a limit; the message names the correction.
    """
    if len(payload) > MAX_BYTES:
        raise ValueError(f"what if: found {len(payload):,} bytes, expected at most {MAX_BYTES:,}; shorten the mission")
    try:
        query = _DECODER.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        reason = str(error) if isinstance(error, msgspec.ValidationError) else "no msgpack map"
        raise ValueError(f"what if: found an invalid payload ({reason}), expected {_EXPECTED}") from None
    for error_text in _find_errors(query):
        raise ValueError(f"what if: {error_text}")
    return query


_EXPECTED = f"a map of {', '.join(WhatIf.__struct_fields__)}; see `fleet schema prediction`"


def _find_errors(query: WhatIf) -> Iterator[str]:
    """Yield the errors of a query; nan fails every comparison."""
    items = query.items or ()
    if len(items) > MAX_ITEMS:
        yield f"found {len(items):,} mission items, expected at most {MAX_ITEMS:,}; shorten the mission"
    seqs = {item.seq for item in items}
    if len(seqs) < len(items) or any(not 0 <= seq < MAX_ITEMS for seq in seqs):
        yield f"items: found numbers {min(seqs)}..{max(seqs)}, expected each of 0..{MAX_ITEMS - 1} once; renumber them"
    if query.seq is not None and query.items is not None and query.seq not in seqs:
        yield f"seq: found {query.seq}, expected the number of one of the {len(items)} items; choose one of them"
    if query.speed is not None and not 0 < query.speed <= _MAX_SPEED:
        yield f"speed: found {query.speed} m/s, expected above 0 to {_MAX_SPEED:.0f}; correct it"
    if query.wind is not None and not all(abs(w) <= _MAX_WIND for w in query.wind):
        yield f"wind: found {query.wind} m/s, expected north and east within {_MAX_WIND:.0f}; correct it"
    if query.start is not None:
        yield from _find_start_errors(query.start)
    yield from _find_param_errors(query.params)


def _find_start_errors(start: WhatIfStart) -> Iterator[str]:
    if abs(start.lat_e7) > 890_000_000 or abs(start.lon_e7) > 1_800_000_000:
        yield f"start: found {start.lat_e7}, {start.lon_e7} (1e-7 deg), expected within 89 and 180 deg; correct it"
    if not _MIN_ALTITUDE <= start.alt_mm <= _MAX_ALTITUDE:
        yield f"start: found an altitude of {start.alt_mm} mm, expected {_MIN_ALTITUDE} to {_MAX_ALTITUDE}; correct it"
    if start.heading is not None and not abs(start.heading) <= 2 * pi:
        yield f"start: found heading {start.heading} rad, expected within 2 pi; give radians"
    if start.speed is not None and not 0 <= start.speed <= _MAX_SPEED:
        yield f"start: found speed {start.speed} m/s, expected 0 to {_MAX_SPEED:.0f}; correct it"


def _find_param_errors(params: dict[str, float]) -> Iterator[str]:
    if len(params) > _MAX_PARAMS:
        yield f"params: found {len(params):,}, expected at most {_MAX_PARAMS:,}; name only those to change"
    for name, value in params.items():
        if not isfinite(value):
            yield f"params: found {name[:40]} {value}, expected a finite number; correct it"
        if reason := range_error(name, value):
            yield f"params {reason}; correct it"
