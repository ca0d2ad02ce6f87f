"""Claims, pure: who owns what, what is taken, asked for and given, which epochs, and when nothing may be written."""

import numpy as np
import pytest

from fleet.bus.bus_protocol import WRITER_TIMEOUT_S, EpochFence
from fleet.bus.codec import Stamp
from tests.bench.security import forged
from twin_worker.ownership.protocol_state import (
    CLAIM_DELAY_S,
    PAUSE_S,
    SILENT_S,
    FencingToken,
    OwnershipPlan,
    OwnershipState,
    owner,
    owners,
)

IDS = range(100)
WALL = 1_700_000_000_000


def workers(count: int, ids: range = IDS) -> dict[str, range]:
    return {f"{k:016x}": ids for k in range(count)}


def claims(me: str = "b", *, peers: tuple[str, ...] = (), known: range = range(0), now: float = 0.0) -> OwnershipState:
    """One worker that has asked everyone, in sight of the router, and knows of some aircraft."""
    one = OwnershipState(me, IDS)
    for name in peers:
        one.on_join(name, IDS, 1)
    one.known.update(known)
    one.tick(now, True)
    one.resynchronise(WALL)
    return one


def owned_by(name: str, others: dict[str, range]) -> list[int]:
    """Give what another worker owns, of what "b" may hold, too."""
    return [uav for uav, who in owners(IDS, {"b": IDS, **others}).items() if who == name]


# --- owner -----------------------------------------------------------------------------------------------------------


def test_everyone_names_the_same_owner_and_the_share_is_fair() -> None:
    found = owners(range(2000), workers(5, range(2000)))
    assert owners(reversed(range(2000)), dict(reversed(workers(5, range(2000)).items()))) == found
    counts = np.unique(list(found.values()), return_counts=True)[1]
    assert len(counts) == 5 and counts.min() > 340 and counts.max() < 460


def test_when_one_leaves_only_its_own_move() -> None:
    five = workers(5)
    before = owners(IDS, five)
    gone = sorted(five)[2]
    after = owners(IDS, {name: ids for name, ids in five.items() if name != gone})
    assert {uav for uav in IDS if before[uav] != after[uav]} == {uav for uav in IDS if before[uav] == gone}


def test_only_who_may_hold_an_id_owns_it() -> None:
    two = {"a": range(10), "b": range(5, 20)}
    found = owners(range(30), two)
    assert all(uav in two[name] for uav, name in found.items())
    assert sorted(found) == list(range(20)) and {found[uav] for uav in range(5, 10)} == {"a", "b"}
    assert owner(25, two) is None and owner(3, {}) is None and owner(15, two) == "b"
    assert owners([], two) == {}


# --- decide ----------------------------------------------------------------------------------------------------------


def test_alone_it_takes_everything_it_knows_of() -> None:
    one = claims(known=range(3))
    assert one.plan(0.0) == OwnershipPlan(acquire=[0, 1, 2])
    assert one.acquire(0, WALL) == WALL and one.owned == {0: WALL}
    assert one.plan(0.0) == OwnershipPlan(acquire=[1, 2])


def test_a_live_holder_is_asked_and_a_dead_one_is_not() -> None:
    one = claims(peers=("a",), known=IDS)
    one.on_claim("a", dict.fromkeys(range(50), WALL))
    plan, mine = one.plan(0.0), {uav for uav, who in owners(IDS, {"a": IDS, "b": IDS}).items() if who == "b"}
    assert set(plan.request) == {"a"} and set(plan.request["a"]) == mine & set(range(50))
    assert set(plan.acquire) == mine - set(range(50))
    one.on_leave("a", 1)
    assert one.plan(0.0) == OwnershipPlan(acquire=list(IDS))


def test_epochs_rise_above_all_seen_and_with_the_clock() -> None:
    one = claims(peers=("a",))
    one.on_claim("a", {7: WALL + 5000})
    assert one.acquire(7, WALL) == WALL + 5001, "a clock that is late"
    assert one.acquire(8, WALL) == WALL
    assert one.on_claim("a", {7: WALL + 5001}) == [] and one.owned[7] == WALL + 5001, "b comes after a"
    assert one.acquire(7, WALL) == WALL + 5002, "its own last epoch counts, too"


