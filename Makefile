# SPDX-License-Identifier: Apache-2.0
# Runs, tests and checks the package on a machine that has Python >= 3.11 and make, ROS or not.
# Everything is installed into $(VENV).  setup.py lists the dependencies and their versions.

PYTHON ?= python3
ROS ?= jazzy
VENV ?= .venv$(ROS_SUFFIX)
SCENE ?= cusp
LOGS ?= logs
ARGS ?=
TESTS ?= test
WORKERS ?= 6

# The extra of setup.py with the wheels of this ROS; an environment has one ROS only.
ROS_SUFFIX := $(if $(filter-out jazzy,$(ROS)),-$(ROS))
ifeq ($(filter jazzy kilted,$(ROS)),)
$(error ROS=$(ROS) is neither jazzy nor kilted)
endif

MAKEFLAGS += --no-builtin-rules
.SUFFIXES:
.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help run view test coverage mutation stress performance performance-check benchmark docs \
    dependencies lint build clean check-scene FORCE

# DDS stays on this machine.  Its default is to discover nodes in the whole network.
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
RUN_DOMAIN_ID := $(or $(ROS_DOMAIN_ID),77)

# The ROS of the virtual environment is used, whatever the shell has set.  The wheels set a guard
# and LD_LIBRARY_PATH for their own child processes; those of another environment are wrong here,
# and so are the paths of a sourced ROS installation.
ifneq ($(_ROS_WHEELS_BOOTSTRAP_COMPLETE)$(AMENT_PREFIX_PATH),)
unexport LD_LIBRARY_PATH
endif
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONPATH PYTHONHOME VIRTUAL_ENV ROS_DISTRO
export AMENT_PREFIX_PATH := $(abspath $(VENV))
export RMW_IMPLEMENTATION := rmw_fastrtps_cpp
export PYTHONUNBUFFERED := 1

