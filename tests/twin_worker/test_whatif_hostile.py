"""What if, asked by those who should not: one sentence each, and the next question is answered."""

import msgpack
import msgspec
import numpy as np
import pytest

from fleet.contract import MAX_ITEMS, Prediction, WhatIf
from tests.support import flights as f
from tests.support.odd_missions import ODD
from twin_worker.twin.state.state import Twin
from twin_worker.whatif import MAX_BYTES, answer_query

NAN, INF = float("nan"), float("inf")
PLACE = {"lat_e7": 470_000_000, "lon_e7": 80_000_000, "alt_mm": 500_000}
MANY = [{"seq": k, "command": 16} for k in range(MAX_ITEMS + 1)]
REFUSED = {
    "not msgpack": (b"\xc1", "no msgpack map"),
    "no map": (b"\x93\x01\x02\x03", "Expected `object`"),
    "too deep": (b"\x91" * 5000 + b"\xc0", "invalid payload"),
    "too long": (bytes(MAX_BYTES + 1), "bytes, expected at most"),
    "a slip of the pen": ({"sped": 18}, "unknown field `sped`"),
    "text for a number": ({"speed": "fast"}, r"Expected `float \| null`"),
    "too many items": ({"items": MANY}, "1,001 mission items, expected at most 1,000; shorten"),
    "items twice": ({"items": [{"seq": 1, "command": 16}] * 2}, "each of 0..999 once"),
    "items below nought": ({"items": [{"seq": -1, "command": 16}]}, "each of 0..999 once"),
    "an item of another mission": ({"items": MANY[:3], "seq": 7}, "one of the 3 items"),
    "an item that is not on board": ({"seq": 99}, "found seq 99 for uav-1"),
    "speed nan": ({"speed": NAN}, "speed: found nan"),
    "speed below nought": ({"speed": -3.0}, "speed: found -3"),
    "speed of light": ({"speed": 3e8}, "speed: found"),
    "wind nan": ({"wind": [NAN, 0.0]}, "wind: found"),
    "wind inf": ({"wind": [0.0, INF]}, "wind: found"),
    "wind in one dimension": ({"wind": [1.0]}, "Expected `array` of length 2"),
    "off this earth": ({"start": PLACE | {"lat_e7": 2**40}}, "start: found"),
    "out in space": ({"start": PLACE | {"alt_mm": 10**12}}, "start: found an altitude"),
    "heading nan": ({"start": PLACE | {"heading": NAN}}, "start: found heading"),
    "heading in degrees": ({"start": PLACE | {"heading": 270.0}}, "give radians"),
    "start speed inf": ({"start": PLACE | {"speed": INF}}, "start: found speed"),
    "a start without a place": ({"start": {}}, "missing required field `lat_e7`"),
    "parameter nan": ({"params": {"NAVL1_PERIOD": NAN}}, "NAVL1_PERIOD nan"),
    "parameter out of range": ({"params": {"NAVL1_PERIOD": 1e9}}, "expected 1..100"),
    "parameters without end": ({"params": {f"P{k}": 1.0 for k in range(2001)}}, "2,001"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_hostile_question_is_refused_in_one_sentence(holder, name):
    payload, words = REFUSED[name]
    payload = payload if isinstance(payload, bytes) else msgpack.packb(payload)
    with pytest.raises(ValueError, match=words) as refused:
        holder.bus.get_one(Prediction, 1, payload)
    said = str(refused.value)
    assert said.startswith("what if: ") and "expected" in said and "\n" not in said and len(said) < 300
    assert holder.bus.get(Prediction, 1) != []


def test_a_question_for_everybody_is_refused(holder):
    (reply,) = holder.bus._query_handlers[Prediction]
    with pytest.raises(ValueError, match="every aircraft, expected one"):
        reply(None, {}, msgspec.msgpack.encode(WhatIf()))


def test_a_twin_that_has_heard_nothing_says_so():
    with pytest.raises(ValueError, match="uav-4 has sent no position yet"):
        answer_query(Twin.of(4), WhatIf(speed=10.0))
    early = Twin.of(4)
    f.drive(early, f.messages(f.turn(0.5), uav=4))
    with pytest.raises(ValueError, match="too few recent positions"):
        answer_query(early, WhatIf(speed=10.0))


@pytest.mark.parametrize("name", ODD)
def test_an_odd_mission_is_flown_or_refused_in_a_sentence(winged, name):
    made = answer_query(winged, WhatIf(items=ODD[name][0]))
    assert np.isfinite(made.path.numpy()).all()
    assert made.method != "imm" or "mission" in made.sentence or "item" in made.sentence
