"""What no effect stands for: a hum is heard, a changed coefficient is found beside a constant; noise is neither."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from twin_worker.diagnosis.data.card import UNKNOWN
from twin_worker.diagnosis.inference.isolation.unmodelled import (
    RULES,
    Anomaly,
    ChannelEquation,
    find_tones,
    first_unexplained,
)
from twin_worker.diagnosis.model.baseline import CHANNELS, Baseline, unit_noise

STEP_S, ONSET_S = 0.2, 90.0
T = np.arange(1000) * STEP_S


def quiet(seed: int) -> Any:
    """Give a sight of noise alone, all that the finders look at."""
    n = len(T)
    return SimpleNamespace(
        modelled=SimpleNamespace(t=T),
        base=SimpleNamespace(r2={}),
        noise=unit_noise(),
        ok=np.ones(n, bool),
        e=np.random.default_rng(seed).standard_normal((n, len(CHANNELS))),
        Jn=np.zeros((n, len(CHANNELS), 1)),
        xn=np.zeros(1),
        Ann=np.eye(1),
        bn=np.zeros(1),
    )


def with_added(sight: Any, channel: str, x: np.ndarray) -> Any:
    """Add a course, (n,), to one channel's residual."""
    sight.e[:, CHANNELS.index(channel)] += x
    return sight


@pytest.mark.parametrize("hertz", [0.17, 0.93])
def test_a_hum_is_heard_in_its_channel_and_noise_is_none(hertz: float) -> None:
    hum = 1.6 * np.sin(2 * np.pi * hertz * T + 1.0) * (T > ONSET_S)
    heard = {one.channel: one for one in find_tones(with_added(quiet(1), "pitch", hum))}
    assert heard["pitch"].net_gain > RULES["tone"].min_gain and abs(heard["pitch"].t0 - ONSET_S) < 20.0
    assert max(one.net_gain for name, one in heard.items() if name != "pitch") < 0.4 * RULES["tone"].min_gain


def test_a_constant_term_does_not_drown_the_others() -> None:
    rate = np.random.default_rng(2).standard_normal(len(T))
    sight = with_added(quiet(3), "gyro_yaw", 0.8 * rate * (T > ONSET_S))
    equation = ChannelEquation(sight, "gyro_yaw", {"1": np.ones_like(T), "rate": rate})
    (_, alone), (worth, t0) = next(equation.gain_per_term()), equation.gain_of_all()
    assert alone[0] > 250.0 and worth > alone[0] - 20.0 and abs(t0 - ONSET_S) < 3.0
    assert equation.gain_in_flight()[0] > 100.0


def test_what_is_wrong_throughout_did_not_change_in_flight() -> None:
    rate = np.random.default_rng(4).standard_normal(len(T))
    equation = ChannelEquation(
        with_added(quiet(5), "gyro_yaw", 0.8 * rate), "gyro_yaw", {"1": np.ones_like(T), "rate": rate}
    )
    assert equation.gain_of_all()[0] > 250.0 and equation.gain_in_flight()[0] < 20.0


def test_one_coefficient_alone_stands_against_names_only_where_it_explains_as_much() -> None:
    base = Baseline(UNKNOWN, {}, 20.0, chance={"one:pitch:q": 100.0})
    found = [Anomaly(500.0, "pitch", 60.0, "one", "q")]
    assert first_unexplained(found, base, 520.0, still_high=False) is found[0]
    assert first_unexplained(found, base, 600.0, still_high=False) is None
    assert first_unexplained([Anomaly(190.0, "pitch", 60.0, "one", "q")], base, 0.0, still_high=False) is None