def test_the_higher_claim_wins_whoever_hears_first_and_a_tie_has_a_winner() -> None:
    one, other = claims("a", peers=("b",)), claims("b", peers=("a",))
    one.acquire(1, WALL)
    other.acquire(1, WALL)
    assert one.on_claim("b", other.owned) == [1] and not one.owned
    assert other.on_claim("a", {1: WALL}) == [] and other.owned == {1: WALL}
    other.acquire(2, WALL + 9)
    assert one.on_claim("b", other.owned) == [] and other.on_claim("a", {2: WALL + 10}) == [2]
    assert other.on_claim("a", {2: WALL + 10}) == [], "said again, nothing is lost again"


def test_a_claim_met_in_results_first_wins_all_the_same_once_it_is_announced() -> None:
    one = claims(peers=("a",))
    one.acquire(1, WALL)
    one.record(1, FencingToken(WALL + 5, "a"))
    assert one.owned == {1: WALL}
    assert one.on_claim("a", {1: WALL + 5}) == [1] and not one.owned


def test_who_took_what_is_held_here_and_died_before_it_said_so_is_outdone() -> None:
    one = claims(peers=("a",))
    one.acquire(1, WALL)
    one.record(1, FencingToken(WALL + 5, "a"))
    assert one.plan(0.0) == OwnershipPlan(), "it lives, and will say so"
    one.on_leave("a", 1)
    assert one.plan(0.0) == OwnershipPlan(acquire=[1]) and one.acquire(1, WALL) == WALL + 6
    assert one.plan(0.0) == OwnershipPlan()


def test_a_stale_claim_of_who_handed_over_takes_nothing_back() -> None:
    one = claims(peers=("a",))
    one.on_claim("a", {4: WALL})
    assert one.acquire(4, WALL) == WALL + 1
    assert one.on_claim("a", {4: WALL}) == [] and one.owned == {4: WALL + 1}


def test_after_a_pause_it_writes_nothing_until_it_has_asked() -> None:
    one = claims(known=range(2))
    one.acquire(0, WALL)
    assert one.may_write(PAUSE_S) and not one.may_write(PAUSE_S + 0.01), "though nobody has looked at the clock since"
    one.tick(3.0, True)
    assert not one.may_write(3.0) and one.plan(3.0) == OwnershipPlan()
    one.resynchronise(WALL)
    assert one.may_write(3.0) and one.plan(3.0) == OwnershipPlan(acquire=[1]) and one.owned == {0: WALL}


def test_who_was_overtaken_while_it_stood_still_claims_anew_or_yields() -> None:
    one = claims(peers=("a",))
    for uav in (0, 1, 2):
        one.acquire(uav, WALL)
    one.tick(5.0, True)
    assert one.on_claim("a", {0: WALL + 50}) == [0]
    one.record(1, FencingToken(WALL + 70, "c"))  # of a worker that is no more
    one.resynchronise(WALL + 9)
    assert one.owned == {1: WALL + 71, 2: WALL}


def test_without_a_router_it_claims_nothing_and_after_it_only_once_tokens_have_settled() -> None:
    one = claims(peers=("a",), known=IDS)
    one.acquire(0, WALL)
    one.tick(0.5, False)
    one.on_leave("a", 1)  # as all tokens do with the router
    assert one.plan(0.5) == OwnershipPlan() and not one.may_write(0.5) and one.owned == {0: WALL}
    one.tick(1.0, True)
    one.resynchronise(WALL)
    assert one.may_write(1.0) and one.plan(1.0) == OwnershipPlan()
    one.on_join("a", IDS, 1)
    one.tick(0.5 + CLAIM_DELAY_S, True)
    assert set(one.plan(0.5 + CLAIM_DELAY_S).acquire) < set(IDS), "only its own share: the other is back"


def test_the_end_of_an_earlier_life_says_nothing() -> None:
    one = claims()
    one.on_join("a", IDS, 2)
    one.on_leave("a", 1)
    one.on_join("a", range(3), 1)
    assert one.peers["a"].ids == IDS
    one.on_leave("a", 2)
    assert not one.peers


