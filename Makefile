# Every target works from a fresh clone: the virtual environment is made first and kept up to date with setup.cfg and constraints.txt.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# Python compiles what it imports; compiling all of torch takes longer than installing it
PIP_INSTALL := -m pip install --no-compile
STAMP := $(VENV)/.installed
DOCS_STAMP := $(VENV)/.installed-docs
SMAX_VENV ?= .venv-smax
SMAX_STAMP := $(SMAX_VENV)/.installed
TRACKERS_VENV := .venv-trackers
TRACKERS_STAMP := $(TRACKERS_VENV)/.installed
RL_ZOO3_VENV := .venv-rl-zoo3
RL_ZOO3_STAMP := $(RL_ZOO3_VENV)/.installed
STATISTICS_VENV := .venv-statistics
STATISTICS_STAMP := $(STATISTICS_VENV)/.installed
ORACLE_VENV := .venv-oracle
ORACLE_STAMP := $(ORACLE_VENV)/.installed
PACKAGE_VENV := .venv-package
PACKAGE_STAMP := $(VENV)/.installed-package
PEERS_VENV := .venv-peers
PEERS_STAMPS := $(patsubst %,$(PEERS_VENV)/%/.installed,rllib agilerl benchmarl)
SOURCES := sb3_belief tests benchmarks studies examples docs/conf.py train.py
DEMO_ARGS ?=
PYTEST_ARGS ?=
# As many tests at once as there are cores; PYTEST_JOBS=0 for one after the other
PYTEST_JOBS ?= auto
CONFORMANCE_ARGS ?=
BENCH_ARGS ?=
SOAK_MINUTES ?= 60
SOAK_SEED ?= 0

.PHONY: help install demo test test-slow test-games test-envs test-smax test-rl-zoo3 test-trackers test-statistics test-oracle pytest conformance soak bench bench-peers docs package \
	lint type format check-codestyle commit-checks clean

help:  ## list the targets
	@grep -E '^[a-z0-9-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z0-9-]+):.*## /\1\t/' | expand -t 18

install: $(STAMP)  ## make the virtual environment

# torch comes first and by its tested version: a range would make the resolver fetch several builds of it
$(STAMP): setup.cfg pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "Python 3.10 or later is needed: make PYTHON=python3.11 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
		{ echo "$(PYTHON) cannot make virtual environments (Debian and Ubuntu: apt-get install python3-venv)"; exit 1; }
	$(BIN)/python $(PIP_INSTALL) --quiet -c constraints.txt torch
	$(BIN)/python $(PIP_INSTALL) --quiet -c constraints.txt -e '.[tests,plots]'
	@touch $@

demo: $(STAMP)  ## train a team of BeliefPPO agents on Traffic Junction and show what it learned
	$(BIN)/sb3-belief demo $(DEMO_ARGS)

test: $(STAMP)  ## run all tests but the slow ones
	$(BIN)/python -m pytest -n $(PYTEST_JOBS) --dist loadfile -m "not slow" $(PYTEST_ARGS)

# Named by file, since each process would import all others, too
test-slow: $(STAMP)  ## play the games that prove the belief dynamic, and run all else that takes long
	$(BIN)/python -m pytest -n $(PYTEST_JOBS) --dist loadfile -m slow $(PYTEST_ARGS) \
		$$(grep -rl --include='test_*.py' 'mark\.slow' tests)

test-games: $(STAMP)  ## play all games with five seeds each (most of an hour)
	GAME_SEEDS=5 $(BIN)/python -m pytest -n $(PYTEST_JOBS) -m slow tests/games $(PYTEST_ARGS)

pytest: test

# apart from the tests: it fetches the suites of the installed versions first
conformance: $(STAMP)  ## run SB3's and sb3-contrib's own test suites with our algorithms in place of theirs
	$(BIN)/python -m tests.conformance.fetch
	$(BIN)/python -m tests.conformance.run $(CONFORMANCE_ARGS)

# the page must have the two marks between which the tables stand
soak: $(STAMP)  ## disturb random trainings for an hour (or SOAK_MINUTES), into the table of docs/reliability.md
	$(BIN)/python -m tests.reliability.soak --minutes $(SOAK_MINUTES) --seed $(SOAK_SEED) --write docs/reliability.md

bench: $(STAMP)  ## measure speed and memory (25 minutes), into benchmarks/out/bench.json
	$(BIN)/python -m benchmarks.bench $(BENCH_ARGS)

# each of the other libraries has an environment of its own; one that cannot be made is skipped, and its log says why
$(PEERS_VENV)/%/.installed: benchmarks/peers/%.txt
	$(PYTHON) -m venv $(PEERS_VENV)/$*
	$(PEERS_VENV)/$*/bin/python $(PIP_INSTALL) -r $< >$(PEERS_VENV)/$*.log 2>&1
	@touch $@

bench-peers: $(STAMP)  ## compare with other libraries (an environment for each: 5 GB), into benchmarks/out/peers.json
	-$(MAKE) --keep-going --no-print-directory $(PEERS_STAMPS)
	$(BIN)/python -m benchmarks.peers $(BENCH_ARGS)

# SMAX has an environment of its own: jaxmarl needs gymnasium<1.4, and its pins are those of Python 3.11
$(SMAX_STAMP): setup.cfg pyproject.toml constraints-smax.txt
	$(PYTHON) -m venv $(SMAX_VENV)
	$(SMAX_VENV)/bin/python $(PIP_INSTALL) --quiet -c constraints-smax.txt torch
	$(SMAX_VENV)/bin/python $(PIP_INSTALL) --quiet -c constraints-smax.txt -e '.[study]' pytest jaxmarl 'gymnasium<1.4'
	@touch $@

