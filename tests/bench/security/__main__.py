"""The security table: everything that must be refused, tried against the real router and against ours.

    python -m tests.bench.security --json security.json

Every attempt is made beside a rightful use of the same thing, which must succeed. `bombs`: everyone who reads the bus,
each in a process of its own, bombarded from another one, with the router in a third where it is the real one.
"""

import argparse
import json
import multiprocessing
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from .commands import BY_COMMAND
from .door import BY_CERTIFICATE, BY_PASSWORD, ends_while_joined, renewed_while_joined
from .forged import BY_FORGING
from .hostile_files import BY_FILE
from .limits import BY_LIMIT
from .planted import BY_PLANTING
from .role import BY_ROLE
from .site import OURS, REAL, Site, free_port, make_papers, make_passwords, routed, zenohd
from .size import BY_SIZE
from .victims import VICTIMS, survived


def main() -> int:
    """Try everything; exit code 1 where anything went in."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    kinds = [REAL, OURS] if zenohd() else [OURS]
    if REAL not in kinds:
        print("no zenohd found (PARAUAV_ZENOHD, the path, ~/.cargo/bin): only our own router is tried", file=sys.stderr)
    found = [row for kind in kinds for row in _tried(kind)]
    kinds_alone = {"caches": BY_PLANTING, "epochs": BY_FORGING, "files": BY_FILE, "limits": BY_LIMIT}
    for what, attempts in {**kinds_alone, "commands": BY_COMMAND}.items():
        found += [_row(("-", what, one.__name__, one.__doc__ or ""), one) for one in attempts]
    held = sum(row["held"] for row in found)
    print(f"{held} of {len(found)} held")
    if args.json:
        said = {"machine": platform.processor() or platform.machine(), "held": held, "rows": found}
        args.json.write_text(json.dumps(said, indent=1) + "\n")
    return int(held < len(found))


def _tried(kind: str) -> Iterator[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as name:
        folder = make_papers(Path(name) / "site", "127.0.0.1")
        mutual = Site(f"tls/127.0.0.1:{free_port()}", folder)
        words = Site(f"tcp/127.0.0.1:{free_port()}", folder, make_passwords(folder))
        both = Site(f"tls/127.0.0.1:{free_port()}", folder, words.passwords)
        for what, site, attempts in (
            ("certificates", mutual, (*BY_CERTIFICATE, ends_while_joined, renewed_while_joined, *BY_ROLE, *BY_SIZE)),
            ("passwords", words, (*BY_PASSWORD, *BY_ROLE, *BY_SIZE)),
            ("passwords in TLS", both, (*BY_PASSWORD, *BY_ROLE)),
            ("loopback, nothing shown", Site(f"tcp/127.0.0.1:{free_port()}", folder), BY_SIZE),
        ):
            with routed(kind, site):
                for attempt in attempts:
                    yield _row((kind, what, attempt.__name__, attempt.__doc__ or ""), lambda a=attempt, s=site: a(s))
        site = Site(f"tcp/127.0.0.1:{free_port()}", folder)
        with routed(kind, site):
            for victim in VICTIMS:
                one = (kind, "bombs", victim.__name__, victim.__doc__ or "")
                yield _row(one, lambda v=victim, s=site: _apart(v.__name__, s.at))


def _apart(victim: str, at: str) -> str:
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(survived, victim, at).result()


def _row(names: tuple[str, str, str, str], attempt: Callable[[], str]) -> dict[str, Any]:
    begun = time.monotonic()
    try:
        held, words = True, attempt()
    except Exception as error:
        held, words = False, f"{type(error).__name__}: {error}"
    router, site, name, what = names
    print(f"{'held' if held else 'WENT IN':8}{router:9} {site:24} {name:22} {words}", flush=True)
    row = {"router": router, "site": site, "attempt": name, "what": what.split("\n")[0], "held": held, "words": words}
    return row | {"seconds": round(time.monotonic() - begun, 2)}


if __name__ == "__main__":
    sys.exit(main())
