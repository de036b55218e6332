# SPDX-License-Identifier: Apache-2.0
#: Run, test and check the package on Linux with Python >= 3.11, with or without
#: ROS.  Everything is installed into a virtual environment, VENV.
#:
PYTHON ?= python3
ROS ?= jazzy
VENV ?= .venv$(patsubst %,-%,$(filter-out jazzy,$(ROS)))
SCENE ?= cusp
LOGS ?= logs
TESTS ?= test
WORKERS ?= 3
TIMES ?= 10

.DEFAULT_GOAL := help
.NOTPARALLEL:
.SUFFIXES:
MAKEFLAGS += --no-builtin-rules
.PHONY: help run view test coverage mutation stress performance performance-check benchmark engines \
    docs dependencies lint build clean FORCE

# DDS stays on this machine.  Its default is to discover nodes in the whole network.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
run: export ROS_DOMAIN_ID := $(or $(ROS_DOMAIN_ID),77)

# The ROS of the environment is used, whatever the shell has set.
ifneq ($(_ROS_WHEELS_BOOTSTRAP_COMPLETE)$(AMENT_PREFIX_PATH),)
unexport LD_LIBRARY_PATH
endif
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONPATH PYTHONHOME VIRTUAL_ENV ROS_DISTRO
# The assertions of the tests are rewritten once, not in each run and worker.
unexport PYTHONDONTWRITEBYTECODE
export AMENT_PREFIX_PATH := $(abspath $(VENV))
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
export PYTHONUNBUFFERED := 1
export DIST_EXTRA_CONFIG := $(abspath $(VENV))/setup.cfg

BIN := '$(VENV)/bin
# On a terminal pip shows what it downloads.
PIP = $(BIN)/python' -m pip --disable-pip-version-check install $(if $(MAKE_TERMOUT),,--quiet --quiet)
# Each worker would import the other plug-ins, and rewrite their assertions, in two seconds.
test coverage: export PYTEST_DISABLE_PLUGIN_AUTOLOAD := 1
# The workers are enough threads: more of them wait for each other, a sixth of the time.
test coverage stress: export OMP_NUM_THREADS := 1
test coverage stress: export OPENBLAS_NUM_THREADS := 1
PYTEST = $(BIN)/pytest' -p xdist -n $(WORKERS) --max-worker-restart=0
# The package and the wheels of ROS.
WITH_ROS := $(VENV)/.deps-ros-$(ROS) $(VENV)/.package
INSTALL = @flock --nonblock Makefile true || echo 'Another make installs: waiting for it'; \
    flock Makefile $(MAKE) --silent --no-print-directory

help:
	@sed -n 's/^#: \{0,1\}//p' Makefile
	@echo 'PYTHON=$(PYTHON)  ROS=$(ROS)  VENV=$(VENV)'

#: make run     simulate a scene and record it into logs/, until Ctrl-C; SCENE=...:
#:              cusp fast_gyroscope free_top heavy_top looping near_separatrix
#:              planar_pendulum sleeping spherical_pendulum steady_fast
#:              steady_slow waking_sleeper wavy  with a moving pivot: braking
#:              elevator free_fall shuttle  or the path of a parameter file;
#:              IMU=bmi088 gives the readings the errors of an IMU
run:
	$(INSTALL) '$(VENV)/.deps-plot' '$(VENV)/.deps-ros-$(ROS)' '$(VENV)/.package'
	@test -e 'config/$(SCENE).yaml' -o -e '$(SCENE)' || $(BIN)/spinning-top' node --scene '$(SCENE)'
	@mkdir -p '$(LOGS)'
	@echo 'Scene $(SCENE), recording into $(LOGS)/, until Ctrl-C. Another terminal of this machine' \
	    'listens after:'
	@echo '  . $(VENV)/bin/activate'
	@echo "  export ROS_DOMAIN_ID=$$ROS_DOMAIN_ID" \
	    "ROS_AUTOMATIC_DISCOVERY_RANGE=$$ROS_AUTOMATIC_DISCOVERY_RANGE"
	@echo '  python examples/listen.py pose'
	@exec $(BIN)/spinning-top' node --scene '$(SCENE)' $(if $(IMU),--imu '$(IMU)') --ros-args -p record.enabled:=true \
	    -p 'record.uri:=$(LOGS)/' $(ARGS)

#: make view    simulate a scene in the browser, without ROS; SCENE=... PORT=8080
view:
	$(INSTALL) '$(VENV)/.deps-view' '$(VENV)/.package'
	@exec $(BIN)/spinning-top' view --scene '$(SCENE)' $(if $(PORT),--port '$(PORT)') $(ARGS)

dependencies: $(VENV)/.deps-test $(WITH_ROS)

#: make test    run the tests; TESTS=test/test_rk45.py ARGS='-k step' WORKERS=0
test: dependencies
	$(PYTEST) $(TESTS) $(ARGS)

