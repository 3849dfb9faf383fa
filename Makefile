# Two commands set everything up on a fresh Debian machine: `make demo` and `make test`.
PYTHON ?= python3.11
VENV   := .venv
BIN    := $(VENV)/bin
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
# Kept bytecode halves pytest's collection (25 s to 13 s of CPU per worker); an environment may forbid it, this one does not.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help setup wheel wheel-arm64 demo test test-live test-long test-all check lint docs coverage mutants fuzz bench soak lab-kernel clean

help:  ## show this list
	@awk -F':.*## ' '/^[a-z0-9-]+:.*## /{printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

$(VENV)/.ready: pyproject.toml constraints.txt deploy/setup.sh
	@PYTHON=$(PYTHON) sh deploy/setup.sh $(VENV)
	@touch $@

setup: $(VENV)/.ready  ## create the virtual environment

wheel: setup  ## a wheel for this platform with the compiled tick, in dist/
	@TIMBERHAND_COMPILE=1 $(BIN)/python -m pip wheel --no-deps --no-build-isolation -w dist .

wheel-arm64: setup  ## the same for arm64, cross-compiled
	@sh deploy/debian_packages.sh gcc-aarch64-linux-gnu libc6-dev-arm64-cross
	@sh deploy/arm64/build.sh dist

demo: setup  ## a log goes from the ground into the bunk over CAN; ARGS="--lockstep", ARGS="--bus vcan", ...
	@$(BIN)/timberhand demo $(ARGS)

# Fast tests that start a process or hold a limit by the real clock: they run with the live ones.
TIMED := $(addprefix tests/,autonomy/test_autonomy_process.py autonomy/test_calibration_live.py autonomy/test_planner_process.py \
    can_dbc/test_bus_fast_path.py console/test_console.py console/test_mission_state.py console/test_plant_view.py \
    hil/test_bus_contract.py hil/test_bus_daemon.py hil/test_wire_daemon.py hil/test_wirebus.py recorder/test_recover.py \
    recorder/test_stop_process.py runtime/test_allocator.py runtime/test_huge_pages.py sim/test_camera_server.py sim/test_plant_process.py)
FAST  := -m "not slow" -n 2 --dist worksteal $(addprefix --ignore=,$(TIMED))

test: lint  ## lint, types, architecture and the tests that no other load can disturb; before every push
	@$(BIN)/pytest $(FAST) $(ARGS)

test-live: setup  ## every test that starts processes: runs on the wire and on vcan, services, the real-time kernel
	@sh deploy/debian_packages.sh
	@$(BIN)/pytest -m "not slow" $(TIMED) $(ARGS) || [ $$? -eq 5 ]
	@$(BIN)/pytest -m "slow and not computed" $(ARGS) || [ $$? -eq 5 ] # 5: ARGS name no such test

test-long: setup docs coverage  ## long runs in virtual time, the documentation site, branch coverage of supervisor and guard
	@$(BIN)/pytest -m "slow and computed" -n 2 --dist worksteal $(ARGS)

test-all: test test-long test-live  ## the three

check: lint  ## lint, types, architecture and the fast tests
	@$(BIN)/pytest -q $(FAST) $(ARGS)

lint: setup  ## style, types and the three floors
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-cache

docs: setup  ## build the site into docs/_build; broken links and stale reference pages are errors
	@$(BIN)/python -m timberhand.reference --check
	@$(BIN)/sphinx-build -W --keep-going -q docs docs/_build && echo "docs/_build/index.html"

coverage: setup  ## branch coverage of supervisor and guard by their own tests; below 100 % is an error
	@$(BIN)/python -m tests.branch_coverage

mutants: setup  ## change supervisor and guard a thousand times, see their tests fail, write docs/results/mutants.json
	@$(BIN)/python -m tests.mutation $(ARGS)

fuzz: setup  ## random frames, datagrams, answers and files for 20 s each; ARGS="--units 1000000", "--target NAME"
	@$(BIN)/python -m tests.fuzz $(ARGS)

bench: setup  ## measure: codecs beside cantools, the tick compiled and not, the bus beside python-can, the plant against real time
	@$(BIN)/timberhand bench codec $(ARGS)
	@$(BIN)/timberhand compile
	@$(BIN)/timberhand bench tick
	@$(BIN)/timberhand bench bus $(ARGS)
	@$(BIN)/timberhand bench plant $(ARGS)

soak: setup  ## half an hour at the control rate on vcan: nothing may grow, no frame may be lost
	@sh deploy/debian_packages.sh
	@$(BIN)/timberhand experiment soak --bus vcan $(ARGS)

lab-kernel:  ## build the vcan lab's own kernel with simulated time, once (minutes, optional)
	@sh deploy/lab_kernel/build.sh

clean:  ## remove the virtual environment and everything generated
	rm -rf $(VENV) build docs/_build dist runs *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
