"""The way onto the bus: `--router` and `--config`, papers and passwords, a site's certificates and their renewal."""

import argparse
import importlib
import shutil
import ssl
import subprocess
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh
from conftest import ROOT, unused_port

from fleet import cli
from fleet.access.entry import PASSWORD, ROUTER, BusConfig, access_control
from fleet.access.knock import probe_router
from fleet.access.papers import expiry_of, find_certificate, read_password
from fleet.access.roles import ROLES, ROUTER_ROLE
from fleet.bus.session import _config, connect, open_router
from fleet.config import bus_config_from, router_arguments, router_options
from gateway import __main__ as gateway
from tests.bench.security.site import SCRIPT, expired, make_papers, make_passwords
from tests.support.fake_link import until
from twin_worker import __main__ as twin_worker
from viewer import __main__ as viewer

OFF_THE_BUS = {"assess", "calibrate", "completion", "diagnose", "effects", "fly", "inspect", "paper", "prove", "schema"}


@pytest.fixture(scope="module")
def papers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A site's certificates."""
    return make_papers(tmp_path_factory.mktemp("site") / "certificates", "127.0.0.1", "router.example")


def told(*options: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    router_arguments(parser)
    return parser.parse_args(options)


def written(folder: Path, text: str) -> str:
    (folder / "fleet.toml").write_text(text)
    return f"--config={folder / 'fleet.toml'}"


# --- what is told ----------------------------------------------------------------------------------------------------


def test_without_options_it_is_loopback_in_the_clear() -> None:
    assert bus_config_from(told()) == BusConfig(ROUTER, "tools", None, None)
    assert router_options(told()) == []


def test_the_example_of_deploy_says_what_it_explains(papers: Path) -> None:
    given = told(f"--config={ROOT / 'deploy' / 'fleet.toml'}")
    assert bus_config_from(given, "worker") == BusConfig(
        "tls/127.0.0.1:7447", "worker", ROOT / "deploy" / "certificates"
    )
    assert router_options(given) == [f"--config={ROOT / 'deploy' / 'fleet.toml'}"]


def test_the_command_line_wins_over_the_file(tmp_path: Path) -> None:
    file = written(tmp_path, '[router]\nat = "tcp/10.0.0.1:7447"\npasswords = "words"\n')
    assert bus_config_from(told(file)) == BusConfig("tcp/10.0.0.1:7447", "tools", None, tmp_path / "words")
    both = told(file, "--router=tcp/10.0.0.2:7447")
    assert bus_config_from(both).endpoint == "tcp/10.0.0.2:7447"
    assert router_options(both) == ["--router=tcp/10.0.0.2:7447", file]


def test_paths_hold_wherever_what_is_written_with_them_is_read(
    papers: Path, tmp_path: Path, monkeypatch, capsys
) -> None:
    shutil.copytree(papers, tmp_path / "certificates")
    written(tmp_path, '[router]\nat = "tls/127.0.0.1:7447"\ncertificates = "certificates"\n')
    monkeypatch.chdir(tmp_path)
    assert cli.main(["router", "--config=fleet.toml"]) == 0
    assert f'"{tmp_path}/certificates/router.pem"' in capsys.readouterr().out  # zenohd may run in another folder


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[router", "found invalid TOML"),
        ("[gateway]\nlink = 1", "found 'gateway' in"),
        ('[router]\nca = "x"', "found 'ca' in .* at, certificates, passwords; correct it"),
        ("[router]\nat = 7447", "a value that is not a string"),
        ('[router]\nat = "udp/x:1"', "--router: found 'udp/x:1'"),
        ('[router]\nat = "tls/x:1"', "tls/x:1 without certificates"),
        ('[router]\ncertificates = "c"', "tcp/127.0.0.1:7447 with certificates"),
        ("router = 3", "expected only \\[router\\]"),
    ],
)
def test_a_file_that_makes_no_sense_is_refused_in_a_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        bus_config_from(told(written(tmp_path, text)))


def parsers() -> dict[str, argparse.ArgumentParser]:
    """Every verb of `fleet` that joins the bus."""
    found = {}
    for name, path in cli.command_modules().items():
        if name not in OFF_THE_BUS:
            found[name] = argparse.ArgumentParser()
            importlib.import_module(path).arguments(found[name])
    return found


