"""Peak memory of this process. `ru_maxrss` will not do: a child process inherits that of its parent."""

from pathlib import Path

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_mb() -> float:
    """Read the peak resident memory since the start of the process or the last `reset_peak` [MB]."""
    return int(_STATUS.read_text().partition("VmHWM:")[2].split()[0]) / 1024


def reset_peak() -> float:
    """Set the peak back to what is resident now and return that [MB]."""
    _RESET.write_text("5")
    return peak_mb()
