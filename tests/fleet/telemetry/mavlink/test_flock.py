"""Rows of many aircraft as arrays: the bytes are those of the message, and nobody's rows reach another."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet.bus.codec import decode, encode
from fleet.contract import COLUMNS, Array, Rows, Sample
from fleet.telemetry.mavlink.arrays.counts import LAST_COUNTED, MISSED, RECEIVED, MessageCounters
from fleet.telemetry.mavlink.arrays.pack import FIELDS, IS_INTEGER, MAX_ROWS, WIDTHS
from fleet.telemetry.mavlink.arrays.rows import PendingRows
from fleet.telemetry.mavlink.intake import MavlinkReceiver
from tests.support.talker import T0, Talker


def made(uav: int, laid: dict[int, tuple[np.ndarray, np.ndarray]]) -> Sample:
    """Make the message the plain way."""
    rows = {}
    for field, (t, x) in laid.items():
        kind = "<i4" if IS_INTEGER[field] else "<f4"
        rows[FIELDS[field]] = Rows(Array.of(t, "<f8"), Array.of(x[:, : WIDTHS[field]], kind))
    return Sample(uav=uav, t=max(float(t[-1]) for t, _ in laid.values()), **rows)


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(0, 2**31), min_size=1, max_size=9, unique=True))
def test_packed_samples_are_the_bytes_of_the_message(seed, uavs):
    rng, shelves, want = np.random.default_rng(seed), PendingRows(), {}
    keys, times, values = [], [], []
    for number, uav in enumerate(uavs):
        shelves.add_aircraft(uav)
        chosen = np.flatnonzero(rng.random(len(FIELDS)) < 0.4)
        laid = {}
        for field in chosen.tolist():
            n = int(rng.choice([1, 2, 3, 31, 32, 130, 300]))
            t = T0 + np.cumsum(rng.random(n) + 1e-3)
            x = rng.integers(-(2**31), 2**31, (n, 8)) if IS_INTEGER[field] else rng.normal(size=(n, 8)) * 1e3
            laid[field] = t, x.astype(float)
            keys += [number * len(FIELDS) + field] * n
            times += t.tolist()
            values += x.tolist()
        if laid:
            want[number] = encode(made(uav, laid))
    order = np.argsort(times, kind="stable")
    shelves.add_rows(
        np.array(keys, np.int64)[order], np.array(times)[order], np.array(times)[order], _wide(values)[order]
    )
    told = shelves.take_samples(np.inf)
    assert {number: payload for number, payload, _ in told} == want
    assert [t for *_, t in told] == [decode(Sample, payload).t for _, payload, _ in told]
    assert shelves.take_samples(np.inf) == []


def _wide(values: list) -> np.ndarray:
    return np.array(values, float).reshape(-1, 8)


def test_a_flood_of_one_kind_is_cut_and_counted():
    shelves = PendingRows()
    shelves.add_aircraft(3)
    t = T0 + np.arange(MAX_ROWS + 7) * 1e-3
    shelves.add_rows(np.zeros(len(t), np.int64), t, t, np.ones((len(t), 8)))
    ((number, told, _),) = shelves.take_samples(np.inf)
    assert (number, shelves.dropped.tolist(), told) == (
        0,
        [7],
        encode(made(3, {0: (t[:MAX_ROWS], _wide([[1.0] * 8] * MAX_ROWS))})),
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_rows_come_as_far_as_they_had_arrived_whatever_comes_between(seed):
    rng, shelves = np.random.default_rng(seed), PendingRows()
    heard: dict[tuple[int, int], list[float]] = {}
    given_out: dict[tuple[int, int], list[float]] = {}
    now = T0
    for step in range(60):
        if step % 7 == 0:
            shelves.add_aircraft(step)
        n = int(rng.integers(0, 40))
        key = rng.integers(0, len(shelves.uavs) * len(FIELDS), n)
        t = now + np.sort(rng.random(n))
        shelves.add_rows(key, t, t, np.zeros((n, 8)))
        for k, at in zip(key.tolist(), t.tolist(), strict=True):
            heard.setdefault(divmod(k, len(FIELDS)), []).append(at)
        until = now + float(rng.random())
        for number, told, _ in shelves.take_samples(until):
            sample = decode(Sample, told)
            assert sample.uav == shelves.uavs[number]
            for field, name in enumerate(FIELDS):
                rows = getattr(sample, name)
                if rows is not None:
                    assert rows.x.shape == (len(rows.t.numpy()), len(COLUMNS[name])) and rows.t.numpy().max() <= until
                    given_out.setdefault((number, field), []).extend(rows.t.numpy().tolist())
        now += 1.0
    shelves.take_samples(now - 1.0)  # what is left of the last steps but one
    for who, times in given_out.items():
        assert times == heard[who][: len(times)]
    assert sum(map(len, given_out.values())) > 600


def test_counts_go_with_time_and_wrap():
    counts = MessageCounters(["a", "b"])
    counts.add_aircraft()
    counts.add_aircraft()
    seq = np.array([254, 7, 255, 1, 8, 12])
    counts.add_messages(np.array([0, 1, 0, 0, 1, 1]), np.array([0, 0, 1, 1, 1, 1]), T0 + np.arange(6.0), seq)
    counts.count_until(T0 + 3)
    assert counts.state[:, [RECEIVED, MISSED, LAST_COUNTED]].tolist() == [[3, 1, T0 + 3], [1, 0, T0 + 1]]
    assert (counts.rates(0, np.inf), counts.rates(1, 2.0), counts.rates(1, 1.0)) == ({}, {"a": 0.5}, {"a": 0.3})
    counts.count_until(T0 + 9)
    assert counts.state[1, [RECEIVED, MISSED]].tolist() == [3, 3]
    counts.add_messages(np.array([0]), counts.kind_indices(["c"]), np.array([T0 + 10]), None)
    counts.count_until(T0 + 10)
    assert counts.rates(0, 2.0) == {"c": 0.5} and counts.state[0, MISSED] == 1


def test_a_tick_of_many_gives_each_what_it_gives_alone():
    rng = np.random.default_rng(8)
    said = {
        n: [Talker(n).heartbeat()] + [Talker(n).attitude(1 + 0.02 * k, rng.normal()) for k in range(60)]
        for n in range(1, 60)
    }
    together, news = MavlinkReceiver(), {n: [] for n in said}
    alone = {n: MavlinkReceiver() for n in said}
    want = {n: [] for n in said}
    for k in range(61):
        for n in said:
            for intake in (together, alone[n]):
                intake.receive(T0 + 0.02 * k, said[n][k], ("air", n))
        if k % 5 == 4:
            for message in together.flush(T0 + 0.02 * k):
                news[message.uav].append(message)
            for n, intake in alone.items():
                want[n] += intake.flush(T0 + 0.02 * k)
    assert news == want and sum(isinstance(m, Sample) for m in news[5]) == 12
