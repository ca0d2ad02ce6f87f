"""Telemetry that waits as bytes until it is read: whenever that is, it reads as if it had been laid at once."""

import copy

import numpy as np
import pytest

from fleet.contract import COLUMNS, FIRST_OPTIONAL_COLUMN, Array, Rows, Sample
from tests.support import flights as f
from tests.support.flights import T0
from twin_worker.ownership.handover import Snapshot, decode_snapshot, encode_snapshot
from twin_worker.telemetry.history import TelemetryHistory
from twin_worker.twin.state.state import Twin

MOST = {"position": 2e9, "leg": 1e5, "command": 1e5}
KINDS = tuple(MOST)


def odd(rng: np.random.Generator, t: np.ndarray, x: np.ndarray) -> Rows:
    """Rows that lie about themselves, in one way or another."""
    good, wide = Array.of(t, "<f8"), x.shape[1]
    return [
        Rows(t=good, x=Array.of(np.zeros((len(t), wide + 1)))),
        Rows(t=good, x=Array.of(np.zeros((len(t) + 1, wide)))),
        Rows(t=good, x=Array("<f4", x.shape, bytes(4 * x.size - 1))),
        Rows(t=good, x=Array("<c8", x.shape, bytes(8 * x.size))),
        Rows(t=Array("<f8", (len(t),), good.data + b"\0"), x=Array.of(x)),
        Rows(t=Array("<f8", (len(t), 1), good.data), x=Array.of(x)),
        Rows(t=Array("<i8", (len(t),), good.data), x=Array.of(x)),
        Rows(t=Array.of([], "<f8"), x=Array.of(np.zeros((0, wide)))),
    ][rng.integers(8)]


