# Two commands set everything up on a fresh Debian machine: `make demo` and `make test`.
PYTHON ?= python3.11
VENV   := .venv
BIN    := $(VENV)/bin
KEY    ?= $(HOME)/.config/timberhand/signing-key.pem
WHEEL  ?=
export WHEEL
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
# Kept bytecode halves pytest's collection (25 s to 13 s of CPU per worker); an environment may forbid it, this one does not.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help setup wheel wheel-arm64 bundle deb sbom lock audit demo test check test-live test-long test-all lint docs mutants fuzz bench results soak lab-kernel clean

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

bundle: setup  ## a signed release without need of a network, in dist/; KEY=FILE signs, WHEEL=FILE takes another wheel
	@[ "$(WHEEL)" ] || $(MAKE) wheel
	@$(BIN)/timberhand release bundle "$${WHEEL:-$$(ls -t dist/timberhand-*-linux_x86_64.whl | head -n 1)}" --key "$(KEY)" $(ARGS)

deb: setup  ## a Debian package of the newest bundle in dist/; KEY=FILE as for the bundle
	@bundle=$$(ls -t dist/timberhand-*.tar 2>/dev/null | head -n 1); \
	    sh deploy/deb/build.sh "$$bundle" "$(dir $(KEY))signer.pem"

sbom: setup  ## every package of this environment with its licence, as CycloneDX, in dist/
	@mkdir -p dist
	@$(BIN)/python -m cyclonedx_py environment $(VENV) --pyproject pyproject.toml --output-reproducible -o dist/sbom.cdx.json
	@echo dist/sbom.cdx.json

lock: setup  ## versions and hashes of what an installation fetches, from constraints.txt, into deploy/lock
	@sh deploy/lock.sh $(BIN)/python

audit: setup  ## insecure code (bandit), and published weaknesses of the packages (pip-audit, asks PyPI)
	@sh deploy/audit.sh $(BIN)/python

demo: setup  ## a log goes from the ground into the bunk over CAN; ARGS="--lockstep", ARGS="--bus vcan", ...
	@$(BIN)/timberhand demo $(ARGS)

test: setup  ## lint, types, architecture, and every test that no load on this computer can disturb; before every push
	@sh deploy/phases.sh $(BIN) test $(ARGS)

check: setup  ## the same without the pages of the documentation and without coverage: before every commit
	@sh deploy/phases.sh $(BIN) check $(ARGS)

test-live: setup lab-kernel  ## every test that starts processes: runs on the wire and on vcan, services, browser, real time
	@sh deploy/debian_packages.sh
	@sh deploy/phases.sh $(BIN) live $(ARGS)

test-long: setup  ## long runs in virtual time, fuzzing, and mutants of the safety layer
	@sh deploy/phases.sh $(BIN) long $(ARGS)

test-all: test test-long test-live  ## the three

lint: setup  ## style, types and the three floors
	@sh deploy/phases.sh $(BIN) lint

docs: setup  ## build the site into docs/_build; generated reference pages; broken links are errors
	@$(BIN)/python -m timberhand.reference --check
	@$(BIN)/sphinx-build -W --keep-going -q docs docs/_build && echo "docs/_build/index.html"

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

results: setup  ## every experiment anew, with its page; says first how many hours; ARGS="--workers 8"
	@$(BIN)/timberhand experiment all --docs docs $(ARGS)

soak: setup  ## half an hour at the control rate on vcan: nothing may grow, no frame may be lost
	@sh deploy/debian_packages.sh
	@$(BIN)/timberhand experiment soak --bus vcan $(ARGS)

lab-kernel:  ## build the vcan lab's own kernel with simulated time, once (minutes, optional)
	@sh deploy/lab_kernel/build.sh

clean:  ## remove the virtual environment and everything generated
	rm -rf $(VENV) build docs/_build dist runs *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
