# Every command that a person or CI runs here. `make help` lists them.
PYTHON ?= python3
VENV ?= .venv
RUN_VENV ?= .venv-run
READERS_VENV ?= .venv-readers
OLD_RUNTIME_VENV ?= .venv-old-runtime
OPS_VENV ?= .venv-ops
GRAPH_VENV ?= .venv-graph
KSERVE_VENV ?= .venv-kserve
LEROBOT_VENV ?= .venv-lerobot
DOCS_VENV ?= .venv-docs
LOWEST_VENV ?= .venv-lowest
MINUTES ?= 30
TORCH_VERSION = 2.13.0
TORCH_LOWEST = 2.6.0
OUT ?= runs

BIN = $(VENV)/bin
RUN = $(RUN_VENV)/bin/python

.DEFAULT_GOAL := help
.PHONY: help run demo trust-live lint test compiled test-all test-lowest hard-cases mutants accuracy slip-report pace bench bench-serving peers bench-hostile soak collect train pressing transfer export evaluate trust drawn-worlds commissioning identify requirements docs clean
.PHONY: image up up-sim down robot verify-images bundle sbom lint-ops

help: ## list the commands
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 16

# ---- environments -------------------------------------------------------------------------------------------------
# Two of them: running the cell needs no torch, testing and training do. A stamp file makes each a no-op once built.

$(RUN_VENV)/ready: requirements/run.txt
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is %d.%d; set PYTHON=" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(RUN_VENV)
	@$(RUN_VENV)/bin/python requirements/install.py $(RUN_VENV)/bin/pip requirements/run.txt
	@touch $@

# Modules are compiled as they are imported: most never are.
$(VENV)/ready: export PIP_COMPILE = 0
$(VENV)/ready: requirements/test.txt requirements/torch.sh
	@$(PYTHON) -c 'import sys; sys.exit("Python 3.11 or newer is needed, this is %d.%d; set PYTHON=" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	sh requirements/torch.sh $(BIN)/pip $(TORCH_VERSION)
	@$(BIN)/python requirements/install.py $(BIN)/pip requirements/test.txt
	@touch $@

$(VENV)/browser: $(VENV)/ready
	$(BIN)/pip install -q 'playwright>=1.49' 'axe-playwright-python>=0.1.4'
	@touch $@

PEERS_OF_THEIR_OWN = $(READERS_VENV) $(OLD_RUNTIME_VENV) $(GRAPH_VENV) $(KSERVE_VENV) $(LEROBOT_VENV)
$(READERS_VENV)/ready: PACKAGES = 'rerun-sdk>=0.41' 'foxglove-sdk>=0.30'
$(OLD_RUNTIME_VENV)/ready: PACKAGES = 'onnxruntime==1.17.3' 'numpy<2'
$(GRAPH_VENV)/ready: PACKAGES = openvino onnxsim
$(KSERVE_VENV)/ready: PACKAGES = kserve
$(LEROBOT_VENV)/ready: PACKAGES = lerobot
$(PEERS_OF_THEIR_OWN:=/ready): pyproject.toml
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install -q $(PACKAGES)
	@touch $@

$(DOCS_VENV)/ready: requirements/docs.txt
$(OPS_VENV)/ready: requirements/ops.txt
$(DOCS_VENV)/ready $(OPS_VENV)/ready:
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install -q --require-hashes --no-deps -r $<
	@touch $@

# ---- the main job -------------------------------------------------------------------------------------------------

run: $(RUN_VENV)/ready ## insert an object in the simulated cell (OBJECT= WORLD= X_MM= THETA_DEG= SEED=; OBJECT and WORLD may be TOML files; CELL=foreign: finite elements, 2.2 times too slow for real time, so in lock step)
ifeq ($(CELL),foreign)
	$(if $(X_MM)$(THETA_DEG),$(error CELL=foreign draws where the object is gripped: leave out X_MM and THETA_DEG, or choose another SEED))
	@$(RUN) -m simulation evaluate --cell foreign --perception fields --count 1 --objects $(or $(OBJECT),rectangle) \
	  $(if $(WORLD),--worlds $(WORLD)) $(if $(SEED),--seed $(SEED)) --json "$$(mktemp -d)/foreign.json"
