"""Siblings between workers: models of any worker contribute, one worker estimates, a twin of that type uses it."""

import numpy as np
import pytest
from msgspec.structs import replace

from fleet.bus.codec import Stamp
from fleet.commands.live.status import sibling_texts
from fleet.contract import Array, Model, Params, SiblingData, Siblings, Status
from tests.support.examples import EXAMPLES
from tests.support.memory_bus import MemoryBus
from twin_worker.service.sibling_sharing import SiblingSharing
from twin_worker.service.worker import Worker
from twin_worker.twin.steps.identify_step import airframe_type

TYPE = "fixed_wing, generic small fixed wing, 2100, mass unknown"
K = 30


def model(uav: int, kind: str = TYPE) -> Model:
    """A model of one aircraft whose data say something of each term."""
    rng = np.random.default_rng(uav)
    data = SiblingData(
        airframe_type=kind,
        airspeed=22.0,
        throttle=0.5,
        information=Array.of(np.eye(K), "<f8"),
        score=Array.of(0.1 * rng.standard_normal(K), "<f8"),
    )
    example = EXAMPLES[Model]
    assert example.derivatives is not None and example.active_verdict is not None
    return replace(example, uav=uav, derivatives=replace(example.derivatives, prior=AIRFRAME, data=data))


AIRFRAME = "generic small fixed wing"


@pytest.fixture
def shared() -> tuple[MemoryBus, SiblingSharing, Worker]:
    bus = MemoryBus()
    one = Worker(bus, range(100), omega=2.0)  # type: ignore[arg-type]
    one.sibling_sharing.connect()
    one.ownership.state.tick(0.0, True)
    return bus, one.sibling_sharing, one


def test_aircraft_of_one_type_are_estimated_together(shared) -> None:
    bus, sharing, _ = shared
    assert sharing._airframe.name == AIRFRAME
    for uav in range(4):
        bus.publish(model(uav))
    bus.publish(model(8, "another"))
    sharing.step()
    assert sharing.latest is not None
    (one,) = sharing.latest.types
    assert (one.airframe_type, one.uavs) == (TYPE, (0, 1, 2, 3))
    assert sibling_texts(bus)[0] == f"{TYPE}: 4 aircraft share what they have learnt"


def test_a_twin_of_that_type_gets_it_and_no_other(shared) -> None:
    bus, sharing, worker = shared
    for uav in range(4):
        bus.publish(model(uav))
    sharing.step()
    owned = type("Owned", (), {"twin": worker._create_twin(9)})()
    sharing.apply(owned)
    assert owned.twin.identification.siblings is None  # its type is not known
    owned.twin.onboard.status = Status(uav=9, t=1.0, autopilot="px4", vehicle="fixed_wing")
    for autostart, is_sibling in ((2100.0, True), (2200.0, False), (0.0, False)):
        owned.twin.onboard.params = Params(uav=9, t=1.0, values={"SYS_AUTOSTART": autostart})
        sharing.apply(owned)
        assert (owned.twin.identification.siblings is not None) is is_sibling


def test_another_mass_class_is_another_type(shared) -> None:
    twin = shared[2]._create_twin(9)
    twin.onboard.status = Status(uav=9, t=1.0, autopilot="px4", vehicle="fixed_wing")
    names = []
    for mass in (2.0, 2.1, 4.0):
        twin.onboard.params = Params(uav=9, t=1.0, values={"SYS_AUTOSTART": 2100.0, "WEIGHT_GROSS": mass})
        names.append(airframe_type(twin))
    assert names[0] == names[1] != names[2] and names[0].endswith("2.0 kg")


def test_bad_contributions_and_distributions_are_counted_and_change_nothing(shared) -> None:
    bus, sharing, _ = shared
    for uav in range(3):
        bus.publish(model(uav))
    sharing.step()
    before, bad = sharing.latest, model(5)
    assert bad.derivatives is not None and bad.derivatives.data is not None
    hostile = replace(bad.derivatives.data, information=Array.of(-np.eye(K), "<f8"))
    bus.publish(replace(bad, derivatives=replace(bad.derivatives, data=hostile)))
    (one,) = EXAMPLES[Siblings].types
    wrong = replace(one, covariance=Array.of(np.zeros((K, K)), "<f8"))
    bus.publish(replace(EXAMPLES[Siblings], types=(wrong,)), Stamp(sharing._stamp.epoch + 1, 0xF))
    assert sharing.rejected == 2 and sharing.latest is before
