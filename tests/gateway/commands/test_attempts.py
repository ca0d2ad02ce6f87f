"""The attempts of the security bench, fewer of each kind."""

import pytest

from tests.bench.security import commands


@pytest.mark.parametrize("attempt", commands.BY_COMMAND, ids=lambda attempt: attempt.__name__)
def test_nothing_is_executed_that_nobody_approved(attempt, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "ROUNDS", 8)
    monkeypatch.setattr(commands, "UPLOADS", 5)
    monkeypatch.setattr(commands, "EXECUTIONS", 4)
    assert attempt()
