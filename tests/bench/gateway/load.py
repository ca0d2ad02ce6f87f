"""A thousand aircraft as MAVLink datagrams over loopback: what the gateway's process takes, and what gets lost."""

import os
import queue
import re
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from fleet.bus.session import connect, open_router
from fleet.contract import GatewayCounters, Sample

A_LINK = 250  # aircraft
TICKS = os.sysconf("SC_CLK_TCK")
LONG_S = 180.0  # an upper bound for what ends with its condition [s]


def free(kind: socket.SocketKind) -> int:
    """Give a port that nobody holds."""
    with socket.socket(socket.AF_INET, kind) as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def cpu_s(pid: int) -> float:
    """Give the CPU time a process has taken, all threads [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


class Ear:
    """What the bus brings: counts only, unpacked by nobody."""

    def __init__(self, where: str) -> None:
        self.bus = connect(where)
        self.samples = self.bytes = 0
        self.accounts: queue.Queue[GatewayCounters] = queue.Queue()
        self.bus.subscribe_raw(Sample, self._sample)
        self.bus.subscribe(GatewayCounters, lambda account, _: self.accounts.put(account))

    def _sample(self, payload: bytes, *_: Any) -> None:
        self.samples += 1
        self.bytes += len(payload)


def overflown(ports: list[int]) -> int:
    """Give how many datagrams the system threw away because a socket's buffer was full."""
    rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    return sum(int(row[-1]) for row in rows if int(row[1].partition(":")[2], 16) in ports)


def start(*arguments: str) -> subprocess.Popen[str]:
    """Start one of our commands."""
    return subprocess.Popen(
        [sys.executable, "-m", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def measure(path: Path, uavs: int, seconds: float, from_s: float) -> dict[str, Any]:
    """Send `uavs` copies of a recording at its own pace; count from `from_s` on for `seconds`."""
    ports = [free(socket.SOCK_DGRAM) for _ in range(-(-uavs // A_LINK))]
    where = f"tcp/127.0.0.1:{free(socket.SOCK_STREAM)}"
    router = open_router(where)
    links = [f"--link=udpin:127.0.0.1:{port}#offset={k * A_LINK}" for k, port in enumerate(ports)]
    gateway = start("gateway", "--router", where, "--listen-only", *links)
    ear = Ear(where)
    try:
        first = ear.accounts.get(timeout=LONG_S)
        to = [f"--to=udpout:127.0.0.1:{port}" for port in ports]
        sender = start("fleet.cli", "replay", str(path), "--copies", str(uavs), *to)
        account = first
        while len(account.uavs) < uavs:
            account = ear.accounts.get(timeout=LONG_S)
        return _watched(ear, (gateway, sender), ports, account, (from_s, seconds))
    finally:
        gateway.terminate()
        gateway.communicate()
        ear.bus.close()
        router.close()


def _watched(
    ear: Ear,
    children: tuple[subprocess.Popen[str], subprocess.Popen[str]],
    ports: list[int],
    met: GatewayCounters,
    when: tuple[float, float],
) -> dict[str, Any]:
    gateway, sender = children
    began = _next(ear, met.t + when[0])
    over = overflown(ports)
    cpu, samples, size, busy, at = cpu_s(gateway.pid), ear.samples, ear.bytes, cpu_s(sender.pid), time.monotonic()
    ended = _next(ear, began.t + when[1])
    took, over = time.monotonic() - at, overflown(ports) - over
    cpu, busy = cpu_s(gateway.pid) - cpu, cpu_s(sender.pid) - busy
    heard = ended.messages - began.messages
    samples, size = ear.samples - samples, ear.bytes - size
    sender.terminate()
    said = sender.communicate()[1]
    ends = [line for line in said.splitlines() if "datagrams" in line and "%" not in line]
    sent = sum(int(n.replace(",", "")) for line in ends for n in re.findall(r"([\d,]+) datagrams", line))
    last = _quiet(ear, ended)
    return {
        "aircraft": len(ended.uavs),
        "seconds": round(took, 1),
        "messages_a_second": round(heard / took),
        "messages_a_second_each": round(heard / took / len(ended.uavs), 1),
        "gateway_cores": round(cpu / took, 3),
        "us_a_message": round(1e6 * cpu / heard, 2),
        "sender_cores": round(busy / took, 2),
        "published_a_second": round((ended.published - began.published) / took),
        "samples_a_second": round(samples / took),
        "bytes_a_sample": round(size / max(samples, 1)),
        "sent_in_all": sent,
        "heard_in_all": last.datagrams,
        "overflown_meanwhile": over,
        "overflown_in_all": overflown(ports),
        "lost_uncounted": sent - last.datagrams - overflown(ports),
        "refused": last.refused,
        "sender_said": ends,
    }


def _next(ear: Ear, t: float) -> GatewayCounters:
    """Wait for the first count at or after fleet time `t` [s since 1970]."""
    account = ear.accounts.get(timeout=LONG_S)
    while account.t < t:
        account = ear.accounts.get(timeout=LONG_S)
    return account


def _quiet(ear: Ear, account: GatewayCounters) -> GatewayCounters:
    """Wait until nothing more comes."""
    while True:
        after = ear.accounts.get(timeout=LONG_S)
        if after.datagrams == account.datagrams:
            return after
        account = after


def plain(path: Path, uavs: int, seconds: float, from_s: float) -> dict[str, Any]:
    """Measure the plain loop with a part of the aircraft, over as long a stretch of the same recording."""
    port, where = free(socket.SOCK_DGRAM), f"tcp/127.0.0.1:{free(socket.SOCK_STREAM)}"
    router = open_router(where)
    loop = start("tests.bench.gateway.plain", str(port), where)
    assert loop.stdout is not None
    sender = None
    try:
        loop.stdout.readline()
        sender = start("fleet.cli", "replay", str(path), "--copies", str(uavs), f"--to=udpout:127.0.0.1:{port}")
        while not int(loop.stdout.readline()):
            pass
        for _ in range(round(from_s)):
            loop.stdout.readline()
        before, cpu = int(loop.stdout.readline()), cpu_s(loop.pid)
        for _ in range(round(seconds)):
            heard = int(loop.stdout.readline()) - before
        cpu = cpu_s(loop.pid) - cpu
    finally:
        for child in filter(None, (sender, loop)):
            child.terminate()
            child.communicate()
        router.close()
    return {"aircraft": uavs, "messages_a_second": round(heard / seconds), "us_a_message": round(1e6 * cpu / heard, 2)}
