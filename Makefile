# Two commands: `make run` and `make test`. Each sets up by itself; `make` alone explains.

PYTHON ?= python3
UP ?=
TESTS ?=
BIN := .venv/bin
LOCK := requirements.lock
BENCH_LOCK := requirements-bench.lock
DOCS_LOCK := requirements-docs.lock
RERUN_LOCK := requirements-rerun.lock
STAMP := .venv/setup-done
# The main path: contract, bus, gateway, twin, worker and page, a fleet of processes, a recorded flight, a diagnosis.
QUICK := tests/test_architecture.py tests/fleet/test_contract.py tests/fleet/test_bus.py \
  tests/fleet/test_wrong_inputs.py tests/fleet/simulator/test_pretend.py tests/fleet/telemetry/mavlink \
  tests/fleet/telemetry/test_recordings.py tests/gateway/test_gateway.py tests/twin_worker/twin/test_twin.py \
  tests/twin_worker/validation tests/twin_worker/prediction/test_predict.py tests/twin_worker/confidence/test_horizon.py \
  tests/twin_worker/service/test_worker.py tests/twin_worker/diagnosis/test_output_faults.py \
  tests/viewer/test_viewer.py tests/viewer/test_viewer_states.py tests/viewer/test_viewer_feed.py \
  tests/viewer/test_browser_sizes.py::test_all_places_of_the_page_show_what_the_bus_carries \
  tests/test_end_to_end.py::test_a_fleet_of_two_flies_answers_and_leaves_a_summary \
  tests/test_end_to_end.py::test_a_flight_of_another_autopilot_is_predicted_on_its_own_mission
# A suite starts hundreds of processes; without bytecode on disk each compiles its imports anew.
unexport PYTHONDONTWRITEBYTECODE
export PARAUAV_RECORDINGS ?= $(abspath ../shared/recordings)

# The stamp names the folder and the interpreter it was made for: a moved checkout sets up again.
ifneq ($(shell cat $(STAMP) 2>/dev/null && $(BIN)/python -c '' 2>&1),$(CURDIR))
STALE := stale
endif

.PHONY: help setup bench-setup run test test-quick lint docs browser lock clean stale

help:
	@echo "make run [UP='--uavs 8']    set up, then fly a fleet, twin it and show it; Ctrl-C ends it"
	@echo "make test [TESTS='…']       set up, then run every test, the browser's included"
	@echo "make test-quick             the main path end to end, in about a minute once everything is compiled"
	@echo "make setup                  only set up: packages into .venv, by version and hash"
	@echo "make lint                   ruff and mypy"
	@echo "make docs                   build the documentation into site/; the result works offline"
	@echo "make lock                   renew all locks after an edit of the dependencies"
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

# Four processes on two cores: tests of browsers and of fleets in real time wait much of their time.
test: setup browser
	@$(BIN)/python -m pytest -n 4 --dist loadfile $(TESTS)

test-quick: setup browser
	@$(BIN)/python -m pytest -n 4 --dist loadfile $(QUICK)

lint: setup
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

browser:
	@sh deploy/browser.sh

# Reference pages are generated from the code, then the site is built strictly and searched for external resources.
docs: setup .venv-docs/setup-done
	@$(BIN)/python -m docs.generate
	@NO_MKDOCS_2_WARNING=1 .venv-docs/bin/python -m mkdocs build --strict --quiet
	@$(BIN)/python -m docs.check_offline site
	@echo "documentation: site/index.html"

.venv-docs/setup-done: $(DOCS_LOCK)
	@$(PYTHON) -m venv --clear .venv-docs
	@.venv-docs/bin/python -m pip install -q --require-hashes -r $(DOCS_LOCK)
	@touch $@

COMPILE := .venv-lock/bin/pip-compile --allow-unsafe --generate-hashes --no-emit-options --no-header --no-annotate --strip-extras --quiet
LOCK_HEAD := \# Every package by version and hash, build backend included. Made from pyproject.toml by `make lock`; not by hand.

lock:
	@rm -rf .venv-lock && $(PYTHON) -m venv .venv-lock && .venv-lock/bin/pip install -q pip-tools
	@for pair in dev:$(LOCK) bench:$(BENCH_LOCK); do \
	  $(COMPILE) pyproject.toml --extra $${pair%:*} --all-build-deps --output-file $${pair#*:} || exit 1; \
	done
	@echo rotorpy | $(COMPILE) - --output-file .venv-lock/rotorpy.lock  # its own dependencies stay out, see pyproject.toml
	@sed -n '/^rotorpy==/,/[^\\]$$/p' .venv-lock/rotorpy.lock >> $(LOCK)
	@.venv-lock/bin/python -c "import tomllib; extras = tomllib.load(open('pyproject.toml', 'rb'))['project']; \
	  print(*extras['optional-dependencies']['docs'], sep='\n')" | $(COMPILE) - --output-file $(DOCS_LOCK)
	@echo rerun-sdk | $(COMPILE) - --constraint $(LOCK) --output-file $(RERUN_LOCK)  # the same numpy and pillow
	@sed -i -e '/^#/d' -e '1i $(LOCK_HEAD)' $(LOCK) $(BENCH_LOCK) $(DOCS_LOCK) $(RERUN_LOCK)
	@rm -rf .venv-lock

clean:
	@rm -rf .venv .venv-bench .venv-docs .venv-lock site build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