test-envs: $(STAMP) test-smax  ## run the tests of all environments, each from its package
	$(BIN)/python -m pytest -n $(PYTEST_JOBS) --dist loadfile -m "not slow" tests/envs $(PYTEST_ARGS)

test-smax: $(SMAX_STAMP)  ## run the tests of SMAX, in an environment of its own (more than a gigabyte)
	JAX_COMPILATION_CACHE_DIR=$(SMAX_VENV)/jax-cache $(SMAX_VENV)/bin/python -m pytest tests/envs/adapters/smax $(PYTEST_ARGS)

# rl_zoo3 has an environment of its own, as a user's would be: without what our tests and plots need beside it
$(RL_ZOO3_STAMP): setup.cfg pyproject.toml constraints.txt
	$(PYTHON) -m venv $(RL_ZOO3_VENV)
	$(RL_ZOO3_VENV)/bin/python $(PIP_INSTALL) --quiet -c constraints.txt torch
	$(RL_ZOO3_VENV)/bin/python $(PIP_INSTALL) --quiet -c constraints.txt -e '.[rl-zoo3]' pytest
	@touch $@

test-rl-zoo3: $(RL_ZOO3_STAMP)  ## train and search with the real rl_zoo3, in an environment of its own
	$(RL_ZOO3_VENV)/bin/python -m pytest tests/zoo/test_rl_zoo3.py $(PYTEST_ARGS)

# Ray, wandb and MLflow have an environment of their own: see constraints-trackers.txt. The tests that do without are among the others
$(TRACKERS_STAMP): setup.cfg pyproject.toml constraints-trackers.txt
	$(PYTHON) -m venv $(TRACKERS_VENV)
	$(TRACKERS_VENV)/bin/python $(PIP_INSTALL) --quiet -c constraints-trackers.txt torch
	$(TRACKERS_VENV)/bin/python $(PIP_INSTALL) --quiet -c constraints-trackers.txt -e '.[study,ray,track]' pytest
	@touch $@

test-trackers: $(TRACKERS_STAMP)  ## run a study on Ray and track runs with wandb and MLflow, in an environment of their own
	$(TRACKERS_VENV)/bin/python -m pytest tests/zoo/test_tracking.py tests/study/test_ray_engine.py \
		-k 'mlflow_gets_a_run or wandb_gets_a_run or outlives_a_node' $(PYTEST_ARGS)

# rliable and marl-eval have an environment of their own: the one breaks with newer arch, the other pins an old pandas
$(STATISTICS_STAMP):
	$(PYTHON) -m venv $(STATISTICS_VENV)
	$(STATISTICS_VENV)/bin/python $(PIP_INSTALL) --quiet --only-binary arch,numpy,scipy,pandas \
		rliable==1.2.0 arch==5.6.0 'numpy<2' 'pandas<2.2' colorama 'setuptools<80' wheel
	$(STATISTICS_VENV)/bin/python $(PIP_INSTALL) --quiet --no-deps --no-build-isolation id-marl-eval==0.0.4
	@touch $@

test-statistics: $(STAMP) $(STATISTICS_STAMP)  ## compare our statistics with rliable's, and read our export with marl-eval
	$(BIN)/python -m pytest tests/report/test_statistics.py \
		tests/report/test_bands.py tests/report/test_marl_eval.py $(PYTEST_ARGS)

# torchrl has an environment of its own, since nothing but this test needs it
$(ORACLE_STAMP): setup.cfg constraints.txt
	$(PYTHON) -m venv $(ORACLE_VENV)
	$(ORACLE_VENV)/bin/python $(PIP_INSTALL) --quiet -c constraints.txt torch
	$(ORACLE_VENV)/bin/python $(PIP_INSTALL) --quiet -c constraints.txt -e '.[oracle]'
	@touch $@

test-oracle: $(STAMP) $(ORACLE_STAMP)  ## compare our QMIX mixer with torchrl's, in an environment of its own
	$(BIN)/python -m pytest tests/references/test_torchrl.py $(PYTEST_ARGS)

$(DOCS_STAMP): $(STAMP)
	$(BIN)/python $(PIP_INSTALL) --quiet -c constraints.txt -e '.[docs]'
	@touch $@

docs: $(DOCS_STAMP)  ## build the pages into docs/_build/html; any warning is an error
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html

$(PACKAGE_STAMP): $(STAMP)
	$(BIN)/python $(PIP_INSTALL) --quiet -c constraints.txt -e '.[package]'
	@touch $@

package: $(PACKAGE_STAMP)  ## build the distributions into dist/ and check them, the wheel in an environment of its own
	rm -rf dist $(PACKAGE_VENV)
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python -m twine check --strict dist/*
	$(PYTHON) -m venv $(PACKAGE_VENV)
	$(BIN)/python -m tests.package.check dist $(PACKAGE_VENV)

lint: $(STAMP)  ## look for mistakes
	$(BIN)/ruff check $(SOURCES)

type: $(STAMP)  ## check the types
	$(BIN)/mypy $(SOURCES)

format: $(STAMP)  ## sort imports and format the code
	$(BIN)/ruff check --select I --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

check-codestyle: $(STAMP)  ## check imports and format, changing nothing
	$(BIN)/ruff check --select I $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)

commit-checks: format type lint  ## what to run before a commit

clean:  ## remove the virtual environment and all caches (runs in logs/ stay)
	rm -rf $(VENV) $(SMAX_VENV) $(RL_ZOO3_VENV) $(STATISTICS_VENV) $(ORACLE_VENV) $(PACKAGE_VENV) $(PEERS_VENV) docs/_build build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .coverage htmlcov
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
