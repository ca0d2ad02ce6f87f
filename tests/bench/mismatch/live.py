"""Aircraft with and without a fault, flown live over UDP: when is each fault flagged and named, and is anybody else?

    python -m tests.bench.mismatch.live --seconds 1200 --json live.json

Simulated aircraft (JSBSim) of another seed each, a fleet as `fleet up` starts it; each flight's own past is its model.
Times count from the onset of the fault, in the time of the telemetry.
"""

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections import defaultdict
from pathlib import Path
from statistics import median

from fleet.bus.session import connect
from fleet.contract import DiagnosisOutcome, Mismatch, Sample
from fleet.process.logs import report_progress

from .__main__ import found

FAULTS = (
    "thrust_loss,fraction=0.3",
    "drag_increase,dCD=0.05",
    "airspeed_bias,bias_mps=-6",
    "control_effectiveness_loss:aileron,loss=0.5",
)
HEALTHY = 8
_ROUTER, _LINK = "tcp/127.0.0.1:7461", "127.0.0.1:14661"
_REPORT_S = 60.0  # between two lines of progress [s]


def main() -> int:
    """Fly, listen and print what was said of each aircraft."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m tests.bench.mismatch.live", description=__doc__, formatter_class=form)
    parser.add_argument("--seconds", type=float, default=1200.0, help="duration from the first sample on [s] (1200)")
    parser.add_argument("--onset", type=float, default=300.0, help="of the faults, in flight time [s] (300)")
    parser.add_argument("--faults", nargs="+", default=FAULTS, help="one aircraft each")
    parser.add_argument("--healthy", type=int, default=HEALTHY, help=f"aircraft without a fault ({HEALTHY})")
    parser.add_argument("--seed", type=int, default=1, help="of the first aircraft (1)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    args = parser.parse_args()
    told, first = _fly(args)
    rows = [
        {"seed": args.seed + uav, "fault": fault} | found(fault, told[uav], first[uav] + args.onset)
        for uav, fault in enumerate(args.faults)
    ]
    healthy = range(len(rows), len(rows) + args.healthy)
    names = {uav: [m.sentence for m in told[uav] if m.outcome is DiagnosisOutcome.NAMED] for uav in healthy}
    print(*rows, sep="\n")
    for which in ("flagged_s", "named_s"):
        times = [row[which] for row in rows if row[which] is not None]
        print(f"{which}: {len(times)} of {len(rows)}, median {median(times):.0f}" if times else f"{which}: none")
    accused = {uav: said for uav, said in names.items() if said}
    print(f"healthy: {len(accused)} of {args.healthy} named {accused or ''}; load {os.getloadavg()[0]:.1f}")
    if args.json:
        figures = {"rows": rows, "healthy": args.healthy, "accused": accused, "seconds": args.seconds}
        args.json.write_text(json.dumps(figures, indent=1) + "\n")
    return 0


def _fly(args: argparse.Namespace) -> tuple[dict[int, list[Mismatch]], dict[int, float]]:
    """Give what was said of each aircraft, and the time of its first sample [s since 1970]."""
    count = len(args.faults) + args.healthy
    told: dict[int, list[Mismatch]] = defaultdict(list)
    first: dict[int, float] = {}

    def on_sample(sample: Sample, _: object) -> None:
        if sample.uav not in first and sample.attitude is not None and len(t := sample.attitude.t.numpy()):
            first[sample.uav] = float(t[0])

    fleet = [f"--link=udpin:{_LINK}#offset=-1", "--no-viewer", f"--router={_ROUTER}", "up"]
    commands = [["-m", "fleet.cli", fleet.pop(), *fleet]]
    for uav in range(count):
        fly = ["-m", "fleet.cli", "fly", f"--uavs={uav}-{uav}", f"--to={_LINK}", f"--seed={args.seed + uav}"]
        commands.append(fly + ([f"--fault={args.faults[uav]},at={args.onset:.0f}"] if uav < len(args.faults) else []))
    children = [subprocess.Popen([sys.executable, *command], stderr=subprocess.DEVNULL) for command in commands]
    try:
        with connect(_ROUTER, retry=True) as bus:
            bus.subscribe(Sample, on_sample)
            bus.subscribe(Mismatch, lambda mismatch, _: told[mismatch.uav].append(mismatch))
            never, begun, reported = threading.Event(), 0.0, 0.0
            while not begun or time.monotonic() < begun + args.seconds:
                never.wait(1.0)
                if ended := [command for command, child in zip(commands, children, strict=True) if child.poll()]:
                    raise SystemExit(f"python {' '.join(ended[0])}: ended during the measurement; start it alone")
                begun = begun or (time.monotonic() if len(first) == count else 0.0)
                if begun and time.monotonic() > reported + _REPORT_S:
                    reported = time.monotonic()
                    said = {uav: said[-1].outcome.value for uav, said in sorted(told.items())}
                    report_progress("bench.live", f"{reported - begun:.0f} s, {len(first)} aircraft, {said}")
    finally:
        for child in children[::-1]:
            child.terminate()
        for child in children:
            child.wait(30.0)
    return told, first


if __name__ == "__main__":
    raise SystemExit(main())
