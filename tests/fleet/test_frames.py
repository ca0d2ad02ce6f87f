"""Angles are wrapped to (-pi, pi] by one definition, wherever they come from."""

import re
from pathlib import Path

import numpy as np
import pytest

from fleet.frames import wrap
from fleet.telemetry.tables.dataflash import _angles

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 3])
def test_an_angle_is_wrapped_to_the_half_open_interval(turns: int) -> None:
    a = np.array([-3.0, -1e-9, 0.0, 0.5, np.pi - 1e-9, np.pi])
    assert wrap(a + 2 * np.pi * turns) == pytest.approx(a, abs=1e-12)


def test_minus_pi_is_pi_and_what_is_next_to_it_stays() -> None:
    assert wrap(-np.pi) == np.pi == wrap(np.pi)
    near = np.nextafter([-np.pi, np.pi], 0.0)
    assert wrap(near) == pytest.approx(near, abs=1e-15)
    many = np.linspace(-50.0, 50.0, 20_001)
    found = wrap(many)
    assert (found > -np.pi).all() and (found <= np.pi).all()
    assert np.exp(1j * found) == pytest.approx(np.exp(1j * many), abs=1e-12)
    assert not np.isfinite(wrap(np.array([np.nan, np.inf]))).any()


def test_a_heading_of_dataflash_is_wrapped_alike() -> None:
    class South:
        Roll, Pitch, Yaw = 0.0, 0.0, np.array([180.0, 190.0, 359.0])

    assert _angles(South)[2] == pytest.approx(np.radians([180.0, -170.0, -1.0]))


def test_nobody_wraps_radians_on_their_own() -> None:
    own = re.compile(r"pi\)\s*%\s*\(\s*2(\.0)?\s*\*\s*(np\.)?pi\)")
    files = [path for name in ("fleet", "gateway", "twin_worker", "viewer") for path in (ROOT / name).rglob("*.py")]
    assert [path.name for path in files if own.search(path.read_text())] == ["compiled_frames.py"]
