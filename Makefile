# Two commands on a machine with Python 3.11, make and pip:  make demo   and   make test
# Both install everything into .venv, in the versions pinned in constraints.txt.

VENV := .venv
BOARD := runs/board
PY := $(VENV)/bin/python
INSTALLED := $(VENV)/.installed
FRAMEWORKS := gymnax rllib sbx tianshou
SITE := 'import site; print(site.getsitepackages()[0])'

# The first sufficiently new interpreter; override with `make PYTHON=/path/to/python3.11 test`.
NEW_ENOUGH := import sys; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for python in python3 python3.11 python; do \
	$$python -c '$(NEW_ENOUGH)' >/dev/null 2>&1 && echo $$python && break; done)

.DEFAULT_GOAL := help
.PHONY: help install demo demo-full serve test check bench lowest docs tutorials frameworks clean

help:            ## show this list
	@grep -E '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 18

install: $(INSTALLED)  ## create the virtual environment with all dependencies

demo: $(INSTALLED)     ## in a minute: train an agent on SME/Default-v1, evaluate it, submit it to a local leaderboard
	$(VENV)/bin/sme demo
	$(VENV)/bin/sme-leaderboard demo

demo-full: $(INSTALLED)  ## the same in a few minutes, with TD3's default hyperparameters
	$(VENV)/bin/sme demo --full
	$(VENV)/bin/sme-leaderboard demo

serve: $(INSTALLED)    ## serve a leaderboard on this machine: pages and submission API
	@test -f $(BOARD)/board.json || $(VENV)/bin/sme-leaderboard init $(BOARD)
	$(VENV)/bin/sme-leaderboard serve $(BOARD)

test: $(INSTALLED)     ## run the whole test suite, as CI does
	$(PY) -m pytest -n auto --dist loadfile --no-loadscope-reorder

check: $(INSTALLED)    ## check style, formatting, types and import contracts
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

bench: $(INSTALLED)    ## measure speed against peers in the same run; ROUNDS=FILE keeps all times
	$(PY) -m pytest benchmarks --benchmark-enable --benchmark-quiet -q $(ROUNDS:%=--rounds %)

lowest:          ## run the core's tests with the lowest versions that pyproject.toml allows; before a release
	PYTHON=$(PYTHON) .ci/lowest

docs: $(INSTALLED)     ## regenerate the generated pages of docs/, build docs/_build/html
	$(PY) docs/generate.py
	$(PY) -m sphinx -q -W --keep-going -j auto $(SPHINX) docs docs/_build/html
	@echo "Open docs/_build/html/index.html"

tutorials: $(INSTALLED)  ## execute the tutorials whose code has changed, and store their outputs
	$(PY) docs/notebooks.py

frameworks: $(FRAMEWORKS:%=framework-%)  ## run the examples for gymnax, RLlib, sbx and Tianshou, each in an environment of its own

# Each environment sees the packages of .venv; pip adds the framework, and replaces what it needs in
# another version. These versions were tried last. TorchRL is in .venv.
framework-gymnax: PACKAGES := "gymnax==1.0.1" "rejax==0.1.3"
framework-rllib: PACKAGES := "ray[rllib]==2.60.0"
framework-sbx: PACKAGES := "sbx-rl==0.28.0"
framework-tianshou: PACKAGES := "tianshou==2.0.1"
framework-%: $(INSTALLED)
	$(PY) -m venv build/$@
	$(PY) -c $(SITE) > "$$(build/$@/bin/python -c $(SITE))/shared.pth"
	build/$@/bin/python -m pip install --quiet --disable-pip-version-check $(PACKAGES)
	build/$@/bin/python -m pytest -q -rsP tests/test_examples.py -k $*

clean:                 ## remove the virtual environment, caches and built packages
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamp is written last, so an interrupted installation is repeated.
$(INSTALLED): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is required, but python3, python3.11 and python" \
	"are missing or older. Install it, or run: make PYTHON=/path/to/python3.11"; exit 1; }
	@$(PYTHON) -c '$(NEW_ENOUGH)' >/dev/null 2>&1 || { echo "PYTHON=$(PYTHON): must be Python 3.11" \
	"or newer. It says: $$($(PYTHON) --version 2>&1 | tail -n 1)"; exit 1; }
	@$(PY) -c '$(NEW_ENOUGH)' 2>/dev/null || $(PYTHON) -m venv --clear $(VENV) || { rm -rf $(VENV); \
	echo "Cannot create a virtual environment: this Python lacks the module venv or pip." \
	"On Debian and Ubuntu, run: apt-get install python3-venv"; exit 1; }
	$(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[dev]"
	@touch $@
