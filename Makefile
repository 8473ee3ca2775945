# Everything a newcomer types. The environment is made once, and again whenever pyproject.toml, the lock or the version
# of PYTHON changes.
PYTHON ?= python3
VENV   ?= .venv
LOCK   ?= constraints.txt
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready

# Set, it has each of a thousand child processes of the tests compile the whole package anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test unit coverage collected lint types bench bench-design bench-canopen bench-serve bench-stops bench-viewers bench-realtime bench-peers bench-fleet campaign \
	docs docs-figures docs-pictures walk mutants test-socketcan test-foreign test-latest test-pythons lock screenshots clean

demo: $(READY)
	@echo "commissioning a simulated arm: about a minute on an idle machine"
	$(BIN)/ident simulate

# What a machine lacks (README: system packages) is skipped with its reason; with CI=true it fails. Tests by the machine's
# clock use a quarter of a core, so that two files of them run at a time.
test: $(READY)
	$(MAKE) --jobs 4 --output-sync lint types docs coverage collected
	$(TESTS) -m "not campaign and not realtime" $(GUARD_TESTS:%=--ignore=%)
	$(BIN)/pytest -n 2 --dist loadfile -m "realtime and not campaign" $$(grep -rl "mark.realtime" tests --include "test_*.py")

# Four workers for two cores: tests that talk to processes of their own also wait.
TESTS := $(BIN)/pytest -n 4 --dist worksteal

unit: $(READY)
	$(TESTS) -m "not campaign and not slow and not realtime"

# Every branch of what stops an arm, by its own tests: less than all of them fails. One process ends before the type checker
# beside it does; each further one would spend three seconds on imports.
GUARDED := encoder_observer faults safety_monitor state_machine stop_trajectory
GUARD_TESTS := $(addprefix tests/motion/test_motion_, guard.py guard_motors.py guard_positions.py guard_table.py encoder_observer.py states.py stop.py drive_events.py)
coverage: $(READY)
	$(BIN)/pytest -m "not campaign" --cov-branch --cov-report=term-missing --cov-fail-under=100 \
		$(GUARDED:%=--cov=ident_service.motion.%) $(GUARD_TESTS)

# Beside the type checker, on the other core: else each worker of the tests compiles all of them at once.
collected: $(READY)
	$(BIN)/pytest --collect-only --quiet --quiet --no-summary >/dev/null

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

# The site: build/site/index.html opens without a server, and nothing of it comes from a network.
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# Figures that pages show, drawn from what the code computes; they are committed.
docs-figures: $(READY)
	$(BIN)/python tools/docs_figures.py

docs-pictures: $(READY)
	$(BIN)/python tools/docs_pictures.py

# What a newcomer does, in a clean clone, by the documents' own commands.
walk: $(READY)
	$(BIN)/python tests/documents/walk.py --clean README.md $(addprefix docs/,tutorial.md identify-recordings.md your-own-arm.md)

bench: $(READY)
	$(BIN)/python -m benchmarks

bench-design: $(READY)
	$(BIN)/python -m benchmarks.design

bench-canopen: $(READY)
	$(BIN)/python -m benchmarks.canopen

# The daemon's first page; stops while everything waits; and what ten viewers of the live page cost the loop.
bench-serve: $(READY)
	$(BIN)/python -m benchmarks.serve

bench-stops: $(READY)
	$(BIN)/python -m benchmarks.stops

bench-viewers: $(READY)
	$(BIN)/python -m benchmarks.viewers

# Ten tries each of two arms on emulated drives, by the machine's clock.
bench-realtime: $(READY)
	$(BIN)/python -m benchmarks.realtime

# The command beside the script that somebody would write instead.
bench-peers: $(READY)
	$(BIN)/python -m benchmarks.peers

# Two hundred recordings of twenty arms, on one and two processes: make bench-fleet FLEET="--data FOLDER" keeps them.
bench-fleet: $(READY)
	$(BIN)/python -m benchmarks.fleet $(FLEET)

# What takes too long for every change, once a night. The guest with the kernel's CAN emulates a processor for four minutes.
campaign: test-socketcan
	$(BIN)/pytest -m campaign --timeout 7200
	$(TESTS) -m "not campaign and not realtime" --hypothesis-profile campaign --timeout 7200
	$(MAKE) test-pythons

# Slips in the code that guards people, one at a time in a copy of the checkout: each must fail one of its tests.
mutants: $(VENV)/.mutants
	$(BIN)/python tests/mutants/run.py

# Over the kernel's CAN sockets: here where this kernel has them, else in a guest.
test-socketcan: $(READY)
	tests/socketcan/guest/run $(BIN)/python

# An independent CANopen stack on the emulated drives; needs node, and npm's registry once.
test-foreign: $(READY)
	cd tests/foreign_stack && npm ci --ignore-scripts --no-audit --no-fund
	$(BIN)/pytest tests/emulated_drives/test_drives_foreign_stack.py

# The newest of everything that pyproject.toml allows, in an environment of its own, made anew.
LATEST := .venv-latest
test-latest:
	rm -rf $(LATEST)
	$(MAKE) test VENV=$(LATEST) LOCK=

# Libraries differ from one version of Python to the next: the unit tests with each further one, in environments of their own.
PYTHONS := 3.12 3.13
test-pythons:
	for version in $(PYTHONS); do $(MAKE) unit VENV=.venv-$$version PYTHON=python$$version || exit; done

# One lock for all Python versions and machines, with the newest of everything.
lock: $(READY)
	$(PIP) --group lock
	$(BIN)/uv pip compile --quiet --upgrade --universal --python-version 3.11 --all-extras \
		--group dev --group build --group lock --annotation-style line --custom-compile-command "make lock" \
		--output-file constraints.txt pyproject.toml

# pip 25.3 is the first that holds build requirements to a lock.
# Without --no-compile, most of the time goes to modules that nothing here imports.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
$(READY): pyproject.toml $(LOCK)
	@echo "making $(VENV) with $$($(PYTHON) -V): one to three minutes"
	$(PYTHON) -m venv --clear $(VENV)
	$(PIP) --upgrade $(addprefix --constraint ,$(LOCK)) "pip>=25.3"
	$(PIP) $(addprefix --constraint ,$(LOCK)) $(addprefix --build-constraint ,$(LOCK)) --editable . --group dev
	$(PYTHON) -V >$@

ifneq ($(shell $(PYTHON) -V 2>&1),$(shell cat $(READY) 2>/dev/null))
.PHONY: $(READY)
endif

$(VENV)/.mutants: $(READY)
	$(BIN)/python -m pip install --quiet --group mutants
	touch $@

# Pictures of the daemon's pages for the documents; needs the system's Chromium and five minutes.
screenshots: $(READY)
	$(BIN)/python tools/screenshots.py

clean:
	rm -rf $(VENV) $(LATEST) .coverage .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist
