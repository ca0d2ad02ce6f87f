"""What the benches say of memory: what grows is told from what fills, and from noise."""

import numpy as np
import pytest

from tests.bench.growth import Row, grown


def rows(mb_a_minute: float, *, minutes: float = 20.0, aircraft: int = 200) -> list[Row]:
    """Make a process that fills for six minutes and then grows, measured every 5 s with 0.5 MB of noise."""
    t, r = np.arange(0.0, minutes, 5 / 60), np.random.default_rng(4)
    mb = 100 + 10 * np.minimum(t, 6.0) + mb_a_minute * t + r.normal(0, 0.5, len(t))
    return [Row(float(at), "one", 60.0 * float(at), aircraft, float(held)) for at, held in zip(t, mb, strict=True)]


def test_what_fills_and_then_stays_does_not_grow() -> None:
    found = grown(rows(0.0), 6.0)
    assert found["grows"] is False and abs(found["mb_a_minute"]) < 3 * found["sigma"] + 1e-3
    assert found["mb_an_aircraft"] is None  # their number was always the same


def test_what_goes_on_growing_is_told_with_its_slope() -> None:
    found = grown(rows(1.5), 6.0)
    assert found["grows"] is True and found["mb_a_minute"] == pytest.approx(1.5, abs=4 * found["sigma"])


def test_more_aircraft_are_no_growth() -> None:
    flat = rows(0.0)
    more = [row._replace(aircraft=k // 24 % 4, mb=row.mb + 2.0 * (k // 24 % 4)) for k, row in enumerate(flat)]
    found = grown(more, 6.0)
    assert found["grows"] is False and found["mb_an_aircraft"] == pytest.approx(2.0, abs=0.2)


def test_of_a_short_run_nothing_is_said() -> None:
    assert grown(rows(1.5, minutes=6.2), 6.0)["grows"] is None
    assert grown([], 6.0) == {"rows": 0, "grows": None}