#: make coverage
#:              the same, and list what no test runs, in all processes
coverage: export COVERAGE_FILE := $(abspath $(VENV))/coverage/data
coverage: dependencies
	@rm -rf '$(VENV)/coverage' && mkdir '$(VENV)/coverage'
	$(BIN)/coverage' run $(PYTEST) $(TESTS) $(ARGS)
	@$(BIN)/coverage' combine --quiet
	$(BIN)/coverage' report --fail-under=95

#: make lint    run ruff and mypy
lint: $(VENV)/.deps-test $(VENV)/.deps-lint $(WITH_ROS)
	$(BIN)/ruff' check . scripts/*
	$(BIN)/mypy'

#: make docs    write the generated pages and the site in site/
docs: $(VENV)/.deps-plot $(VENV)/.deps-test $(VENV)/.deps-docs $(WITH_ROS)
	for page in interface definitions urdf figures; do $(BIN)/python' docs/$$page.py || exit; done
	rm -rf site
	$(BIN)/python' -m sphinx --fail-on-warning --keep-going --nitpicky --quiet docs site
	@echo 'Open site/index.html'

#: make build   build with colcon in a new workspace, test that, and leave it there
build: $(VENV)/.deps-colcon $(VENV)/.deps-test $(WITH_ROS)
	.ci/colcon-build '$(VENV)'

#: make performance-check
#:              compare the cost with that of the parent commit (BASE=...) and
#:              of the last release (REF=...); eight minutes
performance-check: dependencies
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python' benchmark/regression.py $(if $(REF),--release '$(REF)') \
	    $(if $(BASE),--parent '$(BASE)')

#: make benchmark, make performance
#:              measure everything (hours), or node, start-up and logs (an hour),
#:              and write docs/measured/
benchmark performance:
	@$(MAKE) --no-print-directory VENV=.venv-benchmark dependencies
	@benchmark/all .venv-benchmark $@

#: make engines
#:              install physics engines into .venv-engines, grade them, and write
#:              docs/measured/engines.md; an hour
engines:
	@$(MAKE) --no-print-directory VENV=.venv-engines .venv-engines/.deps-engines
	PYTHONPATH=. .venv-engines/bin/python benchmark/engines.py

#: make stress  random inputs, faults and kills, an hour; TIMES=100 tries ten times as many
stress: dependencies
	.ci/stress '$(VENV)' $(TIMES)

#: make mutation
#:              change the core in one place at a time, and list what no test
#:              notices, hours; MUTANTS='*.pivot.*' changes this alone
mutation: $(VENV)/.deps-mutation dependencies
	$(BIN)/mutmut' run --max-children $(WORKERS) $(MUTANTS)
	$(BIN)/mutmut' results | sed '/: not checked$$/d'

#: make clean   remove the environment and caches, but no logs
#:
clean:
	test ! -e '$(VENV)/.made' || rm -rf '$(VENV)'
	rm -rf .hypothesis .mypy_cache .pytest_cache .ruff_cache mutants site
	find benchmark examples launch spinning_top_sim test -name __pycache__ -prune -exec rm -rf {} +

# ------------------------------------------------------------------------------- the environment
.PRECIOUS: %/.made
%/.made: FORCE
	@.ci/environment '$*' '$(ROS)' '$(PYTHON)' '$(filter command environment,$(origin PYTHON))'

# The dependencies of the package and of one extra of pyproject.toml.
.PRECIOUS: $(VENV)/.deps-%
$(VENV)/.deps-%: pyproject.toml $(VENV)/.made
	@echo 'Installing the dependencies [$*] into $(VENV)'
	@$(PIP) '.[build,$*]'
	@touch '$@'

# The wheels of a ROS distribution: in the ranges of its extra or, without one, the newest.
.PRECIOUS: $(VENV)/.deps-ros-%
$(VENV)/.deps-ros-%: pyproject.toml $(VENV)/.made
	@echo 'Installing the wheels of ROS 2 $* into $(VENV), a minute or two'
	@if grep -q '^ros-$* = ' pyproject.toml; then $(PIP) '.[build,ros-$*]'; \
	    else $(PIP) '.[build]' 'ros-$*-rclpy[fastrtps]' ros-$*-common-interfaces || \
	    { echo 'ROS=$*: there are no such wheels for this Python' >&2; exit 1; }; fi
	@touch '$@'

# The package alone: takes seconds and needs no network.  Folders too: their modification time
# changes when a file is removed.  The dependencies may have brought an older wheel from a cache.
SOURCES := $(shell find pyproject.toml setup.py setup.cfg package.xml config foxglove launch \
    resource rviz scripts spinning_top_sim urdf -name __pycache__ -prune -o \
    \( -type f -o -type d \) ! -name '.*' ! -name '*~' -print)
$(VENV)/.package: $(SOURCES)
	@echo 'Installing spinning_top_sim into $(VENV)'
	@rm -rf '$(VENV)/build' '$(VENV)'/lib/python*/site-packages/spinning_top_sim
	@mkdir '$(VENV)/build'
	@$(PIP) --no-deps --no-build-isolation --force-reinstall .
	@touch '$@'
