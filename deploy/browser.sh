#!/bin/sh
# Find a browser for the viewer's tests; install one if permitted, else print how. Called by `make test`.
set -eu

has_browser() {
    [ -n "${PARAUAV_CHROMIUM:-}" ] && return 0
    for name in chromium chromium-browser google-chrome google-chrome-stable; do
        if command -v "$name" >/dev/null; then return 0; fi
    done
    return 1
}

has_browser && exit 0
if command -v apt-get >/dev/null; then
    echo "browser: found none; trying apt-get install chromium"
    if [ "$(id -u)" = 0 ]; then as=; else as="sudo -n"; fi
    $as apt-get -qq update >/dev/null 2>&1 || true
    DEBIAN_FRONTEND=noninteractive $as apt-get -qq install -y chromium libegl-mesa0 libgl1-mesa-dri >/dev/null 2>&1 || true
fi
has_browser && exit 0
echo "browser: found none and cannot install one; the browser tests are skipped (with CI=1: fail)." >&2
echo "browser: install chromium (apt-get install chromium, dnf install chromium), or name one: PARAUAV_CHROMIUM=/path/to/chrome" >&2
