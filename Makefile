# Everything a fresh machine needs is created inside the checkout: uv in .tools/, the
# environment in .venv/ with the Python named in .python-version, or another one:
# make setup PYTHON_VERSION=3.12 (kept until another is named). Needs python3 with venv and pip,
# git and make; docs/install.md.
.DEFAULT_GOAL := help

PYTHON ?= python3
UV_VERSION := 0.13.8
TOOLS := .tools
UV := $(TOOLS)/bin/uv
STAMP := .venv/.synced
CHOSEN := .venv/.python-version
COLLECTED := .venv/.tests-compiled

LAST_VERSION := $(shell cat $(CHOSEN) 2>/dev/null)
PYTHON_VERSION ?= $(or $(LAST_VERSION),$(shell cat .python-version))
# uv does not look into pyenv's folder, and pyenv's shims run only what is switched on
FOUND_BY_PYENV := $(lastword $(sort $(wildcard \
	$(or $(PYENV_ROOT),$(HOME)/.pyenv)/versions/$(PYTHON_VERSION).*/bin/python)))
# with DDS; without it, newer ones may work
SUPPORTED := $(foreach v,3.10 3.11 3.12 3.13,$(v) $(v).%)
UNSUPPORTED = $(if $(filter no,$(DDS)),,$(if $(filter $(SUPPORTED),$(PYTHON_VERSION)),,$(error \
	Python $(PYTHON_VERSION) cannot be used: dexkit needs 3.10 to 3.13 (docs/install.md))))
FOR_PYTHON := --python $(or $(FOUND_BY_PYENV),$(PYTHON_VERSION))
# Not 'uv run': where another interpreter of this version is found than at the set-up, it makes the
# environment anew, without DDS, and every test on DDS is skipped.
RUN := PATH="$(CURDIR)/.venv/bin:$$PATH"

# An environment activated by the caller must not leak in.
# Nor may bytecode go unwritten: hundreds of processes would each compile NumPy.
unexport VIRTUAL_ENV PYTHONPATH PYTHONDONTWRITEBYTECODE

$(UV):
	@command -v $(PYTHON) >/dev/null || { echo "error: $(PYTHON) not found; set PYTHON=/path/to/python3" >&2; exit 2; }
	@echo "installing uv $(UV_VERSION) into $(TOOLS)/"
	@$(PYTHON) -m venv $(TOOLS)
	@$(TOOLS)/bin/python -m pip install --quiet --disable-pip-version-check "uv==$(UV_VERSION)"

$(STAMP): pyproject.toml uv.lock .python-version | $(UV)
	$(UNSUPPORTED)
	@$(UV) sync --frozen --quiet $(FOR_PYTHON)
ifneq ($(DDS),no)
	@.venv/bin/python -c 'import cyclonedds.core' 2>/dev/null || .venv/bin/dexkit setup-dds || { \
		echo "  or without DDS: make setup DDS=no" >&2; exit 2; }
endif
	@echo '$(PYTHON_VERSION)' > $(CHOSEN)
	@touch $@

ifneq ($(PYTHON_VERSION),$(LAST_VERSION))
.PHONY: $(STAMP)
endif

.PHONY: help setup demo test test-all mutants soak pins consequences coverage platforms aarch64 lab wheels campaign campaign-sample lint format docs docs-site pictures bench lock clean

help: ## this list
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 18

setup: $(STAMP) ## create the environment (PYTHON_VERSION=3.12 for another Python, DDS=no without DDS)

demo: $(STAMP) ## the conformance suite on two emulated EZGrippers; writes demo-out/report.html
	@$(RUN) dexkit demo --out demo-out

