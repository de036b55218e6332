# SPDX-License-Identifier: Apache-2.0
# Runs, tests and checks the package on a machine that has Python >= 3.11 and make, ROS or not.
# Everything is installed into $(VENV); what, and in which versions, says setup.py.

PYTHON ?= python3
VENV ?= .venv
SCENE ?= cusp
LOGS ?= logs
ARGS ?=
TESTS ?= test

MAKEFLAGS += --no-builtin-rules
.SUFFIXES:
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help run test stress performance benchmark docs dependencies lint build clean check-scene \
    FORCE

# DDS stays on this machine: by default it would ask the whole network.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
RUN_DOMAIN_ID := $(or $(ROS_DOMAIN_ID),77)

# The ROS of the virtual environment is the one that runs, whatever shell this was started in.
# The wheels set a guard and LD_LIBRARY_PATH for their own children; another environment's are
# wrong here.  So are the paths of a sourced ROS installation.
ifneq ($(_ROS_WHEELS_BOOTSTRAP_COMPLETE)$(AMENT_PREFIX_PATH),)
unexport LD_LIBRARY_PATH
endif
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONPATH PYTHONHOME VIRTUAL_ENV ROS_DISTRO
export AMENT_PREFIX_PATH := $(abspath $(VENV))
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
export PYTHONUNBUFFERED := 1