def talk(seed: int, messages: int = 300) -> list[Sample]:
    """Everything that a link can do to rows, at ten messages a second."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(messages):
        now, kinds = T0 + 0.1 * k, {}
        for name in KINDS:
            n, wide = int(rng.choice([0, 1, 2, 3, 30], p=[0.3, 0.3, 0.2, 0.15, 0.05])), len(COLUMNS[name])
            if not n:
                continue
            t = np.round(now - 0.5 * rng.random(n), 1)  # late, out of order, repeated
            x = rng.integers(-1000, 1000, (n, wide)).astype(float)
            if rng.random() < 0.1:
                t[rng.integers(n)] = rng.choice([np.nan, np.inf, -np.inf, 0.0, -1.0, now + 0.9, now + 1.1, now + 1e6])
            if rng.random() < 0.1:
                x[rng.integers(n), rng.integers(wide)] = rng.choice([np.nan, np.inf, 1e38])
            whole = np.isfinite(x).all() and np.abs(x).max() < 1e9
            dtype = rng.choice(["<f4", "<f8", "<i4" if whole else "<f8"], p=[0.8, 0.1, 0.1])
            kinds[name] = odd(rng, t, x) if rng.random() < 0.05 else Rows(t=Array.of(t, "<f8"), x=Array.of(x, dtype))
        found.append(Sample(uav=1, t=now, **kinds))
    return found


class Plain:
    """What a history is to be, one row after the other."""

    def __init__(self) -> None:
        self.newest, self.heard = -np.inf, {name: {} for name in KINDS}

    def add(self, sample: Sample) -> int:
        return sum(self._take(name, getattr(sample, name), sample.t + 1.0) for name in KINDS)

    def _take(self, name: str, rows: Rows | None, latest: float) -> bool:
        if rows is None:
            return False
        try:
            t, x = rows.t.numpy(), rows.x.numpy().astype(float)
        except ValueError:
            return True
        if t.ndim != 1 or x.shape != (len(t), len(COLUMNS[name])) or not len(t):
            return True
        timed = [(float(at), row.tolist()) for at, row in zip(t, x, strict=True) if 0 < at <= latest]
        self.newest = max([self.newest, *(at for at, _ in timed)])
        for at, row in timed:
            if all(abs(value) < MOST[name] for value in row[: FIRST_OPTIONAL_COLUMN.get(name)]):
                self.heard[name].setdefault(at, row)
        return len(timed) < len(t)

    def rows(self, name: str, since: float) -> list[tuple[float, list[float]]]:
        return [(at, row) for at, row in sorted(self.heard[name].items()) if at >= since]


def same(history: TelemetryHistory, plain: Plain, name: str, since: float) -> None:
    t, x = history.rows(name, since)
    want = plain.rows(name, since)
    assert t.tolist() == [at for at, _ in want]
    np.testing.assert_array_equal(x, np.array([row for _, row in want]).reshape(-1, len(COLUMNS[name])))


@pytest.mark.parametrize("every", [1, 7, 1000])  # messages between two readings
@pytest.mark.parametrize("seed", range(4))
def test_rows_read_the_same_however_long_they_have_waited(seed: int, every: int) -> None:
    history, plain = TelemetryHistory(keep_s=12.0), Plain()
    told = talk(seed)
    for k, sample in enumerate(told):
        assert history.add(sample) == plain.add(sample), f"message {k}"
        assert history.newest == plain.newest
        if k % every == every - 1:
            same(history, plain, KINDS[k % 3], history.newest - 3.0)
    for name in KINDS:
        same(history, plain, name, history.newest - history.keep_s)
        assert len(plain.rows(name, history.newest - 3.0)) > 5, "or nothing is compared"


@pytest.mark.parametrize("seed", range(4))
def test_a_history_goes_to_another_worker_with_what_waits(seed: int) -> None:
    told, plain, history = talk(seed, 100), Plain(), TelemetryHistory()
    for k, sample in enumerate(told):
        history.add(sample)
        plain.add(sample)
        if k == 50:
            twin = Twin.of(1)
            twin.telemetry.history = copy.deepcopy(history)
            data = encode_snapshot(Snapshot(twin))
            received = decode_snapshot(data, 1)
            assert encode_snapshot(received) == data
            history = received.twin.telemetry.history
    for name in KINDS:
        same(history, plain, name, -np.inf)


def test_what_nobody_reads_takes_no_more_place_than_what_is_kept() -> None:
    history = TelemetryHistory(keep_s=10.0)
    for k in range(20_000):
        history.add(f.sample(t=T0 + 0.1 * k, imu=([T0 + 0.1 * k], [[0.0] * 6])))
    assert len(history.rows_since("imu")[0]) < 1_000


def test_rows_are_the_caller_s_own_and_a_look_is_not() -> None:
    history = TelemetryHistory()
    history.add(f.sample(leg=([T0], [[1.0]])))
    history.rows("leg")[1][:] = 5.0
    assert history.rows_since("leg")[1].tolist() == [[1.0]]
    assert np.shares_memory(history.rows_since("leg")[1], history.rows_since("leg")[1])


def test_rows_of_8_and_of_16_outputs_are_one_series() -> None:
    history = TelemetryHistory()
    for k, width in enumerate((8, 16, 8, 16)):
        t = T0 + k + np.array([0.0, 0.5])
        x = np.full((2, width), 1000.0 + k)
        history.add(Sample(uav=1, t=t[-1], servo=Rows(t=Array.of(t, "<f8"), x=Array.of(x))))
        assert history.rows("servo")[1].shape == (2 * k + 2, 8 if k == 0 else 16)
    t, x = history.rows("servo")
    assert x[:, 0].tolist() == [1000, 1000, 1001, 1001, 1002, 1002, 1003, 1003]
    assert x[:, 15].tolist() == [0, 0, 1001, 1001, 0, 0, 1003, 1003]
    assert history.is_consistent()
    wrong = Rows(t=Array.of(T0 + np.array([9.0]), "<f8"), x=Array.of(np.zeros((1, 12))))
    assert history.add(Sample(uav=1, t=T0 + 9.0, servo=wrong)) == 1
