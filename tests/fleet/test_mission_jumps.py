"""Jumps counted from the items that an aircraft reports."""

from itertools import pairwise

import pytest

from fleet.contract import Item
from fleet.mission_jumps import count_jumps, resets_counters

# as flown by h02 of the recordings: waypoints 4 to 12, twice, then 16
LOOP = {seq: Item(seq=seq, command=16) for seq in range(17)}
LOOP |= {3: Item(seq=3, command=178), 13: Item(seq=13, command=178), 15: Item(seq=15, command=189)}
LOOP[14] = Item(seq=14, command=177, param1=4, param2=1)


def counted(reports, taken=None, items=LOOP, resets=True):
    taken = taken or {}
    for step in pairwise(reports):
        taken = count_jumps(items, taken, step, first=1, resets=resets)
    return taken


def test_a_loop_is_counted_and_its_counter_starts_again_after_it():
    lap = list(range(4, 13))
    assert counted([1, 2, *lap]) == {}
    assert counted([1, 2, *lap, *lap]) == {14: 1}
    assert counted([1, 2, *lap, *lap, 16]) == {14: 0}
    assert counted([1, 2, *lap, *lap, 16], resets=False) == {14: 1}


def test_who_joined_late_learns_from_what_the_aircraft_does():
    assert counted([11, 12, 16], resets=False) == {14: 1}  # the jump was taken before
    assert counted([11, 12, 4, 5]) == {14: 1}


def test_an_item_may_pass_between_two_reports():
    assert counted([12, 5]) == {14: 1}
    assert counted([11, 4]) == {14: 1}


def test_a_selected_item_is_no_jump_and_a_restart_clears():
    assert counted([12, 7], {14: 1}) == {14: 1}
    assert counted([6, 9], {14: 1}) == {14: 1}
    assert counted([9, 1], {14: 1}) == {}


@pytest.mark.parametrize("count", [-1.0, float("nan"), 1e30])
def test_endless_and_invalid_counts_are_harmless(count):
    items = LOOP | {14: Item(seq=14, command=177, param1=4, param2=count)}
    assert set(counted([12, 4, 5, 12, 16], items=items)) <= {14}
    to_itself = LOOP | {14: Item(seq=14, command=177, param1=14, param2=count)}
    assert set(counted([12, 16], items=to_itself)) <= {14}


def test_only_ardupilot_sets_counters_back_and_only_without_the_option():
    assert resets_counters({}, 1) and resets_counters({"MIS_OPTIONS": 1.0}, 1)
    assert not resets_counters({"MIS_OPTIONS": 8.0}, 1) and not resets_counters({}, 0)
    assert resets_counters({"MIS_OPTIONS": float("nan")}, 1)
