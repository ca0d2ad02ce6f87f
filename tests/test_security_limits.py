"""Strangers cannot fill, lock out or upset gateway and page; whoever uses the same thing rightfully is served."""

from collections.abc import Callable

import pytest

from tests.bench.security.limits import BY_LIMIT, hostile_session

AT_ONCE = [attempt for attempt in BY_LIMIT if attempt is not hostile_session]  # that one takes minutes: in the bench


@pytest.mark.parametrize("attempt", AT_ONCE, ids=lambda attempt: attempt.__name__)
def test_it_is_refused_beside_a_rightful_use(attempt: Callable[[], str]) -> None:
    assert attempt()
