"""A twin on its way to another worker: it goes on exactly as it would have, and hostile bytes become no twin."""

import copy
import subprocess
import sys

import msgspec
import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st

from fleet.contract import Message, Model, Prediction, Sample
from tests.support import flights as f
from twin_worker.ownership.cold_start import continue_prediction, restore_model
from twin_worker.ownership.handover import Snapshot, decode_snapshot, encode_snapshot
from twin_worker.twin.state.state import Twin, ingest
from twin_worker.twin.step import advance

DECODE_AT_ONCE = """
import sys, threading
from fleet.airframes import GENERIC, load
from twin_worker.ownership.handover import Snapshot, decode_snapshot, encode_snapshot
from twin_worker.twin.state.budget import Schedule
from twin_worker.twin.state.state import AUTO, Twin, TwinConfig
sys.setswitchinterval(1e-6)
data = encode_snapshot(Snapshot(Twin(TwinConfig(3, 0.0, AUTO, load(GENERIC), Schedule()))))
barrier, uavs = threading.Barrier(8), []
def decode():
    barrier.wait()
    uavs.append(decode_snapshot(data, 3).twin.config.uav)
threads = [threading.Thread(target=decode) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()
print(uavs)
"""


def test_the_first_snapshots_may_come_from_several_workers_at_once() -> None:
    done = subprocess.run([sys.executable, "-c", DECODE_AT_ONCE], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, str([3] * 8)), done.stderr


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


def test_a_multirotor_travels_too(hovered: Twin) -> None:
    assert encode_snapshot(decode_snapshot(encode_snapshot(Snapshot(hovered)), 7)) == encode_snapshot(Snapshot(hovered))


def test_a_twin_is_a_few_megabytes_at_most(twin: Twin) -> None:
    assert len(encode_snapshot(Snapshot(twin))) < 3_000_000


def test_another_aircraft_s_twin_is_refused(twin: Twin) -> None:
    with pytest.raises(ValueError, match=r"uav-2: found the twin of uav-1, expected its own; it starts without"):
        decode_snapshot(encode_snapshot(Snapshot(twin)), 2)
    with pytest.raises(ValueError, match=r"uav-1: found 3 invalid bytes .*, expected its twin"):
        decode_snapshot(msgspec.msgpack.encode([1, 2]), 1)


def test_telemetry_of_other_columns_is_refused(twin: Twin) -> None:
    narrow = copy.deepcopy(twin)
    narrow.telemetry.history.replace_rows("velocity", np.array([1e9]), np.zeros((1, 2)))
    with pytest.raises(ValueError, match=r"uav-1: found other telemetry columns, expected ours; it starts without"):
        decode_snapshot(encode_snapshot(Snapshot(narrow)), 1)


def encoded_array(dtype: str, shape: list[int], data: object) -> list[object]:
    return [dtype, shape, data]


HISTORY, LAGGED = ("telemetry", "history", "_buffers"), ("confidence", "tracker", "_lagged", "_members")
TIMES, VALUES = encoded_array("<f8", [2], bytes(16)), encoded_array("<f8", [2, 6], bytes(96))
HOSTILE = {
    "a text for a number": (("config", "uav"), "1"),
    "a number for a part": (("models",), 1),
    "an unknown state": (("prediction", "state"), "no such"),
    "a class for a part": (("prediction", "controller"), ["os.system", "x"]),
    "a verdict without fields": (("identification", "verdict"), {}),
    "a message of another type": (("onboard", "status"), {"x": 1}),
    "objects": (("environment", "wind", "_x"), encoded_array("|O", [1], bytes(8))),
    "structured numbers": (("environment", "wind", "_x"), encoded_array("i8,O", [1], bytes(16))),
    "no type": (("environment", "wind", "_x"), encoded_array("nothing", [1], bytes(8))),
    "a huge array": (("environment", "wind", "_x"), encoded_array("<f8", [1 << 60], b"")),
    "a negative array": (("environment", "wind", "_x"), encoded_array("<f8", [-1], bytes(64))),
    "too few bytes": (("environment", "wind", "_x"), encoded_array("<f8", [2], bytes(8))),
    "numbers for text": (("confidence", "tracker", "_log", "group"), encoded_array("|O", [1], [1])),
    "a negative length": (("onboard", "mode_changes"), [-1, []]),
    "a mode change without time": (("onboard", "mode_changes"), [4, [["AUTO"]]]),
    "rows of two lengths": (HISTORY, {"imu": [encoded_array("<f8", [1], bytes(8)), VALUES]}),
    "rows of whole numbers": (HISTORY, {"imu": [encoded_array("<i8", [2], bytes(16)), VALUES]}),
    "rows of other columns": (HISTORY, {"velocity": [TIMES, VALUES]}),
    "rows of an unknown kind": (HISTORY, {"nothing": [TIMES, VALUES]}),
    "a spline of another shape": (LAGGED, [6, [[0.0, 1.0, [TIMES, encoded_array("<f8", [9, 9], bytes(648))]]]]),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_snapshots_are_refused(name: str) -> None:
    tree = msgspec.msgpack.decode(encode_snapshot(Snapshot(Twin.of(1))), strict=False)
    assert encode_snapshot(decode_snapshot(msgspec.msgpack.encode(tree), 1)), "the tree itself is accepted"
    path, value = HOSTILE[name]
    parent = tree[0]
    for key in path[:-1]:
        parent = parent[key]
    assert path[-1] in parent
    parent[path[-1]] = value
    with pytest.raises(ValueError, match=r"uav-1: found .*, expected .*; it starts without a snapshot"):
        decode_snapshot(msgspec.msgpack.encode(tree), 1)


def test_an_unknown_message_in_the_inbox_is_refused() -> None:
    tree = msgspec.msgpack.decode(encode_snapshot(Snapshot(Twin.of(1))))
    for inbox in ([["nothing", {}]], [["status", {}]], [["status"]], [[]]):
        tree[1] = inbox
        with pytest.raises(ValueError, match="it starts without a snapshot"):
            decode_snapshot(msgspec.msgpack.encode(tree), 1)


def test_depth_is_limited() -> None:
    with pytest.raises(ValueError, match="it starts without a snapshot"):
        decode_snapshot(b"\x91" * 100_000 + b"\x01", 1)


@given(st.binary(max_size=200))
def test_random_bytes_are_refused_or_harmless(data: bytes) -> None:
    with pytest.raises(ValueError):
        decode_snapshot(data, 1)


def test_an_undeclared_type_is_not_encoded() -> None:
    twin = Twin.of(1)
    twin.config = msgspec.structs.replace(twin.config, omega=1j)
    with pytest.raises(TypeError, match=r"complex: no hook encodes it; add one"):
        encode_snapshot(Snapshot(twin))


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


def test_a_first_mission_ends_no_prediction_that_another_worker_made_with_it(twin: Twin) -> None:
    last, mission, params = twin.prediction.latest, twin.onboard.mission, twin.onboard.params
    assert last is not None and mission is not None and params is not None and len(mission.items) > 3
    fresh = Twin.of(1)
    assert continue_prediction(fresh, last)
    for message in (params, mission):
        ingest(fresh, message)
        assert fresh.prediction.last_rollout is not None and fresh.prediction.predict_timer.due(last.t, 60.0)
    ingest(fresh, msgspec.structs.replace(mission, items=mission.items[:-1]))  # another mission
    assert fresh.prediction.last_rollout is None
    for message in (params, mission):
        own = Twin.of(1)  # one that flew ahead by itself, without them
        own.prediction.set_rollout(last)
        ingest(own, message)
        assert own.prediction.last_rollout is None


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
