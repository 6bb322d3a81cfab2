# `make help` lists the targets. Settings: PYTHON=... (interpreter for the environments), ARGS=...
# (arguments for pytest, the demo or the figures).
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.ONESHELL:
.NOTPARALLEL:
.DEFAULT_GOAL := help
export PYTHON

# Three workers for two cores: tests over DDS wait for four fifths of their time.
TESTED := pytest -n 3 --dist worksteal
PROGRAMS := install/mr_damper_ros/lib/mr_damper_ros
STYLED := mr_damper_ros studies test scripts setup.py $(wildcard launch benchmarks doc examples)

.PHONY: help setup ready demo picture live thesis control truth config doc bench soak test test-noble test-wheel lint format clean distclean

help: ## List the targets
	@sed -nE 's/^([a-z-]+):[^#]*## (.*)/\1|\2/p' Makefile | while IFS='|' read -r name text; do
	  printf '  make %-12s %s\n' "$$name" "$$text"
	done

setup: ## Install what is missing and build both packages (a second call does nothing)
	@scripts/setup.bash tools

ready: # what programs need, without the tools for tests, checks and studies
	@scripts/setup.bash

demo: ready ## Play a bag to identifier and model, then show a table and figures
	@. ./env.bash
	exec $(PROGRAMS)/mr-damper demo $(ARGS)

picture: ready ## Draw doc/demo.png, the first picture of the README, with the demo
	@. ./env.bash
	$(PROGRAMS)/mr-damper demo --output build/demo
	cp build/demo/5.0mm_1Hz_1.5A.png doc/demo.png

live: ready ## Serve a page on which an emulated rig is identified, until Ctrl-C
	@. ./env.bash
	exec $(PROGRAMS)/mr-damper demo --live $(ARGS)

thesis: setup ## Reproduce the thesis' results into build/thesis/report.html (ARGS=--quick: two minutes)
	@. ./env.bash
	exec python -m studies thesis $(ARGS)

control: setup ## Compare controllers in a car: build/control/report.html
	@. ./env.bash
	exec python -m studies control $(ARGS)

truth: setup ## Compare the force laws on recordings and a benchmark: build/truth/report.html
	@. ./env.bash
	exec python -m studies truth $(ARGS)

config: setup ## Write config/*.yaml from the options of the nodes
	@. ./env.bash
	python -m scripts.write_config

doc: ## Build the documentation into build/doc/index.html; warnings are errors
	@scripts/setup.bash doc
	exec env -u PYTHONPATH .venv-doc/bin/python -m sphinx -W --keep-going -q \
	  -d build/doc-cache doc build/doc $(ARGS)

bench: setup ## Measure accuracy and speed; writes build/bench.json
	@. ./env.bash
	exec python -m benchmarks.bench $(ARGS)

soak: setup ## Test killed and interrupted nodes, hostile data, hours of streams (90 minutes): build/soak.json
	@. ./env.bash
	exec python -m benchmarks.bench --soak $(ARGS)

test: setup ## Run all tests: core, packaging, and nodes over real DDS
	@. ./env.bash
	export ROS_PYTHON_CHECK_FIELDS=1 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST
	unset PYTHONDONTWRITEBYTECODE # otherwise hundreds of processes would each compile their imports
	exec python -m $(TESTED) $(ARGS)

test-noble: ## Run the core tests with the package versions of Ubuntu 24.04, without ROS
	@scripts/setup.bash noble
	exec env -u PYTHONPATH -u PYTHONDONTWRITEBYTECODE .venv-noble/bin/python -m $(TESTED) test/core $(ARGS)

test-wheel: ## Build the wheel and test it in an empty environment, without ROS
	@scripts/try_wheel.bash

lint: setup ## Check style, types and the package.xml files
	@. ./env.bash
	ruff check $(STYLED)
	ruff format --check $(STYLED)
	mypy
	python scripts/check_package_xml.py package.xml msg_defs/package.xml

format: setup ## Format the code for `make lint`
	@. ./env.bash
	ruff check --fix $(STYLED)
	ruff format $(STYLED)

clean: ## Remove build results
	@rm -rf build install log doc/generated .setup.lock .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find mr_damper_ros studies test scripts -name __pycache__ -prune -exec rm -rf {} +

distclean: clean ## Also remove the environments
	@rm -rf .venv .venv-noble .venv-doc
