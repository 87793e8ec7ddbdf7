# `make help` says what there is. Everything needs `make setup`, and starts it.
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

# Bytecode is kept, whatever the environment says: tests start hundreds of routers.
unexport PYTHONDONTWRITEBYTECODE

# To use an interpreter or an installed ROS other than those found: make setup PYTHON=python3.12 ROS=/opt/ros/jazzy
# Without what only developers need: make setup DEV=no
export PYTHON ROS DEV

# By this the wheels know that their libraries are set up; inherited from another environment it is not true here.
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE

# Says what must be sourced; nothing at all unless ROS comes from outside .venv.
ENV := . .venv/env.sh &&

.PHONY: help setup tools install-service test test-all demo bench pictures docs validate lint dist clean

help:  ## this list
	@sed -n 's/^\([a-z-]*\):[^#]*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 17

setup:  ## build .venv with the router, ROS 2 Jazzy and the comms interfaces; what is up to date stays
	@deploy/setup.sh

tools: setup
	@test -x .venv/bin/pytest || { echo "make: tools for developers are missing: run 'make setup DEV=yes'" >&2; exit 1; }

install-service:  ## install the router as a systemd service and start it, with sudo; TABLE=... for another table
	@deploy/install-service.sh $(TABLE)

# By files, since the tests of one share what they start, in the order of tests/conftest.py. Many of them wait: more
# processes than cores.
# If one dies the run ends there: pytest-xdist would wait for ever for what it had left (its issue 1378).
PYTEST = .venv/bin/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

# For tests of the carrier on a library that finds what C forgives. Python itself leaks on purpose.
SANITIZED = CARRIER_TESTED_WITH_SANITIZERS=1 LD_PRELOAD=$$(gcc -print-file-name=libasan.so) \
	ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1

test: tools  ## run the tests of the router but the slow ones; TESTS=tests/wire for some. Your tables: make validate
	@$(ENV) $(PYTEST) -m "not slow" $(TESTS)

test-all: tools  ## run every test, also the slow ones; the carrier's with sanitizers too
	@$(ENV) HYPOTHESIS_PROFILE=full $(PYTEST) $(TESTS)
	@$(ENV) $(SANITIZED) $(PYTEST) -m "not slow" $(or $(TESTS),tests/carrier)

demo: setup  ## simulated rover, router and real ROS nodes; in between, a lost link halts the rover
	@$(ENV) .venv/bin/python -m demo

bench: tools  ## measure the router beside the C++ node, about an hour; ARGS="--only own_table --repeat 3" for less
	@$(ENV) .venv/bin/python -m benchmarks.versus $(ARGS)
	@.venv/bin/python docs/generate.py

pictures: tools  ## take the pictures of README and documentation from the running program, with Chromium
	@$(ENV) .venv/bin/python -m docs.pictures.make $(ARGS)

validate: setup  ## say what is wrong with the tables in routes/, and prove them
	@$(ENV) .venv/bin/router validate routes/
	@$(ENV) .venv/bin/router test --coverage routes/

docs: tools  ## build the documentation into build/docs; a dead link or a page without a place fails
	@.venv/bin/python -m sphinx -q -E -W --keep-going -b html docs build/docs
	@echo build/docs/index.html

lint: tools  ## ruff, mypy, and what the C compiler warns of
	@.venv/bin/ruff check
	@$(ENV) .venv/bin/python router/carrier/build.py --rcl --lint
	@$(ENV) .venv/bin/mypy

dist: tools  ## build sdist and wheel of the last commit into dist/, and try them with each Python found here
	@$(ENV) deploy/dist.sh

clean:  ## remove .venv and what tools left behind
	rm -rf .venv router/carrier/native/libcarrier.so router/declared.py build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
