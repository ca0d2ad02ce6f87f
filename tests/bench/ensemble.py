"""`python -m tests.bench.ensemble`: 100 aircraft, 50 members each, 60 s ahead on one core; beside all control loops.

The peer flies as many members through `fleet.physics.simulate`: the same guidance, with attitude loops and coupled
dynamics.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np

from fleet.airframes import GENERIC, load
from fleet.autopilots import arduplane, laws
from fleet.cli import make_parser, run_command
from fleet.contract import Item
from fleet.frames import Origin
from fleet.mission import unroll_route
from fleet.physics import point_mass as H
from fleet.physics.simulate import N_STATE, coupled_plant, simulate
from twin_worker.identification.fixed_wing.derivatives_model import prior

EXAMPLES = """
  python -m tests.bench.ensemble --json ensemble.json
"""
UAVS, MEMBERS, SECONDS = 100, 50, 60
_V, _DT = 22.0, 0.04
_HOME = Origin(470_000_000, 80_000_000, 500_000)
_CORNERS = ((0, 0, 500.0), (40_000, 0, 100.0), (60_000, 30_000, 130.0), (20_000, 60_000, 80.0), (0, 20_000, 100.0))


def controlled() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Give a controller at the start of a route with turns and climbs."""
    places = [(_HOME.lat_e7 + n, _HOME.lon_e7 + e, up) for n, e, up in _CORNERS]
    items = tuple(Item(seq=k, command=16, lat_e7=n, lon_e7=e, alt_m=up) for k, (n, e, up) in enumerate(places))
    legs = unroll_route(items, seq=1, origin=_HOME, params={}).legs
    par, _ = laws.parameters("arduplane", arduplane.DEFAULTS | {"AIRSPEED_CRUISE": _V, "AIRSPEED_MAX": 30.0}, 600.0)
    p, v = np.array([0.0, 0.0, -100.0]), np.array([_V, 0.0, 0.0])
    return laws.init(par, legs, 0, p, p, v, np.zeros(3), _V, 0.0, 0.5), par, legs  # type: ignore


def bundles(control: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Callable[[], None]:
    """Give the flight of every aircraft's bundle."""
    body, air, start = np.zeros(H.N_PARAMETERS), np.zeros(H.N_AIR), np.zeros(H.N_START)
    body[[H.WN_PHI, H.ZETA_PHI, H.WN_THETA, H.ZETA_THETA]] = 3.0, 0.9, 3.0, 0.9
    body[[H.K_PSI, H.A_N, H.C_T, H.C_V, H.C_N, H.T_0, H.V_0]] = 1.0, 0.06, 4.0, -0.1, -0.2, 0.5, _V
    air[[H.SCALE, H.DRIFT, H.DRIFT_S, H.REST, H.REST_S]] = 1.0, 0.6, 60.0, 0.8, 7.0
    start[2], start[H.V], start[H.THROTTLE] = -100.0, _V, 0.5
    rows = [np.tile(row, (MEMBERS, 1)) for row in (body, air, start)]
    at, out = np.arange(0, SECONDS * 4 + 1, 4), np.empty((MEMBERS, SECONDS + 1, 3))
    rng = np.random.default_rng(1)

    def fly() -> None:
        for _ in range(UAVS):
            chance = rng.standard_normal((MEMBERS, SECONDS + 1, 4))
            H.simulate_ensemble(control, *rows, chance, at, out)  # type: ignore
        assert np.isfinite(out).all()

    return fly


def loops(control: tuple[np.ndarray, np.ndarray, np.ndarray]) -> Callable[[], None]:
    """Give the same number of flights through every loop, for one aircraft in ten."""
    at = np.array([_V, 1.0])
    plant = coupled_plant(prior(load(GENERIC), at, np.array([0.0, 0.0, 0.0, 0.5]), np.zeros(2))[0], at)
    state = np.array([0.0, 0.0, -100.0, _V, 0.0, 1.0, *np.zeros(6)])
    out, air = np.empty((round(SECONDS / _DT), N_STATE)), np.array([0.0, 0.0, 1.0, 0.0])

    def fly() -> None:
        for _ in range(UAVS // 10 * MEMBERS):
            simulate(control[0].copy(), *control[1:], plant, state, np.array([0, 0, 0, 0, 0, 0.5]), air, _DT, out)

    return fly


def seconds(work: Callable[[], None], repeats: int = 5) -> float:
    """Give the median processor time [s]."""
    work()
    times = []
    for _ in range(repeats):
        begun = time.process_time()
        work()
        times.append(time.process_time() - begun)
    return median(times)


def _run(args: argparse.Namespace) -> int:
    control = controlled()
    ours, peer = seconds(bundles(control)), 10.0 * seconds(loops(control), 3)
    print(f"{UAVS} aircraft x {MEMBERS} members x {SECONDS} s: {ours:.2f} s of one core")
    print(
        f"the same through attitude loops and coupled dynamics (fleet.physics.simulate): "
        f"{peer:.2f} s, {peer / ours:.1f} times"
    )
    if args.json:
        args.json.write_text(json.dumps({"bundles_s": ours, "simulate_s": peer, "ratio": peer / ours}, indent=2) + "\n")
    return 0


def main(argv: list[str] | None = None) -> int:
    """Time the ensembles of a fleet."""
    parser = make_parser("python -m tests.bench.ensemble", "Time the ensembles of a fleet.", EXAMPLES)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the times to FILE")
    return run_command("bench.ensemble", _run, parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
