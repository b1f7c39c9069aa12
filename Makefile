# Everything here works from nothing but Python 3.11 or 3.12, make, and a package index.
# The environments (.venv, .venv-oldest) are made when needed and renewed when setup.py changes.
#
#   make PYTHON=/path/to/python3 ...    another Python than the one found
#   make test ARGS='-k savgol -x'       arguments for pytest; ARGS also goes to the demo

.DEFAULT_GOAL := help
SHELL := /bin/bash
ARGS ?=
VENV := .venv
BIN := $(VENV)/bin
OLDEST := .venv-oldest/bin
BAGS := identification validation static rubber
SIDE_BY_SIDE := --numprocesses auto --maxprocesses 8 --dist loadgroup

# What a sourced ROS, or the environment of another Python, leaves in the shell does not belong
# into these environments: they hold a ROS of their own.
ifneq ($(AMENT_PREFIX_PATH)$(_ROS_WHEELS_BOOTSTRAP_COMPLETE),)
unexport LD_LIBRARY_PATH
endif
unexport AMENT_PREFIX_PATH PYTHONHOME PYTHONPATH RMW_IMPLEMENTATION VIRTUAL_ENV
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Nor is Python kept from storing its bytecode: each of the many starts would take 1 s longer.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help
help:  ## show this list
	@sed -nE 's/^([a-z-]+):.*## (.*)/  make \1|\2/p' $(MAKEFILE_LIST) | column -t -s '|'

.PHONY: demo
demo: $(VENV)/demo-ready  ## identify a cup, then predict a second recording live over DDS
	@$(BIN)/python -m bellows_ros.demo $(ARGS)

.PHONY: test
test: $(VENV)/ready  ## run the whole suite
	@$(BIN)/python -m pytest $(SIDE_BY_SIDE) $(ARGS)

.PHONY: test-lanes
test-lanes: $(VENV)/ready  ## run the demo, installations, the commands of all pages and the benchmarks
	@$(BIN)/python -m pytest $(SIDE_BY_SIDE) -m 'lane and not stress' $(ARGS)

.PHONY: test-oldest
test-oldest: .venv-oldest/ready  ## run it on what Ubuntu 24.04 has, without numba
	@$(OLDEST)/python -m pytest $(SIDE_BY_SIDE) $(ARGS)

.PHONY: bench
bench: $(VENV)/ready  ## measure the speed, and print it
	@$(BIN)/python -m benchmarks $(ARGS)

.PHONY: bench-quick
bench-quick: $(VENV)/ready  ## whether something takes twice as long as it should, in a minute
	@$(BIN)/python -m benchmarks.quick

.PHONY: test-long
test-long: $(VENV)/ready  ## run what is too much for the suite: repetitions, rates, damaged files, long benchmarks
	@$(BIN)/python -m pytest -m stress $(ARGS)

.PHONY: lint
lint: $(VENV)/ready  ## ruff, the flake8 and pep257 rules of ament, mypy --strict, workflows
	@$(BIN)/ruff check --quiet .
	@$(BIN)/flake8
	@$(BIN)/mypy --no-error-summary
	@$(BIN)/check-jsonschema --quiet --builtin-schema vendor.github-workflows .github/workflows/ci.yml
	@$(BIN)/check-jsonschema --quiet --builtin-schema vendor.github-issue-forms .github/ISSUE_TEMPLATE/*.yml
	@echo 'lint: nothing found'

.PHONY: fix
fix: $(VENV)/ready  ## repair what ruff can repair
	@$(BIN)/ruff check --fix .

.PHONY: docs
docs: $(VENV)/docs-ready  ## build the pages in docs/ with Sphinx; warnings are errors
	@$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs
	@echo 'docs: build/docs/index.html'

.PHONY: count
count: $(VENV)/ready  ## print lines of code, modules, and words of the pages
	@$(BIN)/python docs/tools/count.py $(ARGS)

.PHONY: reference
reference: $(VENV)/ready  ## write docs/reference/ from the declarations
	@$(BIN)/python docs/tools/reference.py $(ARGS)

.PHONY: pictures
pictures: $(VENV)/ready  ## draw the pictures that no command on a page draws
	@$(BIN)/python docs/tools/pictures.py

.PHONY: pages
pages: $(VENV)/ready  ## run the commands on all pages, and write what they print and draw into them
	@$(BIN)/python docs/tools/pages.py

.PHONY: bags
bags: $(VENV)/ready  ## make the recordings in bags/ again
	@for bag in $(BAGS); do \
	    rm -rf build/bags/$$bag && mkdir -p build/bags && \
	    cup=$$(ls bags/cup.yaml bags/$${bag}_cup.yaml 2>/dev/null | tail -1) && \
	    $(BIN)/bellows simulate --params $$cup --motion bags/$$bag.yaml \
	        --out build/bags/$$bag && \
	    rm -rf bags/$$bag && mv build/bags/$$bag bags/$$bag || exit; \
	done

.PHONY: venv
venv: $(VENV)/ready  ## only make the environment

.PHONY: extras
extras: $(VENV)/extras-ready  ## add MuJoCo for its test

.PHONY: release
release: $(VENV)/ready  ## build sdist and wheel, install each in an empty environment, and use it
	@.ci/release $(BIN)/python

.PHONY: clean
clean:  ## remove the environments and all that was built
	@rm -rf .venv .venv-oldest build dist install log *.egg-info demo_output
	@rm -rf .coverage .hypothesis .mypy_cache .pytest_cache .ruff_cache
	@find bellows_ros benchmarks launch test -name __pycache__ -prune -exec rm -rf {} +

# Editable, so that the tests see the tree as it is; what an installation holds is tested too.
# 3.11 comes first because test-oldest is on 3.12.
$(BIN)/python:
	@python=$${PYTHON:-$$(.ci/find-python 3.11 3.12)} && \
	echo "Making $(VENV) with $$python, once" && \
	$$python -m venv $(VENV) || { rm -rf $(VENV); exit 1; }

$(VENV)/demo-ready: setup.py | $(BIN)/python
	@.ci/install $(BIN)/python 'what the demo needs' --editable '.[ros,fast,plot]'
	@touch $@

$(VENV)/ready: setup.py | $(BIN)/python
	@.ci/install $(BIN)/python 'what tests and lint need' \
	    --editable '.[ros,fast,plot,dask,test,lint]'
	@touch $@

$(VENV)/docs-ready: setup.py | $(VENV)/ready
	@.ci/install $(BIN)/python 'Sphinx' --editable '.[docs]'
	@touch $@

# What only some tests need, and is too heavy for everyone.
$(VENV)/extras-ready: setup.py | $(VENV)/ready
	@.ci/install $(BIN)/python 'MuJoCo' 'mujoco>=3.1'
	@touch $@

.venv-oldest/ready: setup.py .ci/oldest.txt
	@python=$${PYTHON:-$$(.ci/find-python 3.12)} && \
	echo "Making .venv-oldest with $$python" && $$python -m venv .venv-oldest
	@.ci/install $(OLDEST)/python 'what Ubuntu 24.04 has' \
	    --constraint .ci/oldest.txt --editable '.[ros,plot,test]'
	@touch $@
