# `make demo` and `make test` are all that a newcomer needs; each sets up what it uses.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
# what has a target of its own
SHORT := not scenario and not soak and not sitl

.PHONY: help setup demo test scenarios sitl soak mutants check bench docs deb format clean
.DEFAULT_GOAL := help

help:  ## list the targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /  make \1\t/'

setup: $(STAMP)  ## make the virtual environment with pinned versions

$(STAMP): pyproject.toml constraints.txt hatch_build.py arm_companion/protocol/dialect/arm_companion.xml
	@echo "setting up $(VENV) (the first time takes about a minute)"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(PIP) install -c constraints.txt hatchling editables pymavlink
	@$(PIP) install --no-build-isolation -c constraints.txt -e '.[dev]'
	@touch $@

demo: $(STAMP)  ## fly a whole perch with the real daemon against the simulated world
	@$(BIN)/arm-companion sim perch --output build/demo || { test $$? -eq 75 \
		&& echo "flying it again in simulated time, which no load can disturb" \
		&& $(BIN)/arm-companion sim perch --simulated --output build/demo; }

test: $(STAMP)  ## run the tests: what has its own time on all cores, then what runs against the wall clock alone
	@$(BIN)/python -m pytest -n auto --dist loadfile -m 'not realtime and $(SHORT)'
	@$(BIN)/python -m pytest -m 'realtime and $(SHORT)'

scenarios: $(STAMP)  ## fly the longer scenarios in simulated time, build and install the Debian package
	@$(BIN)/python -m pytest -n auto --dist load -m 'scenario and not realtime'
	@$(BIN)/python -m pytest -m 'scenario and realtime'

sitl: $(STAMP)  ## fly the real flight stacks that ARM_COMPANION_ARDUPILOT_SITL and ARM_COMPANION_PX4_SITL name
	@test -n "$$ARM_COMPANION_ARDUPILOT_SITL$$ARM_COMPANION_PX4_SITL" || \
		{ echo "name your own SITL program first: see tests/sitl/README.md" >&2; exit 2; }
	@$(BIN)/python -m pytest --timeout 7200 -m sitl -s tests/sitl

soak: $(STAMP)  ## an hour of hostile traffic, ten minutes of bus, 10,000 questions to the mechanics: none may go wrong
	@$(BIN)/python -m pytest --timeout 7200 -m soak
	@$(BIN)/python -m tests.soak

mutants: $(STAMP)  ## put small faults into the mission and see that the tests notice (long; or MUTANTS='tries vigil --number 50')
	@nice $(BIN)/python -m tests.mutants $(MUTANTS)

check: $(STAMP)  ## lint, format, types and dependency directions
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

bench: $(STAMP)  ## measure speed as ratios beside peers; writes build/bench.json
	@OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/python -m tests.bench  # as `arm-companion` runs

docs: $(STAMP)  ## build the documentation in build/docs, and check its links
	@$(BIN)/python -m sphinx -b html -q -W --keep-going docs build/docs
	@echo "build/docs/index.html"

deb:  ## build a Debian package of the daemon in build, for this machine or with ARCH=arm64
	@systemd/deb.sh --output build $(if $(ARCH),--arch $(ARCH))

format: $(STAMP)  ## apply the formatter and the safe fixes
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

clean:  ## remove everything that was made
	@rm -rf $(VENV) build mutants .pytest_cache .mypy_cache .ruff_cache .hypothesis