# Otherwise each worker rewrites the assertions of every test module.
$(COLLECTED): $(STAMP) $(wildcard tests/*.py)
	@echo "compiling the tests"
	@$(RUN) pytest --collect-only --quiet >/dev/null || true
	@touch $@

test: $(STAMP) $(COLLECTED) ## the tests, six workers for two cores (ARGS="-k name" is passed on)
	$(RUN) pytest -n auto --dist worksteal -m "not soak and not slow" $(ARGS)

test-all: $(STAMP) $(COLLECTED) ## the tests with those marked slow, as CI runs them (ARGS as for make test)
	$(RUN) pytest -n auto --dist worksteal -m "not soak" $(ARGS)

mutants: $(STAMP) ## the conformance checks on deliberately wrong hands (ARGS="--model h1"; docs/mutants.md)
	$(RUN) python -m dexkit.conformance.faults $(ARGS)

soak: $(STAMP) ## the long tests
	$(RUN) pytest -m soak $(ARGS)

pins: $(STAMP) ## whether each wrong hand and sample is judged as pinned (ARGS="--only dds-dex3-1", ARGS=--update; docs/mutants.md)
	$(RUN) python -m tools.pins $(ARGS)

consequences: $(STAMP) ## what a client suffers from each wrong hand; writes tools/consequences/table.json (ARGS="--only dex3-1")
	$(RUN) python -m tools.consequences $(ARGS)

campaign: $(STAMP) ## fuzz and fault campaign: MINUTES=10 SEED=1 JOBS=2 ONLY=fuzz,kill:record (docs/campaign.md)
	$(RUN) python -m tools.campaign $(if $(MINUTES),--minutes $(MINUTES)) $(if $(SEED),--seed $(SEED)) \
		$(if $(JOBS),--jobs $(JOBS)) $(if $(ONLY),--only $(ONLY)) $(ARGS)

campaign-sample: $(STAMP) ## a short form of each case of the campaign, two minutes
	$(RUN) python -m tools.campaign --sample $(if $(JOBS),--jobs $(JOBS)) $(ARGS)

platforms: $(STAMP) ## each Python from 3.10 to 3.13: DDS, conformance, both directions with the 0.10.2 wheel
	$(RUN) python -m tools.platforms $(ARGS)

aarch64: $(STAMP) ## dexkit on an emulated aarch64 processor (qemu-user), driven over DDS by a client on x86-64
	$(RUN) python -m tools.aarch64 $(ARGS)

lab: $(STAMP) ## a real kernel in QEMU with the emulated devices plugged in (ARGS="--only dex3"; docs/lab.md)
	$(RUN) python -m tools.lab $(ARGS)

wheels: $(STAMP) ## self-contained wheels of cyclonedds into dist/wheels: SOURCE=checkout of its C library
	$(RUN) python -m tools.wheels --source "$(or $(SOURCE),$(error SOURCE must name a checkout: \
		git clone --branch 0.10.5 --depth 1 https://github.com/eclipse-cyclonedds/cyclonedds))" $(ARGS)

lint: $(STAMP) ## ruff and mypy strict
	$(RUN) ruff check .
	$(RUN) ruff format --check .
	$(RUN) mypy

format: $(STAMP) ## put the code in ruff's format
	$(RUN) ruff check --fix .
	$(RUN) ruff format .

docs: $(STAMP) ## write the generated files, and into build/docs the pages of requirements and models (ARGS=--check compares)
	$(RUN) python -m tools.generate $(ARGS)

coverage: $(STAMP) ## what each requirement reads and what is sent to it, as grids with their holes: build/coverage.md
	$(RUN) python -m tools.coverage

docs-site: $(STAMP) ## the documentation as a site in build/site, with search, requirements and API; checks every link
	$(UV) run --frozen --python .venv/bin/python --group site python -m mkdocs build --quiet -f tools/site/mkdocs.yml $(ARGS)

pictures: $(STAMP) ## make the pictures of docs/images that a browser draws (ARGS=view-hands makes one)
	$(RUN) python -m tools.pictures $(ARGS)

bench: $(STAMP) ## the benchmarks; prints ratios, saves benchmarks/results/*.json and index.html
	$(RUN) python -m benchmarks $(ARGS)

lock: | $(UV) ## resolve the dependencies again
	$(UV) lock --upgrade

clean: ## remove everything that make created
	rm -rf $(TOOLS) .venv build dist demo-out platforms-out campaign-out benchmarks/results .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
