# `make help` lists the targets. A target that needs `make setup` runs it first.
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

# Keep bytecode, whatever the environment says: tests start hundreds of routers.
unexport PYTHONDONTWRITEBYTECODE

# To choose the interpreter or an installed ROS: make setup PYTHON=python3.12 ROS=/opt/ros/jazzy
# To leave out what only developers need: make setup DEV=no
export PYTHON ROS DEV

# The ROS wheels set this once their libraries are set up; a value inherited from another environment is wrong here.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE

# Sources the installed ROS; does nothing if ROS comes from wheels.
ENV := . .venv/env.sh &&

.PHONY: help setup tools install-service test test-all demo bench pictures docs validate lint dist clean

help:  ## this list
	@sed -n 's/^\([a-z-]*\):[^#]*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 17

setup:  ## build .venv with the router, ROS 2 Jazzy and the comms interfaces; repeats only what changed
	@deploy/setup.sh

tools: setup
	@test -x .venv/bin/pytest || { echo "make: tools for developers are missing: run 'make setup DEV=yes'" >&2; exit 1; }

install-service:  ## install router and gateways as systemd services, with sudo; TABLE=... GATEWAYS=...|none for others
	@deploy/install-service.sh $(or $(TABLE),$(if $(GATEWAYS),routes/rover-router.yaml)) $(GATEWAYS)

# By file, because the tests of a file share what they start, in the order of tests/conftest.py. Many tests wait, so there
# may be more processes than cores. If a worker dies, the run ends: pytest-xdist would wait forever for its remaining
# tests (issue 1378 of pytest-xdist).
PYTEST = .venv/bin/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

# Runs the carrier's tests on a library built with sanitizers. Python itself leaks, so leaks are not detected.
SANITIZED = CARRIER_TESTED_WITH_SANITIZERS=1 LD_PRELOAD=$$(gcc -print-file-name=libasan.so) \
	ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1

test: tools  ## run the router's tests except slow ones; TESTS=tests/net for some. For your tables: make validate
	@$(ENV) $(PYTEST) -m "not slow" $(TESTS)

test-all: tools  ## run all tests, including slow ones, and the carrier's again with sanitizers
	@$(ENV) HYPOTHESIS_PROFILE=full $(PYTEST) $(TESTS)
	@$(ENV) $(SANITIZED) $(PYTEST) -m "not slow" $(or $(TESTS),tests/carrier)

demo: setup  ## simulated rover, router and real ROS nodes; a lost link brakes the rover
	@$(ENV) .venv/bin/python -m demo

bench: tools  ## measure all figures and write them into README and docs, about two hours on an idle computer, as root
	@$(ENV) .venv/bin/python -m benchmarks.versus
	@$(ENV) .venv/bin/python -m benchmarks.pressure --seconds 5 --repeat 3
	@.venv/bin/python docs/generate.py

pictures: tools  ## take the pictures of the README and the documentation from the running program, with Chromium
	@$(ENV) .venv/bin/python -m docs.pictures.make $(ARGS)

validate: setup  ## check the tables in routes/ and run their tests
	@$(ENV) .venv/bin/router validate routes/
	@$(ENV) .venv/bin/router test --coverage routes/

docs: tools  ## build the documentation into build/docs; fails on a dead link or a page that no menu has
	@.venv/bin/python -m sphinx -q -E -W --keep-going -b html docs build/docs
	@echo build/docs/index.html

lint: tools  ## run ruff, mypy and the C compiler's warnings
	@.venv/bin/ruff check
	@$(ENV) .venv/bin/python router/carrier/build.py --rcl --lint
	@$(ENV) .venv/bin/mypy

dist: tools  ## build sdist and wheel of the last commit into dist/, and check them with each Python found here
	@$(ENV) deploy/dist.sh

clean:  ## remove .venv and everything that tools generated
	rm -rf .venv router/carrier/native/libcarrier.so router/declared.py build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
