# Two commands: `make reproduce` and `make test`. Each sets up what it needs.
PYTHON ?= python3
ESTIMA := .venv/bin/estima
FULL ?= 0
EXTRAS ?=

.PHONY: help setup reproduce report test test-all lint types format docs lock peers clean

help:
	@echo "make reproduce         rows of the judged tables made again; figures and claims from them"
	@echo "make reproduce FULL=1  every row again, into results/"
	@echo "make report            the page of results/, results/report.html"
	@echo "make test              the default tests"
	@echo "make test-all          the slow ones too"
	@echo "make setup EXTRAS=tune,peers  optional packages; docs/install.md lists them"
	@echo "make lint types        what a change must pass besides"
	@echo "make docs              the documentation, into site/"
	@echo "make peers             programs of other projects to compare with, into build/peers/"

setup:
	@$(PYTHON) tools/bootstrap.py $(EXTRAS)

reproduce: setup
	@$(ESTIMA) reproduce $(if $(filter-out 0,$(FULL)),--full)

report: setup
	@$(ESTIMA) report

test: setup
	@.venv/bin/python -m pytest -n 2

test-all: setup
	@.venv/bin/python -m pytest -n 2 -m "slow or not slow"

lint: setup
	@.venv/bin/ruff check .
	@.venv/bin/ruff format --check .

types: setup
	@.venv/bin/mypy

format: setup
	@.venv/bin/ruff check --fix .
	@.venv/bin/ruff format .

docs: setup
	@NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --strict --quiet
	@echo "site/index.html"

# Rewrites the lock after a change of pyproject.toml; hashes only, no addresses.
lock: setup
	@.uv/bin/uv pip compile pyproject.toml --extra dev --extra docs --generate-hashes --no-emit-index-url \
	  --no-header --no-annotate --universal --python-version 3.11 --quiet --output-file requirements.lock

# MRPT's libraries are Debian's libmrpt-slam-dev; the estimators mrpt_* run the program.
MRPT_INCLUDES := $(addprefix -isystem ,$(wildcard /usr/include/mrpt/*/include)) -isystem /usr/include/eigen3
MRPT_LIBRARIES := slam containers maps obs poses math tfest bayes random config rtti io serialization system core
peers: build/peers/mrpt
build/peers/mrpt: tools/peers/mrpt.cpp
	@test -d /usr/include/mrpt/slam || { echo "MRPT is not here: apt-get install libmrpt-slam-dev"; exit 1; }
	@mkdir -p build/peers
	$(CXX) -std=c++17 -O2 $(MRPT_INCLUDES) -o $@ $< $(addprefix -lmrpt-,$(MRPT_LIBRARIES))

clean:
	rm -rf .venv .uv site results/runs results/cache
