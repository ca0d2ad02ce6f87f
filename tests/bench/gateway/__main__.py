"""How fast the gateway decodes, and what a thousand aircraft over UDP cost it, against plain pymavlink loops.

    python -m tests.bench.gateway flight.tlog --uavs 1000 --seconds 30 --json gateway.json
    python -m tests.bench.gateway.equal      equality with pymavlink field by field, the long run
    python -m tests.bench.gateway.fuzz       random and mutated bytes

`ratio`: messages per CPU-second, ours to pymavlink's, both in this run. `fleet`: copies of the recording are sent as
one MAVLink frame a datagram, at most 250 aircraft a link; CPU is that of the whole gateway process, all threads; a
datagram is lost uncounted where neither the gateway nor the system counted it.
"""

import argparse
import json
import platform
import sys
import tempfile
from pathlib import Path

from fleet.telemetry.recording.opening import RecordingFile

from . import decoding, load

PLAIN = 250  # aircraft for the plain loop, as many as on a link of ours; it does not bear a thousand


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="a .tlog, also compressed")
    parser.add_argument("--uavs", type=int, default=1000, help="0: only decode")
    parser.add_argument("--seconds", type=float, default=30.0, help="watched")
    parser.add_argument("--from", dest="begin", type=float, default=20.0, help="after all were met [s]")
    parser.add_argument("--json", type=Path, metavar="FILE")
    args = parser.parse_args()
    found = {"machine": platform.processor() or platform.machine(), "decode": decoding.measure(args.file)}
    print(json.dumps(found["decode"], indent=1), flush=True)
    if args.uavs:
        with tempfile.TemporaryDirectory() as folder:
            plain = Path(folder) / "flight.tlog"
            plain.write_bytes(RecordingFile(args.file).open().read(1 << 30) or b"")
            fleet = load.measure(plain, args.uavs, args.seconds, args.begin)
            loop = load.plain(plain, min(args.uavs, PLAIN), args.seconds, args.begin)
        loop["ratio"] = round(loop["us_a_message"] / fleet["us_a_message"], 1)
        found |= {"fleet": fleet, "plain_loop": loop}
        print(json.dumps({"fleet": fleet, "plain_loop": loop}, indent=1), flush=True)
    if args.json:
        args.json.write_text(json.dumps(found, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
