"""Paths that may be flown instead of the predicted one where jumps of the mission were not counted from its start."""

import msgspec
import numpy as np
import pytest

from fleet.contract import Item
from tests.support.flights import ROUTE, predictions
from twin_worker.twin.step import advance


@pytest.mark.parametrize(("joined", "times"), [(True, 2.0), (False, 2.0), (True, 50.0)])
def test_a_jump_that_may_be_completed_leads_to_an_alternative(winged, joined, times):
    mission = winged.onboard.mission
    at = mission.seq + 1
    after = [msgspec.structs.replace(item, seq=item.seq + 1) for item in mission.items[at:]]
    jump = Item(seq=at, command=177, param1=float(at - 2), param2=times)
    winged.onboard.received_items = () if joined else mission.items
    changed = msgspec.structs.replace(mission, items=(*mission.items[:at], jump, *after))
    winged.onboard.set_mission(changed, winged.first_item)
    made = predictions(advance(winged, (), winged.telemetry.history.newest + 1.2))[-1]
    if not joined or times > 20 or made.method not in ROUTE:  # 1 of 51: as good as excluded
        assert made.alternatives == ()
        return
    (other,) = made.alternatives
    ahead = made.ahead.numpy()
    apart = np.linalg.norm(other.path.numpy() - made.path.numpy(), axis=1)
    assert other.probability == pytest.approx(1 / 3) and f"passes the jump of item {at}" in other.sentence
    assert apart[ahead < 2].max() < 5.0 and apart.max() > 50.0
