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
	@echo "make peers             programs of other projects to compare with, into build/peers/ (NAV2=FOLDER: AMCL too)"

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
peers: build/peers/mrpt $(if $(NAV2),build/peers/amcl)
build/peers/mrpt: tools/peers/mrpt.cpp tools/peers/carmen_log.hpp
	@test -d /usr/include/mrpt/slam || { echo "MRPT is not here: apt-get install libmrpt-slam-dev"; exit 1; }
	@mkdir -p build/peers
	$(CXX) -std=c++17 -O2 $(MRPT_INCLUDES) -o $@ $< $(addprefix -lmrpt-,$(MRPT_LIBRARIES))

# NAV2 is the folder of nav2_amcl's sources (ros-navigation/navigation2, or the sources of PyPI's
# `amcl`). Its plugin macro, the one thing of ROS in them, says nothing here.
AMCL := $(abspath $(NAV2))
AMCL_SOURCES = $(wildcard $(addprefix $(AMCL)/src/,pf/pf*.c pf/eig3.c map/map.c map/map_range.c map/map_cspace.cpp \
  sensors/laser/laser.cpp sensors/laser/likelihood_field_model.cpp))
AMCL_VERSION = $(shell sed -nE 's|.*<version>(.*)</version>.*|nav2 \1|p; s|^Version: (.*)|nav2 in amcl \1|p' $(wildcard $(AMCL)/package.xml $(AMCL)/PKG-INFO))
build/peers/amcl: tools/peers/amcl.cpp tools/peers/carmen_log.hpp
	@test -d "$(AMCL)/include/nav2_amcl/pf" || { echo "NAV2=$(NAV2) is not the folder of nav2_amcl"; exit 1; }
	@mkdir -p build/peers/amcl.build/pluginlib && cd build/peers/amcl.build && rm -f *.o && \
	  echo '#define PLUGINLIB_EXPORT_CLASS(type, base)' > pluginlib/class_list_macros.hpp
	cd build/peers/amcl.build && $(CC) -O2 -w -DHAVE_DRAND48 -D_GNU_SOURCE -I$(AMCL)/include -c $(filter-out %_draw.c,$(filter %.c,$(AMCL_SOURCES)))
	$(CXX) -std=c++17 -O2 -DHAVE_DRAND48 -DNAV2_VERSION='"$(AMCL_VERSION)"' -Itools/peers -Ibuild/peers/amcl.build -isystem $(AMCL)/include -isystem $(AMCL) \
	  -o $@ $< $(filter %.cpp,$(AMCL_SOURCES)) build/peers/amcl.build/*.o -lm

clean:
	rm -rf .venv .uv site results/runs results/cache
