# Everything a person or CI does here has a name below. `make help` lists it.
PYTHON ?= python3
VENV ?= .venv
RUN_VENV ?= .venv-run
TORCH_VERSION = 2.13.0
OUT ?= runs

BIN = $(VENV)/bin
RUN = $(RUN_VENV)/bin/python

.DEFAULT_GOAL := help
.PHONY: help run test test-all check collect train export requirements clean

help: ## list the commands
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 16

# ---- environments -------------------------------------------------------------------------------------------------
# Two of them: running the cell needs no torch, testing and training do. A stamp file makes each a no-op once built.

$(RUN_VENV)/ready: requirements/run.txt
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is %d.%d; set PYTHON=" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(RUN_VENV)
	$(RUN_VENV)/bin/pip install -q --require-hashes --no-deps -r requirements/run.txt
	@touch $@

$(VENV)/ready: requirements/test.txt requirements/torch.sh
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is %d.%d; set PYTHON=" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	sh requirements/torch.sh $(BIN)/pip $(TORCH_VERSION)
	$(BIN)/pip install -q --require-hashes --no-deps -r requirements/test.txt
	@touch $@

# ---- the main job -------------------------------------------------------------------------------------------------

run: $(RUN_VENV)/ready ## insert an object in the simulated cell (OBJECT= X_MM= THETA_DEG= SEED=)
	@$(RUN) -m simulation run --out $(OUT) $(if $(OBJECT),--object $(OBJECT)) $(if $(X_MM),--x-mm=$(X_MM)) \
	  $(if $(THETA_DEG),--theta-deg=$(THETA_DEG)) $(if $(SEED),--seed $(SEED))

# ---- tests --------------------------------------------------------------------------------------------------------

test: $(VENV)/ready ## lint, types, import rules and the fast tests
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest -n 2 -m "not slow"

test-all: $(VENV)/ready ## the fast tests and the long ones
	$(BIN)/python -m pytest --timeout=1800

# ---- from probes to released models -------------------------------------------------------------------------------

requirements: ## pin requirements/*.txt again (needs uv)
	sh requirements/compile.sh

clean: ## remove what the commands above made, but no data and no runs
	rm -rf $(VENV) $(RUN_VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