PIP := '$(VENV)/bin/python' -m pip --disable-pip-version-check install --quiet --quiet
SCENES := $(sort $(basename $(notdir $(wildcard config/*.yaml))))
# Folders too: their time tells of a file that is gone.
SOURCES := $(shell find setup.py setup.cfg package.xml config launch resource rviz \
    scripts spinning_top_sim urdf -name __pycache__ -prune -o \( -type f -o -type d \) \
    ! -name '.*' ! -name '*~' -print 2>/dev/null)

help:
	@echo 'make run     simulate the scene config/SCENE.yaml until Ctrl-C, recording into $(LOGS)/'
	@echo '             SCENE=$(SCENE)  (of: $(SCENES))'
	@echo '             ARGS=...  more arguments, such as ARGS="-p time_scale:=0.5 -r __ns:=/top"'
	@echo 'make test    run the tests;  TESTS=... picks some, ARGS=... is for pytest'
	@echo 'make stress  200 recording nodes killed (KILLS=...), then 100 000 random tops (STRESS=...)'
	@echo '             through both solvers: an hour'
	@echo 'make performance  docs/performance.md: node, start, a long run, solvers, simulate (an hour'
	@echo '             and a half, in an environment of its own, .venv-benchmark)'
	@echo 'make benchmark  that, and accuracy, stability and cost beside other programs, and the'
	@echo '             noise of the IMU, into docs/ (three hours)'
	@echo 'make docs    write the interface page, the plain URDF and the pictures anew'
	@echo 'make lint    ruff and mypy'
	@echo 'make build   build with colcon in a temporary workspace, run and test what was installed'
	@echo 'make clean   remove $(VENV) and caches; logs stay'
	@echo
	@echo 'PYTHON=$(PYTHON)  the interpreter (3.11 or newer)   VENV=$(VENV)  where to install'

run: export ROS_DOMAIN_ID := $(RUN_DOMAIN_ID)
run: check-scene $(VENV)/.deps-plot $(VENV)/.package
	@mkdir -p '$(LOGS)'
	@echo 'Scene $(SCENE), recording into $(LOGS)/, until Ctrl-C. To listen from another terminal of'
	@echo 'this machine:  export ROS_DOMAIN_ID=$(RUN_DOMAIN_ID)' \
	    'ROS_AUTOMATIC_DISCOVERY_RANGE=$(ROS_AUTOMATIC_DISCOVERY_RANGE)'
	@exec '$(VENV)/bin/sim_node' --ros-args --params-file 'config/$(SCENE).yaml' \
	    -p record.enabled:=true -p 'record.uri:=$(LOGS)/' $(ARGS)

check-scene:
	@test -f 'config/$(SCENE).yaml' || { \
	    echo 'There is no scene "$(SCENE)" (config/$(SCENE).yaml). There are: $(SCENES)' >&2; exit 2; }

dependencies: $(VENV)/.deps-test $(VENV)/.package

# `pytest`, not `python -m pytest`: what is tested is the installed package.
test: dependencies
	'$(VENV)/bin/pytest' $(TESTS) $(ARGS)

STRESS ?= 100000
KILLS ?= 200
stress: dependencies
	KILLS=$(KILLS) '$(VENV)/bin/pytest' -q test/test_kill.py
	'$(VENV)/bin/python' test/stress.py $(STRESS)

# Peers need hundreds of megabytes that the package does not: they have their own environment.
benchmark performance: export OMP_NUM_THREADS ?= 1
benchmark performance: export OPENBLAS_NUM_THREADS ?= 1
performance:
	@$(MAKE) --no-print-directory VENV=.venv-benchmark .venv-benchmark/.package \
	    .venv-benchmark/.peers
	.venv-benchmark/bin/python benchmark/node_cpu.py
	.venv-benchmark/bin/python benchmark/wake_up.py
	.venv-benchmark/bin/python benchmark/startup.py
	.venv-benchmark/bin/python benchmark/solvers.py
	.venv-benchmark/bin/python benchmark/offline.py --hour
	.venv-benchmark/bin/python benchmark/offline_scaling.py --long
	.venv-benchmark/bin/python benchmark/compression.py
	.venv-benchmark/bin/python benchmark/soak.py

benchmark: performance
	.venv-benchmark/bin/python benchmark/heavy_top.py
	.venv-benchmark/bin/python benchmark/exact_cost.py
	.venv-benchmark/bin/python benchmark/gauge.py
	.venv-benchmark/bin/python benchmark/stability.py
	.venv-benchmark/bin/python benchmark/work_precision.py
	.venv-benchmark/bin/python benchmark/allan.py
	.venv-benchmark/bin/python benchmark/attitude_filter.py

$(VENV)/.peers: $(wildcard benchmark/requirements*.txt) $(VENV)/.deps-test
	@echo 'Installing into $(VENV) what the benchmarks compare with'
	@$(PIP) -r benchmark/requirements.txt
	@$(PIP) -r benchmark/requirements-built.txt || \
	    echo 'numbalsoda is not compared: its source needs CMake and a Fortran compiler'
	@touch '$@'

docs: $(VENV)/.deps-plot $(VENV)/.deps-test $(VENV)/.package
	'$(VENV)/bin/python' docs/interface.py
	'$(VENV)/bin/python' docs/urdf.py
	'$(VENV)/bin/python' docs/figures.py

lint: $(VENV)/.deps-test $(VENV)/.deps-lint $(VENV)/.package
	'$(VENV)/bin/ruff' check . scripts/*
	'$(VENV)/bin/mypy'

build: $(VENV)/.deps-colcon $(VENV)/.deps-test $(VENV)/.package
	.ci/colcon-build '$(VENV)'

clean:
	test ! -e '$(VENV)/.made' || rm -rf '$(VENV)'
	rm -rf .mypy_cache .pytest_cache .ruff_cache
	find $(wildcard benchmark examples launch spinning_top_sim test) -name __pycache__ -prune \
	    -exec rm -rf {} +

# Made anew when it is of another Python than the one asked for, was moved, was left half made or
# does not run.  An environment that someone else made is used as it is, or left alone.
PROBE := import sys; print("Python %d.%d" % sys.version_info[:2]); sys.exit(sys.version_info < (3, 11))
ASKED := $(filter command environment,$(firstword $(origin PYTHON)))
$(VENV)/.made: FORCE
	@there=$$('$(VENV)/bin/python' -c '$(PROBE)' 2>/dev/null) || there=; \
	made=$$(cat '$@' 2>/dev/null) || made=; \
	wanted=$$there; \
	if [ -n '$(ASKED)' ] || [ -z "$$there" ]; then \
	    wanted=$$($(PYTHON) -c '$(PROBE)' 2>&1) || { \
	        echo 'Python 3.11 or newer is needed, and PYTHON=$(PYTHON) is not that:' "$$wanted" >&2; \
	        exit 1; }; \
	fi; \
	if [ "$$there" = "$$wanted" ] && [ "$$made" = '$(abspath $(VENV))' ]; then exit 0; fi; \
	if [ -z "$$made" ] && [ -e '$(VENV)' ]; then \
	    if [ "$$there" != "$$wanted" ]; then \
	        echo '$(VENV) is there, was not made by make, and is not a' \
	            "$$wanted environment: remove it, or choose another VENV=..." >&2; \
	        exit 1; \
	    fi; \
	else \
	    echo "Making $(VENV) with $$wanted"; \
	    rm -rf '$(VENV)' && mkdir -p '$(VENV)' && echo unfinished >'$@' && \
	    $(PYTHON) -m venv '$(VENV)' || exit 1; \
	fi; \
	mkdir -p '$(VENV)/build' && \
	printf '[build]\nbuild_base=%s\n[egg_info]\negg_base=%s\n' \
	    '$(abspath $(VENV))/build' '$(abspath $(VENV))/build' >'$(VENV)/setup.cfg' && \
	echo '$(abspath $(VENV))' >'$@'

# setuptools builds here and not in build/ of the sources, where modules that are gone stay on.
export DIST_EXTRA_CONFIG := $(abspath $(VENV))/setup.cfg

# What the package needs, and an extra of setup.py.
$(VENV)/.deps-%: setup.py $(VENV)/.made
	@echo 'Installing into $(VENV) what [$*] needs'
	@$(PIP) '.[build,$*]'
	@touch '$@'

# The package alone, in seconds, without a network.
$(VENV)/.package: $(VENV)/.deps-ros $(SOURCES)
	@echo 'Installing spinning_top_sim into $(VENV)'
	@rm -rf '$(VENV)/build' && mkdir '$(VENV)/build'
	@$(PIP) --no-deps --no-build-isolation --force-reinstall .
	@touch '$@'
