# Everything a newcomer types. The environment is made once and again whenever pyproject.toml changes.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready

.PHONY: demo test unit coverage lint types bench bench-design bench-canopen bench-serve bench-viewers campaign mutants test-socketcan test-foreign clean

demo: $(READY)
	$(BIN)/ident simulate

# The page's tests drive the system's Chromium (Debian: `apt install chromium`; or CHROMIUM=path), and skip without one.
test: lint types coverage
	$(BIN)/pytest -n 2 -m "not campaign and not realtime"
	$(BIN)/pytest -m "realtime and not campaign"

unit: $(READY)
	$(BIN)/pytest -n 2 -m "not campaign and not slow"

# Every branch of what stops an arm, by its own tests: less than all of them fails.
GUARDED := checks faults guard latch owed states stop told
coverage: $(READY)
	$(BIN)/pytest -m "not campaign and not slow" --cov-branch --cov-report=term-missing --cov-fail-under=100 \
		$(GUARDED:%=--cov=ident_service.motion.%) tests/motion/test_motion_guard.py \
		tests/motion/test_motion_guard_table.py tests/motion/test_motion_owed.py tests/motion/test_motion_states.py \
		tests/motion/test_motion_stop.py tests/motion/test_motion_told.py

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy

bench: $(READY)
	$(BIN)/python -m benchmarks

bench-design: $(READY)
	$(BIN)/python -m benchmarks.design

bench-canopen: $(READY)
	$(BIN)/python -m benchmarks.canopen

# The daemon's first page; and what ten viewers of the live page cost the loop.
bench-serve: $(READY)
	$(BIN)/python -m benchmarks.serve

bench-viewers: $(READY)
	$(BIN)/python -m benchmarks.viewers

campaign: $(READY)
	$(BIN)/pytest -m campaign --timeout 7200

# Slips in the code that guards people, one at a time in a copy of the checkout: each must fail one of its quick tests.
mutants: $(VENV)/.mutants
	$(BIN)/python tests/mutants/run.py

# Over the kernel's CAN sockets: here where this kernel has them, else in a guest.
test-socketcan: $(READY)
	tests/socketcan/guest/run $(BIN)/python

# An independent CANopen stack on the emulated drives; needs node, and npm's registry once.
test-foreign: $(READY)
	cd tests/foreign_stack && npm ci --ignore-scripts --no-audit --no-fund
	$(BIN)/pytest tests/pucks/test_pucks_foreign_stack.py

# pip 25.1 is the first to read dependency groups.
$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable . --group dev
	touch $@

$(VENV)/.mutants: $(READY)
	$(BIN)/python -m pip install --quiet --group mutants
	touch $@

clean:
	rm -rf $(VENV) .coverage .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist
