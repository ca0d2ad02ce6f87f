"""A multirotor or a model-less wing with everything nobody should send: it says so, and nothing breaks."""

import copy

import msgspec
import numpy as np
import pytest

from fleet.contract import Mission, Params, Sample, Status
from tests.support import hover
from tests.support.flights import item, predictions, published, rows
from twin_worker.evaluation.replay import run_offline
from twin_worker.twin.step import Twin, advance

NAN, INF = float("nan"), float("inf")
ABSURD = (NAN, INF, -1e300, 1e300, 0.0, -1.0)


@pytest.fixture(scope="module")
def airborne() -> dict[int, Twin]:
    twins: dict[int, Twin] = {}
    list(run_offline(hover.fly(2).messages[:250], twins))
    return twins


@pytest.fixture(params=["multirotor", "helicopter", "quadplane", "fixed_wing"])
def craft(airborne, request) -> Twin:
    twin = copy.deepcopy(airborne[7])
    twin.onboard.status = msgspec.structs.replace(twin.onboard.status, vehicle=request.param)
    return twin


def asked(twin: Twin, *told) -> list:
    """What it says of a message, at once and after two hops."""
    now = twin.telemetry.data_t
    results = list(advance(twin, told))
    twin.onboard.plan_changed_t = -np.inf  # as if it had been so for long
    return published(results + advance(twin, (), now + 1.1) + advance(twin, (), now + 2.9))


@pytest.mark.parametrize("value", ABSURD)
def test_absurd_parameters(craft, value):
    names = [
        *craft.onboard.params.values,
        "Q_WP_SPEED",
        "AIRSPEED_CRUISE",
        "NAVL1_PERIOD",
        "WP_RADIUS",
        "Q_TRANS_DECEL",
    ]
    names += ["SERVO5_FUNCTION", "Q_M_PWM_MIN", "CIRCLE_RATE", "RTL_ALT_M", "RTL_ALT_FINAL"]
    assert predictions(asked(craft, Params(uav=7, t=craft.telemetry.data_t, values=dict.fromkeys(names, value))))


@pytest.mark.parametrize("autopilot", ["ardupilot", "px4"])
@pytest.mark.parametrize(
    "items",
    [
        (),
        (item(0),),
        (item(1, 16, 50.0),),
        (item(0), item(1, 177, param1=1.0, param2=-1.0)),
        (item(0), item(1, 20), item(2, 20), item(3, 21)),
        (item(0), item(1, 16, param1=NAN, alt_m=NAN), item(2, 18, 5.0, param1=INF, param3=NAN)),
        (item(0), item(1, 18, 50.0, param1=1e30, param3=1e30), item(2, 19, param1=NAN)),
        (item(-4), item(900, 16, 50.0), item(1, 84), item(2, 85)),
        (item(0), item(1, 16, 9e5), item(2, 16, -9e5), item(3, 178, param2=1e-9), item(4, 16, 10.0)),
    ],
)
def test_hostile_missions(craft, items, autopilot):
    status = msgspec.structs.replace(craft.onboard.status, t=craft.telemetry.data_t, autopilot=autopilot)
    made = predictions(asked(craft, status, Mission(uav=7, t=craft.telemetry.data_t, items=items, seq=1)))
    assert made and all(p.sentence for p in made)


@pytest.mark.parametrize("seq", [0.0, -7.0, 65535.0, 1e4, NAN, INF])
def test_items_in_force_that_are_none(craft, seq):
    craft.telemetry.history.replace_rows("leg", np.empty(0), np.empty((0, 1)))
    leg = rows([craft.telemetry.data_t - 1.0], [[seq]])
    assert not craft.telemetry.history.add(Sample(uav=7, t=craft.telemetry.data_t, leg=leg))
    assert predictions(asked(craft))


@pytest.mark.parametrize("mode", ["", "\0", "RTL", "LOITER", "GUIDED", "QLOITER", "QRTL", "AUTO"])
def test_any_mode_armed_or_not(craft, mode):
    for armed in (True, False):
        status = Status(uav=7, t=craft.telemetry.data_t, mode=mode, armed=armed, vehicle=craft.vehicle)
        assert predictions(asked(craft, status))