def test_who_is_leaving_owns_nothing_but_is_still_asked() -> None:
    one = claims(peers=("a",), known=IDS)
    one.on_claim("a", dict.fromkeys(IDS, WALL), leaving=True)
    assert one.plan(0.0) == OwnershipPlan(request={"a": list(IDS)})
    one.leaving = True
    assert one.plan(0.0) == OwnershipPlan()


def test_who_says_nothing_for_seconds_while_others_speak_passes_for_dead_until_it_speaks() -> None:
    one = claims(peers=("a",))
    one.on_claim("a", dict.fromkeys(range(4), WALL))
    one.tick(0.0, True)
    one.on_claim("a", {})
    for now in np.arange(0.1, SILENT_S + 1.0, 0.1):
        one.receiving = True
        one.tick(now, True)
        assert now > SILENT_S or not one.plan(now).acquire
    assert one.plan(now).acquire == list(range(4)) and not one.successors()
    one.on_claim("a", {})
    assert one.is_live("a") and not set(one.plan(now).acquire) & set(owned_by("a", one.successors()))


def test_who_is_late_but_has_its_token_is_not_replaced_until_the_token_goes() -> None:
    """A process at a tenth of a core announces every second or two; its session's keep-alives come all the same."""
    one = claims(peers=("a",), known=IDS)
    one.on_claim("a", dict.fromkeys(IDS, WALL))
    rng = np.random.default_rng(3)
    word = 0.0
    for now in np.arange(0.1, 60.0, 0.1):
        one.receiving = True  # others, and telemetry
        if now >= word:
            one.on_claim("a", dict.fromkeys(IDS, WALL))
            word = now + rng.uniform(0.5, 3.0)
        one.tick(now, True)
        assert not one.plan(now).acquire
    one.on_leave("a", 1)
    assert one.plan(now).acquire == list(IDS)


def test_where_nothing_at_all_is_heard_nobody_passes_for_dead() -> None:
    one = claims(peers=("a",), known=IDS)
    one.on_claim("a", dict.fromkeys(IDS, WALL))
    for turn in range(100):
        one.tick(0.1 * turn, True)
    one.receiving = True  # as much comes at once as was on the way for long
    one.tick(10.0, True)
    assert one.is_live("a") and not one.plan(10.0).acquire


def test_its_own_name_and_ids_beyond_its_range_are_nobody_s_news() -> None:
    one = claims(known=range(1))
    one.on_join("b", IDS, 9)
    one.record(500, FencingToken(1, "a"))
    one.record(1, FencingToken(1, "b"))
    assert not one.peers and not one.highest and one.known == {0}


# --- readers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("low", [Stamp(4, 9), Stamp(5, 1), None])
def test_readers_believe_the_higher_claim_until_it_falls_silent(low: Stamp | None) -> None:
    now = [0.0]
    fence = EpochFence(lambda: now[0])
    assert fence.accepts(1, low) and fence.accepts(1, Stamp(5, 2)) and not fence.accepts(1, low)
    assert fence.accepts(2, low), "another aircraft"
    now[0] = WRITER_TIMEOUT_S - 1.0
    assert fence.accepts(1, Stamp(5, 2)), "the same again, and as long as it speaks"
    now[0] = WRITER_TIMEOUT_S + 1.0
    assert not fence.accepts(1, low)
    now[0] = 2 * WRITER_TIMEOUT_S
    assert fence.accepts(1, low), "a fleet that was started anew with its clock set back"


# --- claims from the future -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("attempt", forged.BY_FORGING, ids=lambda one: one.__name__)
def test_a_forged_epoch_is_adopted_by_nobody_and_blinds_nobody(attempt) -> None:
    assert attempt()


def test_a_clock_that_was_set_back_claims_anew_what_it_holds() -> None:
    one = claims(peers=("a",))
    one.acquire(0, WALL)
    one.record(1, FencingToken(WALL, "a"))
    assert one.drop_future_epochs(WALL, WALL) == {} and one.owned == {0: WALL}
    assert one.drop_future_epochs(WALL - 2, WALL - 5) == {0: WALL - 5} == one.owned
    assert one.highest == {0: FencingToken(WALL - 5, one.worker_id)}, (
        "what the other claimed by the former clock is forgotten"
    )
