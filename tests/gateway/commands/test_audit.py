"""The audit of all commands, and what an approval is a digest of."""

import stat
from pathlib import Path

import msgspec
import pytest

from fleet.bus.codec import digest_of
from gateway.commands.audit import AuditLog
from tests.support.commanded import CommandedAircraft, CommandSite


@pytest.fixture
def site(tmp_path: Path) -> CommandSite:
    return CommandSite(tmp_path, CommandedAircraft())


def test_the_audit_is_private_appended_and_survives_a_torn_line(tmp_path: Path) -> None:
    path = tmp_path / "new" / "commands.jsonl"
    log = AuditLog(path)
    log.write(1.0, [{"event": "approved", "proposal": "a", "x": float("nan")}])
    log.close()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600 and stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    with path.open("a") as file:
        file.write('{"event": "appro')
    again = AuditLog(path)
    again.write(2.0, [{"event": "undo_approved", "proposal": "a"}])
    again.close()
    again = AuditLog(path)
    assert again.executed == {("a", False), ("a", True)}
    assert path.read_text().splitlines()[0].endswith('"x":null}')
    again.close()
    path.chmod(0o666)
    with pytest.raises(ValueError, match="0666"):
        AuditLog(path)
    link = tmp_path / "link.jsonl"
    link.symlink_to(path)
    with pytest.raises(OSError, match="symbolic"):
        AuditLog(link)


def test_a_digest_is_of_the_changes_alone(site: CommandSite) -> None:
    option = site.option(speed=17.0)
    assert digest_of(option) == digest_of(msgspec.structs.replace(option, probability=0.5, paths=()))
    assert digest_of(option) != digest_of(site.option(speed=17.5))
