# The same few commands everywhere. They need python3 (3.11 or newer) with venv, pip, git and make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
MINUTES ?= 1.2
# What is measured, and where the development set lies.
SUITE ?= engine
DATA ?= $(or $(POISE_DATA),$(HOME)/.cache/poise/data)

.DEFAULT_GOAL := help
.PHONY: help install dev demo open live test test-all check format bench docs clean

help:
	@echo "make demo    install into $(VENV), train on a walk for $(MINUTES) minutes, write demo/"
	@echo "make open    install into $(VENV), open the page for animators in the browser"
	@echo "make live    install into $(VENV), show a character in the browser that can be pushed"
	@echo "make test    run the quick tests, in minutes"
	@echo "make test-all run every test: also of trainings, processes, browsers, docs and benchmarks"
	@echo "make check   lint, formatting, types, order of imports"
	@echo "make format  mend formatting and simple lint"
	@echo "make bench   measure what is missing of SUITE=engine (all: every suite) with the clips in DATA=FOLDER"
	@echo "make docs    fill the documents from results/ and the code, check them, build their site into site/"
	@echo "make clean   remove $(VENV), demo/ and caches"

# The stamps make installing idempotent: it happens again only when what is installed changes.
$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Poise needs Python 3.11 or newer; name one with: make PYTHON=python3.12 ..." >&2; exit 1; }
	@test -x $(BIN)/python && $(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV) || \
	  { echo "The venv module is missing; on Debian and Ubuntu install python3-venv." >&2; exit 1; }
	$(PIP) install --quiet -c constraints.txt -e .
	@touch $@

$(VENV)/.dev: $(VENV)/.installed
	$(PIP) install --quiet -c constraints.txt -e '.[dev]'
	@touch $@

install: $(VENV)/.installed

dev: $(VENV)/.dev

demo: $(VENV)/.installed
	@rm -rf demo
	$(BIN)/poise demo -o demo --minutes $(MINUTES)
	@echo "The report:               demo/report.html (open it in a browser)"
	@echo "The simulated motion:     demo/simulated.bvh"
	@echo "The score card:           demo/score.json"

open: $(VENV)/.installed
	$(BIN)/poise open src/poise/data/walk.bvh

live: $(VENV)/.installed
	$(BIN)/poise live --open

# Two at once: fixtures of a file are made once, and files that take long come first (tests/conftest.py).
PYTEST = $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder
test: $(VENV)/.dev
	$(PYTEST) -m 'not (process or browser or learned or training or data or docs or benchmarks)'

test-all: $(VENV)/.dev
	$(PYTEST) $(if $(DURATIONS),--durations=$(DURATIONS))

check: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

format: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.dev
	$(BIN)/python -m benchmarks $(SUITE) --data '$(DATA)'

# Tables and generated pages are filled from results/ and the code. The site is built where its packages can
# be installed, in an environment of its own; without network it is left out, which is no failure.
DOCS := $(VENV)/docs
docs: $(VENV)/.installed
	$(BIN)/python docs/generate.py $(if $(CHECK),--check)
	$(BIN)/python docs/check_text.py
	$(BIN)/python docs/check_links.py
	@if $(DOCS)/bin/mkdocs --version >/dev/null 2>&1 || { $(PYTHON) -m venv $(DOCS) >/dev/null 2>&1 && \
	    $(DOCS)/bin/python -m pip install --disable-pip-version-check --quiet --retries 1 --timeout 15 \
	      -c constraints.txt mkdocs mkdocs-material >/dev/null 2>&1; }; then \
	  NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/mkdocs build --strict --quiet && echo "The site: site/index.html"; \
	else \
	  echo "The site was not built: its packages (mkdocs-material) cannot be installed here."; \
	fi

clean:
	rm -rf $(VENV) demo site build dist .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	rm -rf src/*.egg-info MUJOCO_LOG.TXT
	find src tests benchmarks training docs -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true
