"""A twin on its way to another worker: it goes on exactly as it would have, and hostile bytes become no twin."""

import copy

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet.contract import Message, Model, Prediction, Sample
from tests.support import flights as f
from twin_worker.ownership.cold_start import continue_prediction, restore_model
from twin_worker.ownership.handover import REGISTRY, Snapshot, decode_snapshot, encode_snapshot
from twin_worker.ownership.typed_serialization import deserialise, serialise
from twin_worker.twin.state.state import Twin, ingest
from twin_worker.twin.step import advance


def later(heard: tuple[Message, ...], by: float = 20.0) -> list[Message]:
    """What comes next: the last seconds of the flight again, as if it went on so."""
    end = heard[-1].t
    found = [m for m in heard if isinstance(m, Sample) and m.t > end - by]
    return f.shifted([msgspec.structs.replace(m, t=m.t) for m in found], by, 1e9)


def said(twin: Twin, messages: list[Message]) -> list[Message]:
    return [result for m in messages for result in advance(twin, (m,))]


def test_who_takes_over_says_what_the_other_would_have_said(twin: Twin, heard: tuple[Message, ...]) -> None:
    data = encode_snapshot(Snapshot(twin, inbox=[heard[-1]]))
    carried = decode_snapshot(data, 1)
    assert encode_snapshot(carried) == data and carried.inbox == [heard[-1]]
    rest = later(heard)
    assert len(rest) > 100
    one, other = said(copy.deepcopy(twin), rest), said(carried.twin, rest)
    assert {type(m) for m in one} >= {Prediction, Model} and len(one) > 20
    assert [msgspec.msgpack.encode(m) for m in one] == [msgspec.msgpack.encode(m) for m in other]


def test_what_was_one_thing_stays_one(twin: Twin) -> None:
    assert any(twin.models.active_model is one.plant for one in twin.models.verified_models), (
        "the model in force is one of the pool"
    )
    carried = decode_snapshot(encode_snapshot(Snapshot(twin)), 1).twin
    assert any(carried.models.active_model is one.plant for one in carried.models.verified_models)


def test_a_multirotor_travels_too(hovered: Twin) -> None:
    assert encode_snapshot(decode_snapshot(encode_snapshot(Snapshot(hovered)), 7)) == encode_snapshot(Snapshot(hovered))


def test_a_twin_is_a_few_megabytes_at_most(twin: Twin) -> None:
    assert len(encode_snapshot(Snapshot(twin))) < 3_000_000


def test_another_aircraft_s_twin_is_refused(twin: Twin) -> None:
    with pytest.raises(ValueError, match=r"uav-2: found another object, expected its twin; it starts without"):
        decode_snapshot(encode_snapshot(Snapshot(twin)), 2)
    with pytest.raises(ValueError, match="found another object"):
        decode_snapshot(serialise([1, 2], REGISTRY), 1)


def test_telemetry_of_other_columns_is_refused(twin: Twin) -> None:
    narrow = copy.deepcopy(twin)
    narrow.telemetry.history.replace_rows("velocity", np.array([1e9]), np.zeros((1, 2)))
    with pytest.raises(ValueError, match="uav-1: found other telemetry columns, expected ours; it starts without"):
        decode_snapshot(encode_snapshot(Snapshot(narrow)), 1)


HOSTILE = (
    ["o", "os.system", "x", 1],
    ["o", "Twin"],
    ["o", "FlightEvent", "event", None, "t", 0.0, "message", "", "more", 1],
    ["s", "Twin", b"\x80"],
    ["o", "Timer", "last", 0.0, "more", 1],
    ["s", "Status", b"\x80"],
    ["e", "Twin", 1],
    ["e", "TwinState", "no such"],
    ["n", "TwinState", 1],
    ["x", "CubicSpline", ["t", ["a", "<f8", [2], bytes(16)], ["a", "<f8", [9, 9], bytes(648)]]],
    ["x", "RowBuffer", ["t", ["a", "<f8", [2], bytes(16)], ["a", "<f8", [1, 3], bytes(24)]]],
    ["x", "Twin", None],
    ["a", "|O8", [1], bytes(8)],
    ["a", "<f8", [1 << 60], b""],
    ["a", "<f8", [-1], b""],
    ["a", "<f8", [2], bytes(8)],
    ["r", 5],
    ["r", -9],
    ["d", ["l"], 1],
    ["q", -1],
    ["w", [4], 1],
    ["?"],
    [],
    {"a": 1},
)


