"""Nobody comes in who does not belong, nobody says what is another's to say, nothing from the wire hurts its reader."""

import shutil
import tracemalloc
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT, unused_port

from fleet.access.entry import BusConfig
from fleet.access.roles import LIVE, TOPIC_RULES
from fleet.access.roles import ROOT as WIRE
from fleet.bus.codec import decode, encode, encoding
from fleet.bus.session import connect
from fleet.commands.live.router import format_settings
from fleet.contract import TOPICS
from tests.bench.security.attack import attack
from tests.bench.security.bombs import bombs
from tests.bench.security.door import BY_CERTIFICATE, BY_PASSWORD, _kept_out
from tests.bench.security.role import BY_ROLE
from tests.bench.security.site import OURS, REAL, Site, make_papers, make_passwords, routed, zenohd
from tests.bench.security.size import BY_SIZE
from tests.bench.security.trying import FORGED, RIGHT, Admitted, Attempt, fresh, only_heard, until
from tests.bench.security.victims import VICTIMS, Victim
from tests.support.examples import EXAMPLES

LIGHT = 1 << 20  # bytes of the largest bomb; the bench has larger ones


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site's certificates."""
    return make_papers(tmp_path_factory.mktemp("site") / "certificates", "127.0.0.1", "::1", "localhost")


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another site's."""
    return make_papers(tmp_path_factory.mktemp("foreign") / "certificates", "127.0.0.1")


@pytest.fixture(scope="module", params=[REAL, OURS])
def kind(request: pytest.FixtureRequest) -> str:
    """Which router."""
    if request.param == REAL and zenohd() is None:
        pytest.skip("no zenohd (PARAUAV_ZENOHD, the path, ~/.cargo/bin): `cargo install zenohd --version 1.10.2`")
    return request.param


@pytest.fixture(scope="module")
def guarded(kind: str, papers: Path) -> Iterator[Site]:
    """A router that knows roles by their certificates."""
    with routed(kind, Site(f"tls/127.0.0.1:{unused_port()}", papers)) as site:
        yield site


@pytest.fixture(scope="module")
def worded(kind: str, papers: Path) -> Iterator[Site]:
    """A router that knows roles by their passwords."""
    with routed(kind, Site(f"tcp/127.0.0.1:{unused_port()}", papers, make_passwords(papers))) as site:
        yield site


@pytest.fixture(scope="module")
def open_site(papers: Path) -> Iterator[Site]:
    """A router on loopback that asks for nothing."""
    with routed(OURS, Site(f"tcp/127.0.0.1:{unused_port()}", papers)) as site:
        yield site


def outcomes(attempts: tuple[Attempt, ...], site: Site) -> dict[str, str]:
    """Make all attempts at once: most of their time is waiting."""

    def one(attempt: Attempt) -> tuple[str, str]:
        try:
            return attempt.__name__, f"refused: {attempt(site)}"
        except Admitted as error:
            return attempt.__name__, f"went in: {error}"

    with ThreadPoolExecutor(len(attempts)) as pool:
        return dict(pool.map(one, attempts))


# --- the table -------------------------------------------------------------------------------------------------------


def test_without_the_right_certificate_nobody_comes_in(guarded: Site) -> None:
    found = outcomes(BY_CERTIFICATE, guarded)
    assert all(words.startswith("refused") for words in found.values()), found


def test_a_role_can_do_no_other_roles_work(guarded: Site) -> None:
    found = outcomes((*BY_ROLE, *BY_SIZE), guarded)
    assert all(words.startswith("refused") for words in found.values()), found


def test_passwords_do_the_same(worded: Site) -> None:
    found = outcomes((*BY_PASSWORD, *BY_ROLE), worded)
    assert all(words.startswith("refused") for words in found.values()), found


def test_size_is_limited_where_nothing_else_is(open_site: Site) -> None:
    found = outcomes(BY_SIZE, open_site)
    assert all(words.startswith("refused") for words in found.values()), found


def test_the_attempts_are_real_for_they_succeed_where_nothing_is_guarded(open_site: Site) -> None:
    found = outcomes(tuple(one for one in BY_ROLE if one.__name__ != "router_reconfigured"), open_site)
    assert all(words.startswith("went in") and "nothing was tried" not in words for words in found.values()), found
    with pytest.raises(Admitted, match="joined"):
        _kept_out(open_site, "viewer", {})