else
	@$(RUN) -m simulation run --out $(OUT) $(if $(OBJECT),--object $(OBJECT)) $(if $(WORLD),--world $(WORLD)) \
	  $(if $(X_MM),--x-mm=$(X_MM)) $(if $(THETA_DEG),--theta-deg=$(THETA_DEG)) $(if $(SEED),--seed $(SEED))
endif

demo: $(RUN_VENV)/ready ## a simulated cell at work, one object after another, with its page, until Ctrl-C (OBJECT= WORLD= SEED= PORT=)
	@$(RUN) -m simulation demo --out $(OUT) $(if $(OBJECT),--object $(OBJECT)) $(if $(WORLD),--world $(WORLD)) \
	  $(if $(SEED),--seed $(SEED)) $(if $(PORT),--port $(PORT))

# ---- tests --------------------------------------------------------------------------------------------------------

lint: $(VENV)/ready ## format, lint, types and import rules; pre-commit runs the same
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The physics is compiled once, on the core that mypy leaves idle, instead of by each of the tests' processes.
test: $(VENV)/ready ## lint, types, import rules and the fast tests
	@$(MAKE) --no-print-directory -j2 lint compiled
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

compiled: $(VENV)/ready
	@$(BIN)/python -m simulation probe rectangle > /dev/null

test-all: $(VENV)/ready ## fast and slow tests; property tests draw new examples each time
	HYPOTHESIS_PROFILE=explore $(BIN)/python -m pytest --timeout=1800

# The lowest torch needs an index of CPU wheels (TORCH_CPU_INDEX); PyPI has only CUDA builds of it.
LOWEST_TESTS = tests/service/recordings tests/service/web/test_api.py tests/robot_client/session tests/training/networks \
  tests/export/onnx tests/export/quantise
test-lowest: ## all modules and some tests with the lowest versions that pyproject.toml allows (needs uv)
	rm -rf $(LOWEST_VENV)
	$(PYTHON) -m venv $(LOWEST_VENV)
	sh requirements/torch.sh $(LOWEST_VENV)/bin/pip $(if $(TORCH_CPU_INDEX),$(TORCH_LOWEST),$(TORCH_VERSION))
	uv pip install -q --python $(LOWEST_VENV)/bin/python -r requirements/torch.in
	uv pip install -q --python $(LOWEST_VENV)/bin/python --resolution lowest-direct --override requirements/no-torch.txt \
	  -r pyproject.toml --extra training
	$(LOWEST_VENV)/bin/python -m tests.import_everything
	$(LOWEST_VENV)/bin/python -m export verify $(MODELS)/pressing
	$(LOWEST_VENV)/bin/python -m simulation probe rectangle --x-mm 8 --theta-deg 5
	uv pip install -q --python $(LOWEST_VENV)/bin/python pytest pytest-timeout pytest-xdist hypothesis jsonschema-rs
	$(LOWEST_VENV)/bin/python -m pytest -n 2 --timeout=600 -m "not slow" -o filterwarnings= $(LOWEST_TESTS)

# ---- from probes to released models -------------------------------------------------------------------------------

PROBES ?= data/probes
TRIALS ?= 7500
CHECKPOINT ?= runs/markers/checkpoint.pt
PICTURES ?= runs/compact-long/checkpoint.pt
MODELS ?= models
PRESSES ?= data/presses
PRESS_TRIALS ?= 30000
PRESS_MODELS ?= models/pressing
EVALUATION ?= runs/evaluation.json
COUNT ?= 30
MUTANTS ?= 200
ALEXNET ?= runs/alexnet

collect: $(VENV)/ready ## poke until PROBES holds TRIALS collisions per object; resumable
	$(BIN)/python -m simulation collect --trials-per-object $(TRIALS) --out $(PROBES)