@pytest.mark.parametrize("told", HOSTILE, ids=lambda told: repr(told)[:30])
def test_hostile_trees_are_refused(told: object) -> None:
    with pytest.raises(ValueError):
        deserialise(msgspec.msgpack.encode(told), REGISTRY)


def test_depth_is_limited() -> None:
    deep: object = 1
    for _ in range(60):
        deep = ["l", deep]
    with pytest.raises(ValueError, match="deep"):
        deserialise(msgspec.msgpack.encode(deep), REGISTRY)


@given(st.binary(max_size=200))
def test_random_bytes_are_refused_or_harmless(data: bytes) -> None:
    with pytest.raises(ValueError):
        decode_snapshot(data, 1)


def test_what_nobody_named_is_not_carried() -> None:
    with pytest.raises(TypeError, match=r"complex: is not serialisable; add it"):
        serialise([1j], REGISTRY)


# --- cold ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def cold(heard: tuple[Message, ...]) -> Twin:
    """A twin that has heard everything and learnt nothing."""
    twin = Twin.of(1)
    for message in heard:
        ingest(twin, message)
    return twin


def test_a_published_model_flies_at_once_and_about_as_well(twin: Twin, cold: Twin, heard: tuple) -> None:
    assert twin.identification.message is not None and restore_model(cold, twin.identification.message)
    assert (
        cold.models.active_verdict.fit == twin.models.active_verdict.fit
        and "taken over" in cold.models.active_verdict.sentence
    )
    made = next(m for m in said(cold, later(heard, 3.0)) if isinstance(m, Prediction))
    before = twin.prediction.latest
    assert made.method in f.ROUTE, made.sentence
    assert made.t - before.t < 3.0 and made.path.shape[1] == 3


def test_the_last_prediction_of_another_is_said_to_be_that_and_trusted_less(twin: Twin) -> None:
    fresh, last = Twin.of(1), twin.prediction.latest
    assert (
        continue_prediction(fresh, last)
        and fresh.prediction.last_rollout is not None
        and fresh.prediction.last_rollout.sentence.endswith("from another worker")
    )
    before, after = (
        last.prediction_region_half_axes.numpy(),
        fresh.prediction.last_rollout.prediction_region_half_axes.numpy(),
    )
    assert (after >= before).all() and (after[0] > before[0]).any()
    assert fresh.prediction.last_rollout.horizon_s == max(last.horizon_s - fresh.config.schedule.predict, 0.0)
    assert (fresh.prediction.last_rollout.path.numpy() == last.path.numpy()).all()
    assert not continue_prediction(fresh, msgspec.structs.replace(last, prediction_region_half_axes=last.ahead))


def test_a_model_that_cannot_be_is_not_believed(twin: Twin, cold: Twin) -> None:
    model, told = twin.identification.message, twin.identification.message.derivatives
    replace = msgspec.structs.replace
    for odd in (
        replace(model, derivatives=None),
        replace(model, active_verdict=None),
        replace(model, derivatives=replace(told, names=told.names[::-1])),
        replace(model, derivatives=replace(told, prior="airliner")),
        replace(model, derivatives=replace(told, U0=0.0)),
        replace(model, derivatives=replace(told, value=replace(told.value, shape=(5,)))),
        replace(model, derivatives=replace(told, covariance=told.value)),
    ):
        assert not restore_model(cold, odd) and cold.models.active_model is None