def test_two_routers_are_one_bus_that_keeps_the_same_rules(guarded: Site, papers: Path) -> None:
    with routed(OURS, Site(f"tls/127.0.0.1:{unused_port()}", papers), [guarded.at]) as other:
        name = fresh("prediction")
        with other.session("worker") as worker, other.session("tools") as forger, guarded.session("viewer") as reader:
            live = f"{WIRE}/{LIVE}/worker/{name.split('/')[1]}/0-9/1"
            token = worker.liveliness().declare_token(live)
            assert only_heard(reader, name, lambda: worker.put(name, RIGHT), lambda: forger.put(name, FORGED))
            assert until(lambda: any(one.ok for one in reader.liveliness().get(live)))
            token.undeclare()


# --- bombs -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", EXAMPLES, ids=lambda kind: kind.__name__)
def test_a_bomb_is_a_message_or_a_sentence_and_takes_little(kind: type) -> None:
    assert decode(kind, encode(EXAMPLES[kind]), encoding(kind)) == EXAMPLES[kind]
    refused = 0
    tracemalloc.start()
    try:
        for what, payload in bombs(EXAMPLES[kind], LIGHT):
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            try:
                decode(kind, payload, encoding(kind))
            except ValueError as error:
                refused += 1
                assert "found" in str(error) and len(str(error)) < 1_000, what
            grown = tracemalloc.get_traced_memory()[1] - before
            assert grown < 60 * max(len(payload), 4096), (what, len(payload), grown)
    finally:
        tracemalloc.stop()
    assert refused > 15


@pytest.mark.parametrize("victim", VICTIMS, ids=lambda victim: victim.__name__)
def test_whoever_reads_the_bus_survives(victim: Victim, open_site: Site, caplog: Any, capfd: Any) -> None:
    assert victim(open_site.at, partial(attack, most=LIGHT))
    assert not [record for record in caplog.records if record.exc_info], "a defect was met"
    assert "Traceback" not in capfd.readouterr().err


# --- what is said where somebody is refused --------------------------------------------------------------------------


def test_the_knock_says_who_refused_whom_and_what_to_do(guarded: Site, foreign: Path, tmp_path: Path) -> None:
    with pytest.raises(ConnectionError, match=r"certificate not valid .* copy the site's ca\.pem here"):
        connect(BusConfig(guarded.at, "viewer", foreign))
    mixed = Path(shutil.copytree(foreign, tmp_path / "mixed"))
    shutil.copy(guarded.folder / "ca.pem", mixed)
    with pytest.raises(ConnectionError, match=r"certificate of viewer rejected \(.*\), expected one signed"):
        connect(BusConfig(guarded.at, "viewer", mixed))
    shutil.copy(guarded.folder / "viewer.key", mixed)
    with pytest.raises(ValueError, match=r"do not match .* create them again: certificates\.sh role"):
        connect(BusConfig(guarded.at, "viewer", mixed))
    with connect(guarded.entry("viewer")) as bus:
        assert bus.router


# --- the table and the contract --------------------------------------------------------------------------------------


def test_every_topic_has_a_writer_and_a_size() -> None:
    assert set(TOPICS) <= set(TOPIC_RULES)
    for kind, example in EXAMPLES.items():
        assert len(encode(example)) * 10 < TOPIC_RULES[kind.topic].max_bytes


@pytest.mark.parametrize(
    ("file", "listen", "site"),
    [("zenohd.json5", None, False), ("zenohd-site.json5", ["tls/0.0.0.0:7447"], True)],
    ids=["loopback", "site"],
)
def test_the_files_of_deploy_are_what_the_table_makes(file: str, listen: Any, site: bool, papers: Path) -> None:
    entry = BusConfig("tls/127.0.0.1:7447", "tools", papers) if site else BusConfig()
    made = format_settings(entry.router_settings(listen)).replace(str(papers), "/etc/parauav/certificates")
    assert (ROOT / "deploy" / file).read_text() == made + "\n", f"make it again: fleet router > deploy/{file}"
