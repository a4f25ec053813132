# `make up` runs the main job, `make test` passes the tests; both set up what they need on a bare machine.
PYTHON ?= python3
BIN := .venv/bin
# Three files of tests at a time, in the order of pyproject.toml: most wait for processes more than they compute.
PYTEST := $(BIN)/pytest --numprocesses 3 --dist loadfile --no-loadscope-reorder
STAMP := .venv/.installed
SET ?=
export PYOPENGL_PLATFORM ?= egl
export PYGLET_HEADLESS ?= 1

.PHONY: help setup system up test lint fast bench reference clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

setup: system $(STAMP)  ## virtual environment and system libraries

system:
	@PYTHON=$(PYTHON) ./scripts/system-libraries

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, this is " + sys.version.split()[0] + "; try: make PYTHON=python3.11")'
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt torch
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[stages,page,view,dev]'
	@touch $@

up: setup  ## the main job: show a tray, disturb it, get it back (SET="world.seed=3" changes settings)
	$(BIN)/runner up graph.yaml $(addprefix --set ,$(SET))

lint: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright
	$(BIN)/lint-imports

test: lint  ## format, lint, strict types, import layers and every test: what CI runs
	$(PYTEST)

fast: setup  ## the fast tests only
	$(PYTEST) -m 'not slow'

bench: setup  ## speed of the kernel
	$(BIN)/python -m benchmarks.kernel

reference: setup  ## record recordings/reference.mcap again: one small image through all of perception
	rm -rf build/reference build/reference-*
	$(BIN)/python -m benchmarks.clutter build/reference --scenes 1 --seed 5
	$(BIN)/runner up graphs/reference.yaml --recordings build
	rm -f recordings/reference.mcap
	$(BIN)/runner recover build/reference-*.mcap recordings/reference.mcap

clean:
	rm -rf .venv build .pytest_cache .ruff_cache
