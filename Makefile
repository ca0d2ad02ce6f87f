# Two commands: `make run` and `make test`. Each sets up by itself; `make` alone explains.

PYTHON ?= python3
UP ?=
TESTS ?=
BIN := .venv/bin
LOCK := requirements.lock
BENCH_LOCK := requirements-bench.lock
STAMP := .venv/setup-done
export PARAUAV_RECORDINGS ?= $(abspath ../shared/recordings)

# The stamp names the folder and the interpreter it was made for: a moved checkout sets up again.
ifneq ($(shell cat $(STAMP) 2>/dev/null && $(BIN)/python -c '' 2>&1),$(CURDIR))
STALE := stale
endif

.PHONY: help setup bench-setup run test lint browser lock clean stale

help:
	@echo "make run [UP='--uavs 8']    set up, then fly a fleet, twin it and show it; Ctrl-C ends it"
	@echo "make test [TESTS='…']       set up, then run every test, the browser's included"
	@echo "make setup                  only set up: packages into .venv, by version and hash"
	@echo "make lint                   ruff and mypy"
	@echo "make lock                   renew both locks after an edit of the dependencies"
	@echo "make bench-setup            the packages ParaUAV is measured against, into .venv-bench"
	@echo "make clean                  remove .venv and everything else that was made"

setup: $(STAMP)

$(STAMP): $(LOCK) pyproject.toml $(STALE)
	@PYTHON="$(PYTHON)" sh deploy/setup.sh

# An environment of its own: some peers hold numpy, scipy and jax back at older versions.
bench-setup:
	@$(PYTHON) -m venv --clear .venv-bench
	@.venv-bench/bin/pip install -q --require-hashes -r $(BENCH_LOCK)
	@.venv-bench/bin/pip install -q --no-deps --no-build-isolation -e .
	@echo "python -m tests.bench.identification: start it with .venv-bench/bin/python; Octave (octave-control) adds moen4"

run: setup
	@exec $(BIN)/fleet up $(UP)

test: setup browser
	@$(BIN)/python -m pytest -n 2 --dist loadfile $(TESTS)

lint: setup
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

browser:
	@sh deploy/browser.sh

lock:
	@rm -rf .venv-lock && $(PYTHON) -m venv .venv-lock && .venv-lock/bin/pip install -q pip-tools
	@for pair in dev:$(LOCK) bench:$(BENCH_LOCK); do \
	  .venv-lock/bin/pip-compile pyproject.toml --extra $${pair%:*} --all-build-deps --allow-unsafe --generate-hashes \
	    --no-emit-options --no-header --no-annotate --strip-extras \
	    --quiet --output-file $${pair#*:} || exit 1; \
	  sed -i -e '/^#/d' -e '1i # Every package by version and hash, build backend included. Made from pyproject.toml by `make lock`; not by hand.' $${pair#*:}; \
	done
	@rm -rf .venv-lock

clean:
	@rm -rf .venv .venv-bench .venv-lock build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
