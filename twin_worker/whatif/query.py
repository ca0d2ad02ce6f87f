"""Decode and validate the payload of a query: a `WhatIf`, or an error that names what is wrong."""

from collections.abc import Iterator
from math import isfinite, pi

import msgspec

from fleet.contract import MAX_ITEMS, WhatIf, WhatIfStart
from twin_worker.prediction.autopilot_parameters import why_unusable

MOST_BYTES = 1 << 18  # of a payload
_MOST_PARAMS = 2_000
_MOST_SPEED, _MOST_WIND = 300.0, 100.0  # [m/s]
_LOWEST, _HIGHEST = -500_000, 100_000_000  # [mm above mean sea level]
_READ = msgspec.msgpack.Decoder(WhatIf)


def read(payload: bytes) -> WhatIf:
    """Decode and validate one query.

    Raises:
        ValueError: when it violates the contract or a limit; the message names the correction.
    """
    if len(payload) > MOST_BYTES:
        raise ValueError(f"what if: found {len(payload):,} bytes, expected at most {MOST_BYTES:,}; shorten the mission")
    try:
        asked = _READ.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        what = str(error) if isinstance(error, msgspec.ValidationError) else "no msgpack map"
        raise ValueError(f"what if: found an invalid payload ({what}), expected {_EXPECTED}") from None
    for complaint in _complaints(asked):
        raise ValueError(f"what if: {complaint}")
    return asked


_EXPECTED = f"a map of {', '.join(WhatIf.__struct_fields__)}; see `fleet schema prediction`"


def _complaints(asked: WhatIf) -> Iterator[str]:
    """Yield the errors of a query; nan fails every comparison."""
    items = asked.items or ()
    if len(items) > MAX_ITEMS:
        yield f"found {len(items):,} mission items, expected at most {MAX_ITEMS:,}; shorten the mission"
    seqs = {item.seq for item in items}
    if len(seqs) < len(items) or any(not 0 <= seq < MAX_ITEMS for seq in seqs):
        yield f"items: found numbers {min(seqs)}..{max(seqs)}, expected each of 0..{MAX_ITEMS - 1} once; renumber them"
    if asked.seq is not None and asked.items is not None and asked.seq not in seqs:
        yield f"seq: found {asked.seq}, expected the number of one of the {len(items)} items; choose one of them"
    if asked.speed is not None and not 0 < asked.speed <= _MOST_SPEED:
        yield f"speed: found {asked.speed} m/s, expected above 0 to {_MOST_SPEED:.0f}; correct it"
    if asked.wind is not None and not all(abs(w) <= _MOST_WIND for w in asked.wind):
        yield f"wind: found {asked.wind} m/s, expected north and east within {_MOST_WIND:.0f}; correct it"
    if asked.start is not None:
        yield from _start_complaints(asked.start)
    yield from _params_complaints(asked.params)


def _start_complaints(start: WhatIfStart) -> Iterator[str]:
    if abs(start.lat_e7) > 890_000_000 or abs(start.lon_e7) > 1_800_000_000:
        yield f"start: found {start.lat_e7}, {start.lon_e7} (1e-7 deg), expected within 89 and 180 deg; correct it"
    if not _LOWEST <= start.alt_mm <= _HIGHEST:
        yield f"start: found an altitude of {start.alt_mm} mm, expected {_LOWEST} to {_HIGHEST}; correct it"
    if start.heading is not None and not abs(start.heading) <= 2 * pi:
        yield f"start: found heading {start.heading} rad, expected within 2 pi; give radians"
    if start.speed is not None and not 0 <= start.speed <= _MOST_SPEED:
        yield f"start: found speed {start.speed} m/s, expected 0 to {_MOST_SPEED:.0f}; correct it"


def _params_complaints(params: dict[str, float]) -> Iterator[str]:
    if len(params) > _MOST_PARAMS:
        yield f"params: found {len(params):,}, expected at most {_MOST_PARAMS:,}; name only those to change"
    for name, value in params.items():
        if not isfinite(value):
            yield f"params: found {name[:40]} {value}, expected a finite number; correct it"
        if why := why_unusable(name, value):
            yield f"params {why}; correct it"
