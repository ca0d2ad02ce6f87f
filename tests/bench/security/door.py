"""Attempts to come in: without certificate or password, with the wrong one, and to pass for the router."""

import shutil
import time
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import zenoh

from fleet.access.knock import probe_router
from fleet.bus.session import _config

from .site import PATIENCE_S, Site, expired, make_papers
from .trying import IDS, UNTRIED, Admitted, Attempt, until

REFUSED_MS = 1_000  # a rightful session takes a tenth
_TLS = "transport/link/tls"
_WORDS = "transport/auth/usrpwd"


def no_certificate(site: Site) -> str:
    """Join with TLS, but show nothing."""
    names = ("connect_certificate", "connect_private_key", "enable_mtls")
    return _kept_out(site, "viewer", {f"{_TLS}/{name}": None for name in names})


def foreign_authority(site: Site) -> str:
    """Join with a certificate of the right name, made by another authority."""
    return _kept_out(site, "worker", _shown(make_papers(_folder(site), "127.0.0.1"), "worker"))


def expired_certificate(site: Site) -> str:
    """Join with one of the site's own that has ended."""
    return _kept_out(site, "worker", _shown(expired(site.folder, "worker", _folder(site)), "worker"))


def plain_tcp(site: Site) -> str:
    """Join without TLS."""
    return _kept_out(site, "tools", {"connect/endpoints": [site.at.replace("tls/", "tcp/")]})


def role_as_router(site: Site) -> str:
    """Have a viewer's certificate stand in for the router: who joins must not believe it."""
    return _impostor(site, site.folder, "viewer")


def foreign_router(site: Site) -> str:
    """Have another authority's router stand in for ours."""
    return _impostor(site, make_papers(_folder(site), "127.0.0.1"), "router")


def other_name(site: Site) -> str:
    """Have a machine of another name stand in for the router, with a certificate of the site's own."""
    return _impostor(site, make_papers(_folder(site), "elsewhere.example", authority=site.folder), "router")


def wrong_password(site: Site) -> str:
    """Join by a role's name and another's password."""
    return _kept_out(site, "worker", {f"{_WORDS}/password": "guess"})


def no_password(site: Site) -> str:
    """Join without name and password."""
    return _kept_out(site, "worker", {f"{_WORDS}/user": None, f"{_WORDS}/password": None})


def ends_while_joined(site: Site) -> str:
    """Stay on with a certificate that ends: the router must hang up by itself."""
    left_s = 3
    ending = expired(site.folder, "tools", _folder(site), ended=timedelta(seconds=-left_s))
    with site.session("tools", _shown(ending, "tools")) as session:
        begun = time.monotonic()
        if not until(lambda: bool(session.info.routers_zid())):
            raise Admitted(UNTRIED)
        if not until(lambda: not session.info.routers_zid()):
            raise Admitted(f"it is still there after {PATIENCE_S:.0f} s")
        return f"hung up after {time.monotonic() - begun:.1f} s of {left_s}"


def renewed_while_joined(site: Site) -> str:
    """Renew a certificate that ends while it is used: its process must come back by itself, without a restart."""
    mine = expired(site.folder, "worker", _folder(site), ended=timedelta(seconds=-3))
    with site.session("worker", _shown(mine, "worker")) as session:
        for suffix in ("pem", "key"):
            shutil.copy(site.folder / f"worker.{suffix}", mine)
        if not until(lambda: not session.info.routers_zid()):
            raise Admitted(f"it is still there after {PATIENCE_S:.0f} s")
        begun = time.monotonic()
        if not until(lambda: bool(session.info.routers_zid())):
            raise Admitted("it did not come back")
        return f"back after {time.monotonic() - begun:.2f} s"


BY_CERTIFICATE: tuple[Attempt, ...] = (
    *(no_certificate, foreign_authority, expired_certificate, plain_tcp, role_as_router, foreign_router, other_name),
)
BY_PASSWORD: tuple[Attempt, ...] = (wrong_password, no_password)


def _folder(site: Site) -> Path:
    return site.folder / f"other-{next(IDS)}"


def _shown(folder: Path, role: str) -> dict[str, Any]:
    return {
        f"{_TLS}/connect_certificate": f"{folder}/{role}.pem",
        f"{_TLS}/connect_private_key": f"{folder}/{role}.key",
    }


def _kept_out(site: Site, role: str, changed: dict[str, Any]) -> str:
    with site.session(role) as rightful:
        if not rightful.info.routers_zid():
            raise Admitted(UNTRIED)
    try:
        with site.session(role, changed | {"connect/timeout_ms": REFUSED_MS}) as session:
            raise Admitted(f"it joined {session.info.routers_zid()}")
    except zenoh.ZError as error:
        return f"kept out: {str(error).split(' at /')[0][:80]}"


def _impostor(site: Site, folder: Path, name: str) -> str:
    """Open a router of our own beside the site's with papers of `folder`, and join it as a worker would."""
    host, _, port = site.at.rpartition(":")
    entry = replace(site.entry("worker"), endpoint=f"{host}:{int(port) + next(IDS)}")
    papers = {
        f"{_TLS}/listen_certificate": f"{folder}/{name}.pem",
        f"{_TLS}/listen_private_key": f"{folder}/{name}.key",
    }
    with zenoh.open(_config(entry.router_settings() | papers)):
        try:
            probe_router(entry)
        except ConnectionError as error:
            words = str(error).split("found ")[1]
        else:
            raise Admitted("the knock believed it")
        try:
            with zenoh.open(_config(entry.session_settings() | {"connect/timeout_ms": REFUSED_MS})):
                raise Admitted("Zenoh believed it")
        except zenoh.ZError:
            return f"not believed: {words[:80]}"
