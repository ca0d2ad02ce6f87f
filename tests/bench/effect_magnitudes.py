"""Every effect of the catalogue, simulated at its three magnitudes and identified again.

    python -m tests.bench.effect_magnitudes

What is asked of each report: `tests/twin_worker/diagnosis/test_effect_injection.py`, which flies each effect at its
largest magnitude and one effect of each stage at all three. Exit code 1 where a report misses what is asked.
"""

import sys

from tests.twin_worker.diagnosis.test_effect_injection import ALL, assert_named, fly


def main() -> int:
    """Diagnose all flights and print which reports miss what is asked."""
    pairs = [(name, size) for name in ALL for size in range(3)]
    made, missed = fly(pairs), []
    for name, size in pairs:
        try:
            assert_named(name, size, made)
        except AssertionError as error:
            missed.append(f"{name} {size}: {error}")
    print(*missed, f"{len(pairs) - len(missed)} of {len(pairs)} flights identified as asked", sep="\n")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
