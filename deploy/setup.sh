#!/bin/sh
# Set up .venv: every package of requirements.lock by version and hash, then the project itself. Called by `make setup`.
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
log=.venv/setup.log

report() { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }

command -v "$python" >/dev/null || fail "found no '$python', expected Python 3.11 or newer; install it or run: make setup PYTHON=/path/to/python3"
found=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    fail "found Python $found, expected 3.11 or newer; name a newer one: make setup PYTHON=python3.12"
"$python" -c 'import ensurepip, venv' 2>/dev/null ||
    fail "found Python $found without venv; install it, e.g. on Debian or Ubuntu: apt-get install python3-venv"

rm -f .venv/setup-done
report "1/3 create a virtual environment in .venv (Python $found)"
"$python" -m venv --clear .venv

total=$(grep -c '==' requirements.lock)
# The lock is complete; --no-deps leaves out what rotorpy names but ParaUAV does not use (cvxopt, GPL).
report "2/3 install $total packages, about 300 MB; a few minutes the first time"
{ .venv/bin/python -m pip install --disable-pip-version-check --progress-bar off --no-deps --require-hashes -r requirements.lock 2>&1 ||
    echo 'SETUP-FAILED'; } | {
    count=0
    : >"$log"
    while IFS= read -r line; do
        printf '%s\n' "$line" >>"$log"
        case $line in
        Collecting*)
            count=$((count + 1))
            if [ $((count % 5)) = 0 ]; then report "    $count/$total"; fi ;;
        Installing*) report "    unpacking" ;;
        esac
    done
}
if grep -q '^SETUP-FAILED$' "$log"; then
    tail -n 20 "$log" >&2
    fail "pip could not install requirements.lock; see $log for the complete output"
fi

report "3/3 install ParaUAV"
.venv/bin/python -m pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation -e .
pwd >.venv/setup-done
report "done"