PIP := '$(VENV)/bin/python' -m pip --disable-pip-version-check install --quiet --quiet
SCENES := $(sort $(basename $(notdir $(wildcard config/*.yaml))))
# Folders too: their modification time changes when a file is removed.
SOURCES := $(shell find setup.py setup.cfg package.xml config foxglove launch resource rviz \
    scripts spinning_top_sim urdf -name __pycache__ -prune -o \( -type f -o -type d \) \
    ! -name '.*' ! -name '*~' -print 2>/dev/null)

help:
	@echo 'make run     simulate a scene until Ctrl-C and record into $(LOGS)/'
	@echo '             SCENE=$(SCENE), the path of a parameter file or one of'
	@echo '$(SCENES)' | fold -s -w 65 | sed 's/^/             /'
	@echo '             ARGS=... adds arguments, such as ARGS="-p time_scale:=0.5"'
	@echo 'make view    the same in the browser, without a log; PORT=... of the page'
	@echo 'make test    run the tests; TESTS=... selects some, ARGS=... goes to pytest,'
	@echo '             which has WORKERS=$(WORKERS) processes (0: its own, for ARGS=--pdb)'
	@echo 'make coverage'
	@echo '             the same, and tell by folder what no test runs, in all processes'
	@echo 'make mutation'
	@echo '             change physics, solvers and the reader of logs in one place at a'
	@echo '             time, and tell what no test notices; MUTANTS=... selects; hours'
	@echo 'make stress  kill 200 recording nodes (KILLS=...), try 30 times the random'
	@echo '             inputs of the tests (EXAMPLES=...), then random logs, parameters,'
	@echo '             commands, service calls, disk faults and the statistics of the'
	@echo '             sensors (each SECONDS=180), 10 exams of nodes beside other work'
	@echo '             (EXAMS=...), and 20 000 random tops (STRESS=...) with both solvers;'
	@echo '             more than an hour'
	@echo 'make performance'
	@echo '             measure node, start-up, a long run, solvers and simulate, and write'
	@echo '             docs/measured/performance.md; an hour, in .venv-benchmark'
	@echo 'make benchmark'
	@echo '             the same, and compare accuracy, stability and cost with other'
	@echo '             programs, attitude filters and the noise of the IMU; two hours'
	@echo '             and a quarter'
	@echo 'make performance-check'
	@echo '             compare the cost with that of the parent commit (BASE=...) and of'
	@echo '             the last release (REF=...); eight minutes'
	@echo 'make docs    write the interface page, the plain URDF and the pictures, and'
	@echo '             build the site of all pages in site/'
	@echo 'make lint    run ruff and mypy'
	@echo 'make build   build with colcon in a temporary workspace, test the installation'
	@echo 'make clean   remove $(VENV) and caches, but no logs'
	@echo
	@echo 'PYTHON=$(PYTHON)  interpreter, 3.11 or newer;  ROS=$(ROS)  jazzy or kilted'
	@echo 'VENV=$(VENV)  environment, .venv-kilted for ROS=kilted'

# A name, or the path of a parameter file.
SCENE_FILE = $(or $(wildcard $(filter %.yaml,$(SCENE))),config/$(SCENE).yaml)

# One installs at a time: a second `make run` waits here, and finds everything installed.
run: export ROS_DOMAIN_ID := $(RUN_DOMAIN_ID)
run: check-scene
	@flock Makefile $(MAKE) --silent --no-print-directory '$(VENV)/.deps-plot' '$(VENV)/.package'
	@mkdir -p '$(LOGS)'
	@echo 'Scene $(SCENE), recording into $(LOGS)/, until Ctrl-C. To listen from another terminal of'
	@echo 'this machine:  export ROS_DOMAIN_ID=$(RUN_DOMAIN_ID)' \
	    'ROS_AUTOMATIC_DISCOVERY_RANGE=$(ROS_AUTOMATIC_DISCOVERY_RANGE)'
	@exec '$(VENV)/bin/sim_node' --ros-args --params-file '$(SCENE_FILE)' \
	    -p record.enabled:=true -p 'record.uri:=$(LOGS)/' $(ARGS)

# Ends with the exit code of the node or, if the page ends first, of the page, which has a second
# to see that the node has gone.  Ctrl-C reaches all processes of a terminal, but a shell makes
# those behind `&` ignore it.
view: export ROS_DOMAIN_ID := $(RUN_DOMAIN_ID)
view: check-scene
	@flock Makefile $(MAKE) --silent --no-print-directory '$(VENV)/.deps-view' '$(VENV)/.package'
	@trap 'kill -TERM $$node 2>/dev/null' INT TERM; \
	'$(VENV)/bin/sim_node' --ros-args --params-file '$(SCENE_FILE)' -p status_period:=0.0 \
	    $(ARGS) & node=$$!; \
	'$(VENV)/bin/view' $(if $(PORT),--port '$(PORT)') & page=$$!; \
	(trap '' INT; while kill -0 $$page; do sleep 0.5; done; kill -TERM $$node) 2>/dev/null & \
	while wait $$node; code=$$?; kill -0 $$node 2>/dev/null; do :; done; \
	sleep 1; if kill -TERM $$page 2>/dev/null; then wait $$page; exit $$code; else wait $$page; fi

# A preset of an IMU goes on top of a scene; alone it would run the default parameters.
check-scene:
	@case '$(abspath $(SCENE_FILE))' in */config/imu/*) \
	    echo '$(SCENE_FILE) is no scene but an IMU: add it to one of $(SCENES):' \
	        "make run SCENE=cusp ARGS='--params-file $(SCENE_FILE)'" >&2; exit 2;; \
	esac
	@test -f '$(SCENE_FILE)' || { \
	    echo 'There is no scene "$(SCENE)" ($(SCENE_FILE)). There are: $(SCENES)' >&2; exit 2; }

dependencies: $(VENV)/.deps-test $(VENV)/.package

# `pytest`, not `python -m pytest`, so that the installed package is tested.  Tests of nodes wait
# more than they compute: so there are more workers than processors.  A worker that crashes is a
# test that failed; pytest-xdist may wait for ever for the one that takes its place.
test: dependencies
	'$(VENV)/bin/pytest' -n $(WORKERS) --max-worker-restart=0 $(TESTS) $(ARGS)

# Of the installed package, in every process that the tests start.
COVERAGE = '$(VENV)/bin/coverage'
coverage: export COVERAGE_FILE := $(abspath $(VENV))/coverage/data
coverage: dependencies
	@rm -rf '$(VENV)/coverage' && mkdir '$(VENV)/coverage'
	$(COVERAGE) run '$(VENV)/bin/pytest' -n $(WORKERS) --max-worker-restart=0 $(TESTS) $(ARGS)
	@$(COVERAGE) combine --quiet
	@for room in spinning_top_sim/*/; do \
	    printf '%-30s %s %%\n' "$$room" "$$($(COVERAGE) report --format=total --include="$$room*")"; \
	done
	$(COVERAGE) report --fail-under=95

# Of the sources, in a copy in mutants/: fast tests, and one process for each mutant.
MUTANTS ?=
mutation: $(VENV)/.deps-mutation dependencies
	'$(VENV)/bin/mutmut' run --max-children $(WORKERS) $(MUTANTS)
	'$(VENV)/bin/mutmut' results

STRESS ?= 20000
KILLS ?= 200
EXAMPLES ?= 30
EXAMS ?= 10
SECONDS ?= 180
stress: dependencies
	@seed=$$(od -An -N4 -tu4 /dev/urandom | tr -d ' '); \
	.ci/timed "KILLS=$(KILLS) '$(VENV)/bin/pytest' -q test/test_kill.py" \
	    "EXAMPLES=$(EXAMPLES) '$(VENV)/bin/pytest' -q -n $(WORKERS) --max-worker-restart=0 \
	        --hypothesis-seed=$$seed \
	        $(addprefix test/test_,properties.py properties_logs.py ranges.py extremes.py)" \
	    $(foreach part,logs nodes disk sensor, \
	        "'$(VENV)/bin/python' test/stress $(part) --seconds $(SECONDS)") \
	    "'$(VENV)/bin/python' test/stress exam --count $(EXAMS)" \
	    "'$(VENV)/bin/python' test/stress tops --count $(STRESS)"

# The programs to compare with need hundreds of megabytes, so they have their own environment.
# The exam and the soak come last: they take more than an hour, and the tables of times do not wait.
PERFORMANCE := node_cpu startup solvers offline log_compression
COMPARISONS := heavy_top gauge stability work_precision allan increments attitude_filter \
    ensemble view exam
soak_options := --minutes 30
benchmark performance: export OMP_NUM_THREADS ?= 1
benchmark performance: export OPENBLAS_NUM_THREADS ?= 1
benchmark performance:
	@$(MAKE) --no-print-directory VENV=.venv-benchmark .venv-benchmark/.package \
	    .venv-benchmark/.peers
	@.ci/timed $(foreach part,$(PERFORMANCE) $(if $(filter benchmark,$@),$(COMPARISONS)) soak, \
	    ".venv-benchmark/bin/python benchmark/$(part).py $($(part)_options)")

# In the environment of the tests: nothing but the package differs.
REF ?=
BASE ?=
performance-check: export OMP_NUM_THREADS ?= 1
performance-check: export OPENBLAS_NUM_THREADS ?= 1
performance-check: dependencies
	'$(VENV)/bin/python' benchmark/regression.py $(if $(REF),--release '$(REF)') \
	    $(if $(BASE),--parent '$(BASE)')

$(VENV)/.peers: benchmark/requirements.txt $(VENV)/.deps-test
	@echo 'Installing into $(VENV) the programs that the benchmarks compare with'
	@$(PIP) -r benchmark/requirements.txt
	@touch '$@'

docs: $(VENV)/.deps-plot $(VENV)/.deps-test $(VENV)/.deps-docs $(VENV)/.package
	'$(VENV)/bin/python' docs/interface.py
	'$(VENV)/bin/python' docs/urdf.py
	'$(VENV)/bin/python' docs/figures.py
	rm -rf site
	'$(VENV)/bin/python' -m sphinx --fail-on-warning --keep-going --nitpicky --quiet docs site
	@echo 'Open site/index.html'

lint: $(VENV)/.deps-test $(VENV)/.deps-lint $(VENV)/.package
	'$(VENV)/bin/ruff' check . scripts/*
	'$(VENV)/bin/mypy'

build: $(VENV)/.deps-colcon $(VENV)/.deps-test $(VENV)/.package
	.ci/colcon-build '$(VENV)'

clean:
	test ! -e '$(VENV)/.made' || rm -rf '$(VENV)'
	rm -rf .hypothesis .mypy_cache .pytest_cache .ruff_cache mutants site
	find $(wildcard benchmark examples launch spinning_top_sim test) -name __pycache__ -prune \
	    -exec rm -rf {} +

OTHER_ROS = $(filter-out %/.deps-ros$(ROS_SUFFIX),$(wildcard $(VENV)/.deps-ros*))

# Created again if its Python is not the requested one, if it was moved, if it is incomplete or if
# it does not run.  An environment that make did not create is used as it is, and never removed.
PROBE := import sys; print("Python %d.%d" % sys.version_info[:2]); sys.exit(sys.version_info < (3, 11))
ASKED := $(filter command environment,$(firstword $(origin PYTHON)))
# make would delete it when it is interrupted, and leave an environment that nobody made.
.PRECIOUS: $(VENV)/.made
$(VENV)/.made: FORCE
	$(if $(OTHER_ROS),$(error $(VENV) has another ROS than $(ROS): choose another VENV=...))
	@there=$$('$(VENV)/bin/python' -c '$(PROBE)' 2>/dev/null) || there=; \
	made=$$(cat '$@' 2>/dev/null) || made=; \
	wanted=$$there; \
	if [ -n '$(ASKED)' ] || [ -z "$$there" ]; then \
	    wanted=$$($(PYTHON) -c '$(PROBE)' 2>&1) || { \
	        echo 'Python 3.11 or newer is required, but PYTHON=$(PYTHON) is:' "$$wanted" >&2; \
	        exit 1; }; \
	fi; \
	if [ "$$there" = "$$wanted" ] && [ "$$made" = '$(abspath $(VENV))' ]; then exit 0; fi; \
	if [ -z "$$made" ] && [ -e '$(VENV)' ]; then \
	    if [ "$$there" != "$$wanted" ]; then \
	        echo '$(VENV) exists, was not created by make, and is not a' \
	            "$$wanted environment: remove it, or choose another VENV=..." >&2; \
	        exit 1; \
	    fi; \
	else \
	    echo "Creating $(VENV) with $$wanted"; \
	    rm -rf '$(VENV)' && mkdir -p '$(VENV)' && echo unfinished >'$@' && \
	    $(PYTHON) -m venv '$(VENV)' || exit 1; \
	fi; \
	mkdir -p '$(VENV)/build' && \
	printf '[build]\nbuild_base=%s\n[egg_info]\negg_base=%s\n' \
	    '$(abspath $(VENV))/build' '$(abspath $(VENV))/build' >'$(VENV)/setup.cfg' && \
	echo '$(abspath $(VENV))' >'$@'

# setuptools builds here, not in build/ of the sources, where removed modules would remain.
export DIST_EXTRA_CONFIG := $(abspath $(VENV))/setup.cfg

# The dependencies of the package and of one extra of setup.py.
$(VENV)/.deps-%: setup.py $(VENV)/.made
	@echo 'Installing the dependencies [$*] into $(VENV)'
	@$(PIP) '.[build,$*]'
	@touch '$@'

# The package alone: takes seconds and needs no network.
$(VENV)/.package: $(VENV)/.deps-ros$(ROS_SUFFIX) $(SOURCES)
	@echo 'Installing spinning_top_sim into $(VENV)'
	@rm -rf '$(VENV)/build' && mkdir '$(VENV)/build'
	@$(PIP) --no-deps --no-build-isolation --force-reinstall .
	@touch '$@'