hard-cases: $(VENV)/ready ## all hard cases of all packages on three seeds: one table, docs/hard_cases.md and .json
	$(BIN)/python -m tests.hard_cases

mutants: $(VENV)/ready ## MUTANTS=200 random small changes of the code that decides and moves, and whether tests fail: docs/mutants.md, .json (SEED=)
	$(BIN)/python -m tests.mutants --count $(MUTANTS) $(if $(SEED),--seed $(SEED))

train: $(VENV)/ready ## train the released networks from PROBES, those that read markers and those that read pictures; resumable
	$(BIN)/python -m training train training/configs/markers.toml --data $(PROBES)
	$(BIN)/python -m training train training/configs/compact.toml --data $(PROBES)
	$(BIN)/python -m training train training/configs/compact-long.toml --data $(PROBES)

pressing: $(VENV)/ready ## collect PRESS_TRIALS presses of drawn cells in PRESSES, train the networks that read depth, measure how objects creep under them, export them into PRESS_MODELS and verify them; resumable
	$(BIN)/python -m simulation collect --objects drawn --trials-per-object $(PRESS_TRIALS) --trials-per-shard 100 --out $(PRESSES)
	$(BIN)/python -m training train training/configs/pressing.toml --data $(PRESSES)
	$(BIN)/python -m training depths runs/pressing
	$(BIN)/python -m export onnx runs/pressing/checkpoint.pt --out $(PRESS_MODELS)
	$(BIN)/python -m simulation drawn-worlds --models $(PRESS_MODELS) --older none --paper-models none --count 150 --drawn-n 150 --seed 9702 \
	  --layer-share 0.1 --out runs/pressing/played --docs runs/pressing/played
	$(BIN)/python -m training expect runs/pressing/checkpoint.pt runs/pressing/played/insertions.jsonl
	$(BIN)/python -m export onnx runs/pressing/checkpoint.pt --out $(PRESS_MODELS)
	cp runs/pressing/checkpoint.pt $(PRESS_MODELS)
	for folder in $(PRESS_MODELS) $(PRESS_MODELS)/joint; do $(BIN)/python -m export verify $$folder || exit 1; done

transfer: $(VENV)/ready ## what accurate physics is worth: networks of one tier each, tested in cells of another; docs/transfer.md, .json; some three hours of one core, goes on after an interruption
	for tier in bristle layer; do $(BIN)/python -m simulation collect --objects drawn-$$tier --trials-per-object 3000 \
	  --trials-per-shard 250 --seed 9106 --out data/transfer/$$tier || exit 1; done
	$(BIN)/python -m simulation collect --objects drawn-bristle drawn-layer --trials-per-object 1500 \
	  --trials-per-shard 250 --seed 9106 --out data/transfer/mixture
	for tier in bristle layer foreign; do $(BIN)/python -m simulation collect --objects drawn-$$tier \
	  --trials-per-object 500 --trials-per-shard 250 --seed 88 --out data/transfer/test-$$tier || exit 1; done
	for run in bristle layer layer-same-cpu mixture; do \
	  $(BIN)/python -m training train training/configs/transfer/$$run.toml || exit 1; done
	$(BIN)/python -m training transfer training/configs/transfer/plan.toml

export: $(VENV)/ready ## write CHECKPOINT and PICTURES as ONNX files with their cards into MODELS and MODELS/pictures, and verify them
	$(BIN)/python -m export onnx $(CHECKPOINT) --out $(MODELS)
	$(BIN)/python -m export onnx $(PICTURES) --out $(MODELS)/pictures
	for folder in $(MODELS) $(MODELS)/joint $(MODELS)/pictures; do $(BIN)/python -m export verify $$folder || exit 1; done

accuracy: $(VENV)/ready ## time cost of physics accuracy: docs/accuracy.md, .json, .png; errors against theory: docs/theory.md
	$(BIN)/python -m tests.simulation.physics.theory docs
	$(BIN)/python -m simulation accuracy

slip-report: $(RUN_VENV)/ready ## how well slip is detected, and at what cost: docs/slip_report.md
	$(RUN) -m simulation slip-report