def test_every_command_on_the_bus_takes_the_same_two_options(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    for name, parser in parsers().items():
        assert "--config FILE" in parser.format_help() and "--router ENDPOINT" in parser.format_help(), name
    for module in (gateway, twin_worker, viewer):
        with pytest.raises(SystemExit):
            module.main(["--help"])
        help_ = capsys.readouterr().out
        assert "--config FILE" in help_ and "--router ENDPOINT" in help_


# --- papers and passwords --------------------------------------------------------------------------------------------


def test_papers_are_found_private_and_in_time(papers: Path, tmp_path: Path) -> None:
    certificate, key = find_certificate(papers, "worker")
    assert (certificate, key) == (papers / "worker.pem", papers / "worker.key")
    assert timedelta(days=89) < expiry_of(certificate) - datetime.now(UTC) < timedelta(days=91)
    with pytest.raises(ValueError, match=r"found no .*pilot\.pem, expected it for the role pilot"):
        find_certificate(papers, "pilot")
    mine = Path(shutil.copytree(papers, tmp_path / "mine"))
    (mine / "worker.key").chmod(0o644)
    with pytest.raises(ValueError, match=r"worker\.key with mode 0644, .* chmod 640"):
        find_certificate(mine, "worker")
    (mine / "worker.key").chmod(0o640)
    assert find_certificate(mine, "worker")
    with pytest.raises(ValueError, match=r"expired on .* renew it: certificates\.sh role"):
        find_certificate(expired(papers, "worker", tmp_path / "old"), "worker")
    (mine / "viewer.pem").write_text("no certificate")
    with pytest.raises(ValueError, match="found no certificate in"):
        find_certificate(mine, "viewer")


def test_a_password_is_a_line_of_a_private_file(tmp_path: Path) -> None:
    file = make_passwords(tmp_path)
    assert len({read_password(file, role) for role in (*ROLES, ROUTER_ROLE)}) == 6
    with pytest.raises(ValueError, match="found none for the role pilot"):
        read_password(file, "pilot")
    file.chmod(0o604)
    with pytest.raises(ValueError, match="mode 0604"):
        read_password(file, "worker")


def test_a_secret_is_in_no_representation(papers: Path) -> None:
    passwords = make_passwords(papers)
    at = BusConfig("tcp/127.0.0.1:7447", "worker", None, passwords)
    assert read_password(passwords, "worker") not in repr(at)
    assert at.session_settings()["transport/auth/usrpwd/password"] == read_password(passwords, "worker")
    assert at.router_settings()["access_control"] == access_control(PASSWORD)


def test_a_wrong_password_is_said(papers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fleet.access.entry._CONNECT_TIMEOUT_MS", 300)
    at = f"tcp/127.0.0.1:{unused_port()}"
    site, other = make_passwords(papers), make_passwords(tmp_path)
    refused = pytest.raises(ConnectionError, match="expected it to accept the password of viewer")
    with open_router(BusConfig(at, passwords=site)), refused:
        connect(BusConfig(at, "viewer", None, other))


@pytest.mark.parametrize("with_roles", [False, True])
def test_a_router_forwards_samples_to_its_clients_and_not_to_other_regions(papers: Path, with_roles: bool) -> None:
    at, passwords = f"tcp/127.0.0.1:{unused_port()}", make_passwords(papers) if with_roles else None
    elsewhere = "router" if with_roles else "tools"  # roles tell routers apart, without roles the interface does
    counts = []
    for role, interface in ((elsewhere, "lo"), ("viewer", "eth-of-another-machine")):
        keys: list[str] = []
        settings = BusConfig(at, passwords=passwords).router_settings(between=[interface])
        with (
            zenoh.open(_config(settings)),
            connect(BusConfig(at, role, None, passwords)) as reader,
            connect(BusConfig(at, "gateway", None, passwords)) as sender,
        ):
            for expression in ("parauav/*/*", "parauav/@fleet/sample/*"):
                reader._session.declare_subscriber(
                    expression, lambda sample, keys=keys: keys.append(str(sample.key_expr))
                )
            until(lambda sender=sender, keys=keys: sender._session.put("parauav/1/status", b"x") or keys)
            for _ in range(5):
                sender._session.put("parauav/2/sample", b"x")
                sender._session.put("parauav/@fleet/sample/ab", b"x")
            sender._session.put("parauav/2/status", b"x")
            until(lambda keys=keys: "parauav/2/status" in keys)
            counts.append([keys.count(key) for key in ("parauav/2/sample", "parauav/@fleet/sample/ab")])
    assert counts == [[0, 0], [5, 5]]


# --- the script ------------------------------------------------------------------------------------------------------


def script(*words: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["sh", str(SCRIPT), *map(str, words)], capture_output=True, text=True, check=False)


def test_an_authority_is_replaced_without_anyone_being_shut_out(tmp_path: Path) -> None:
    site = make_papers(tmp_path / "site", "127.0.0.1")
    old = Path(shutil.copytree(site, tmp_path / "machine-a"))
    at = f"tls/127.0.0.1:{unused_port()}"
    assert script("next-ca", site).returncode == 0
    assert (site / "ca.pem").read_text().count("BEGIN CERTIFICATE") == 2
    assert script("role", site, "viewer", "worker").returncode == 0
    with open_router(BusConfig(at, certificates=site)):  # the router trusts both, shows its old certificate
        assert probe_router(BusConfig(at, "worker", old))
        assert probe_router(BusConfig(at, "worker", site))
    assert script("router", site, "127.0.0.1").returncode == 0 and script("drop-ca", site).returncode == 0
    with open_router(BusConfig(at, certificates=site)):
        assert probe_router(BusConfig(at, "worker", site))
        with pytest.raises(ConnectionError, match="found its certificate not valid"):
            probe_router(BusConfig(at, "worker", old))
        shutil.copy(site / "ca.pem", old)
        with pytest.raises(ConnectionError, match="certificate of worker rejected"):
            probe_router(BusConfig(at, "worker", old))


def test_the_script_refuses_what_would_lose_something(papers: Path, tmp_path: Path) -> None:
    before = (papers / "ca.key").read_bytes()
    again = script("ca", papers)
    assert again.returncode == 2 and "found" in again.stderr and (papers / "ca.key").read_bytes() == before
    assert "found role 'pilot'" in script("role", papers, "pilot").stderr
    assert "create it first: ca" in script("role", tmp_path, "worker").stderr
    assert script("router", papers).returncode == 2 and script().returncode == 2
    shown = script("show", papers).stdout
    assert all(f"{role}.pem: subject=CN = {role}" in shown for role in (*ROLES, ROUTER_ROLE))
    assert not [path.name for path in papers.iterdir() if path.suffix in (".new", ".csr", ".ext")]
    assert {(papers / f"{role}.key").stat().st_mode & 0o777 for role in (*ROLES, "ca")} == {0o600}


def test_the_router_is_known_by_all_its_names(papers: Path) -> None:
    decoded = ssl._ssl._test_decode_cert(str(papers / "router.pem"))  # type: ignore[attr-defined]
    assert decoded["subjectAltName"] == (("IP Address", "127.0.0.1"), ("DNS", "router.example"))
