"""What a process takes, and the processes of the bench."""

import os
import socket
import subprocess
import sys
from pathlib import Path

TICKS = os.sysconf("SC_CLK_TCK")


def free_port() -> int:
    """Give a port that nobody holds."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def cpu_s(pid: int) -> float:
    """Give the CPU time a process has taken, all threads [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def start(*module: str) -> subprocess.Popen:
    """Start a module of this checkout; its first line tells that it is ready."""
    command = [sys.executable, "-m", *module]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    if process.stdout is None or not process.stdout.readline():
        raise SystemExit(f"{' '.join(module)}: ended before it was ready; read what it said above")
    return process


def tell(process: subprocess.Popen) -> str:
    """Say "on" to a process and give its next line."""
    if process.stdin is None or process.stdout is None:
        return ""
    process.stdin.write("\n")
    process.stdin.flush()
    return str(process.stdout.readline())