trust-live: $(RUN_VENV)/ready ## inject faults into live insertions: docs/motion_bounds.md, .json; resumable
	$(RUN) -m simulation motion-bounds

pace: $(RUN_VENV)/ready ## cost of accuracy in seconds per box: docs/pace.md, .json, .png; resumable
	$(RUN) -m simulation pace --out runs/pace --docs docs

bench: $(VENV)/ready ## cost of a decision of each released network on this machine, and whether int8 pays: docs/benchmark.md, .json
	$(BIN)/python -m export benchmark --docs docs --int8 models/pictures --alexnet $(ALEXNET) \
	  $(if $(wildcard $(PROBES)/manifest.json),--data $(PROBES))

bench-serving: $(VENV)/ready ## cost of serving: docs/serving.md, .json
	$(BIN)/python -m tests.benchmarks.serving --models $(MODELS)

PEERS = $(if $(LEROBOT),$(PEERS_OF_THEIR_OWN),$(filter-out $(LEROBOT_VENV),$(PEERS_OF_THEIR_OWN)))
peers: $(VENV)/browser $(PEERS:=/ready) ## interoperability with other software, one row per package: docs/peers.md, .json (LEROBOT=1: its loader, too, 8 GB)
	PEERS_PYTHON="$(CURDIR)/$(READERS_VENV)/bin/python" OLD_RUNTIME_PYTHON="$(CURDIR)/$(OLD_RUNTIME_VENV)/bin/python" \
	  GRAPH_PYTHON="$(CURDIR)/$(GRAPH_VENV)/bin/python" KSERVE_PYTHON="$(CURDIR)/$(KSERVE_VENV)/bin/python" $(if $(LEROBOT),LEROBOT_PYTHON="$(CURDIR)/$(LEROBOT_VENV)/bin/python") \
	  $(BIN)/python -m tests.peers

bench-hostile: $(VENV)/ready ## effect of floods of pages, inference, bodies and connections on the robot: docs/hostile_load.md, .json
	$(BIN)/python -m tests.benchmarks.hostile

soak: $(VENV)/ready ## MINUTES=30 of insertions with faulty clients, cameras, models and garbage: docs/soak.md, .json
	$(BIN)/python -m tests.service.soak.soak --minutes $(MINUTES) --models $(MODELS)

evaluate: $(RUN_VENV)/ready ## closed loop in lock step, COUNT insertions per object, against the paper's trials: EVALUATION
	$(RUN) -m simulation evaluate --json $(EVALUATION) --count $(COUNT) --perception $(PERCEPTION)

PERCEPTION ?= pictures
trust: $(RUN_VENV)/ready ## claims under adversity: 10,000 insertions with drawn faults, worlds, objects and starts: docs/trust.md (WORLDS= a folder of more worlds)
	$(RUN) -m simulation trust --out runs/trust --docs docs $(if $(WORLDS),--worlds $(WORLDS))

drawn-worlds: $(RUN_VENV)/ready ## the closed loop in 300 drawn worlds with drawn objects, all variants: docs/drawn_worlds.md
	$(RUN) -m simulation drawn-worlds --out runs/drawn_worlds --docs docs

commissioning: $(VENV)/ready ## first days of 12 drawn cells: wiring check with each mistake, probes, adapting, work: docs/commissioning.md
	$(BIN)/python -m simulation draw-worlds --count 12 --seed 51 --out runs/commissioning/worlds
	$(BIN)/python -m simulation draw-objects --count 4 --seed 51 --out runs/commissioning/objects
	$(BIN)/python -m simulation commission --worlds runs/commissioning/worlds --objects runs/commissioning/objects --mistakes \
	  --seed 51 --json runs/commissioning/rows.json --docs docs

identify: $(RUN_VENV)/ready ## identify gels from presses, on 100 fresh drawn cells: docs/identify.md; FIT=1 refits the released posterior
	$(if $(FIT),$(RUN) -m simulation scene fit --out runs/identify --to simulation/studies/identify/posterior.npz)
	$(RUN) -m simulation scene judge --out runs/identify --docs docs

# ---- operations ---------------------------------------------------------------------------------------------------
# Containers with docker if available, else podman. CELL= names a cell: its settings are in docker/CELL.env.

CELL ?= cell-a
ENV_FILE ?= docker/$(CELL).env
COMPOSE ?= $(if $(shell docker compose version 2>/dev/null),docker compose,$(OPS_VENV)/bin/podman-compose)
OVERRIDE = $(wildcard docker/compose.override.yaml)
COMPOSE_FILE_ARGS = --project-name $(CELL) --file docker/compose.yaml $(if $(OVERRIDE),--file $(OVERRIDE))

image: $(OPS_VENV)/ready ## build the three images (service, robot client, simulated cell)
	$(COMPOSE) $(COMPOSE_FILE_ARGS) --profile live --profile robot --profile sim build

up: $(OPS_VENV)/ready ## start the service of a real cell (CELL=cell-a reads docker/cell-a.env; MONITORING=1 adds Prometheus, Grafana)
	@test -f $(ENV_FILE) || { echo "$(ENV_FILE) is missing: copy docker/cell.env.example and edit it" >&2; exit 2; }
	$(COMPOSE) --env-file $(ENV_FILE) $(COMPOSE_FILE_ARGS) --profile live $(if $(MONITORING),--profile monitoring) up --detach

up-sim: $(OPS_VENV)/ready ## start the simulated cell and the service in containers and insert one object
	COMPOSE="$(COMPOSE) $(COMPOSE_FILE_ARGS)" sh docker/up_sim.sh

down: $(OPS_VENV)/ready ## stop and remove the containers of CELL; recordings stay; MONITORING=1 also ends the monitoring of all cells
	$(COMPOSE) $(COMPOSE_FILE_ARGS) --profile live --profile robot --profile sim $(if $(MONITORING),--profile monitoring) down

robot: $(OPS_VENV)/ready ## run the robot client of CELL once (ARGS='check --config /etc/tactile/cell.toml')
	$(COMPOSE) --env-file $(ENV_FILE) $(COMPOSE_FILE_ARGS) --profile robot run --rm robot-client $(ARGS)

verify-images: $(OPS_VENV)/ready bundle ## build images and bundle, run the loop in them, kill the service during an insertion, print sizes and times
	PATH="$(CURDIR)/$(OPS_VENV)/bin:$$PATH" $(PYTHON) -m tests.docker.verify_images --outside "$(CURDIR)/$(RUN)" --bundle "$(CURDIR)/$$(ls -t dist/*.tar | head -n 1)"

lint-ops: $(OPS_VENV)/ready ## check Dockerfiles, alert rules (needs promtool, amtool) and manifests
	$(OPS_VENV)/bin/hadolint docker/*.Dockerfile
	promtool check config docker/prometheus/prometheus.yml
	promtool test rules docker/prometheus/alerts_test.yml
	amtool check-config docker/prometheus/alertmanager.yml
	$(OPS_VENV)/bin/kubernetes-validate --quiet --strict docker/kubernetes/cell.yaml

bundle: $(RUN_VENV)/ready ## archive for a cell without internet: wheels, code, models, installer, checksums -> dist/
	sh docker/bundle.sh $(RUN) dist

sbom: $(RUN_VENV)/ready $(OPS_VENV)/ready ## list every shipped dependency with its licence -> dist/
	sh docker/sbom.sh $(RUN) $(OPS_VENV)/bin dist

docs: $(DOCS_VENV)/ready ## the docs as a site for offline reading, build/site/index.html; fails on a broken link
	NO_MKDOCS_2_WARNING=1 $(DOCS_VENV)/bin/mkdocs build --strict

requirements: ## pin requirements/*.txt again (needs uv)
	sh requirements/compile.sh

clean: ## remove environments, builds and caches, but no data and no runs
	rm -rf $(VENV) $(RUN_VENV) $(OPS_VENV) $(PEERS_OF_THEIR_OWN) $(DOCS_VENV) $(LOWEST_VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
