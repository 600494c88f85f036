# Two commands do everything: `make run` and `make test`. They need Python 3.11, 3.12, 3.13 or 3.14 and nothing else.

SHELL := /bin/sh
VENV := .venv
BIN := $(VENV)/bin
TWIN := $(BIN)/khep-twin
# An interpreter to make the environment with; without one, the first fitting one of these.
PYTHON :=
PYTHONS := python3.12 python3.11 python3.13 python3.14 python3 python
PLAYPEN := obstacles
TESTS :=
BENCH :=
BROWSER :=
LONG :=
LONG_SHARE := 1

# An environment that is there stays what it is.
ifneq ($(and $(PYTHON),$(wildcard $(BIN)/python)),)
ifneq ($(shell $(PYTHON) --version),$(shell $(BIN)/python --version))
$(error $(VENV) has $(shell $(BIN)/python --version), expected that of PYTHON=$(PYTHON); to make it anew: make clean)
endif
endif

.PHONY: help run setup test check format long bench docs browser record lock build clean

help: ## show this list
	@grep -E '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/'

run: $(VENV)/run.stamp ## the main job: a Braitenberg vehicle for 60 simulated seconds
	@mkdir -p out
	@$(TWIN) run braitenberg --playpen $(PLAYPEN) --seconds 60 --seed 1 --log out/run.mcap --force --picture out/run.png
	@$(MAKE) --no-print-directory -s $(VENV)/compiled.stamp

setup: $(VENV)/dev.stamp ## the environment with the tools of the test suite; again after a change of pyproject.toml

# Python keeps its bytecode: otherwise each process translates all sources, and each worker all tests.
test: $(VENV)/dev.stamp ## the whole test suite
	@echo "khep_twin: $(or $(TESTS),the whole test suite: about five minutes on two cores)"
	@PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n auto --dist worksteal $(TESTS)

check: $(VENV)/dev.stamp ## style and types
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@for system in Linux Darwin Windows; do $(BIN)/pyright --pythonplatform $$system || exit 1; done

format: $(VENV)/dev.stamp ## put the code into its layout
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

long: $(VENV)/dev.stamp ## all long checks, a night, and a page of what they found, out/night/page.md; goes on where it stopped; LONG="fuzz-board day" for parts, LONG_SHARE=0.01 for less
	@$(BIN)/python -m checks night run --share $(LONG_SHARE) $(LONG)

record: $(VENV)/dev.stamp ## whether results are still those of tools/record.json; two minutes
	@$(BIN)/python -m tools record

browser: $(VENV)/dev.stamp ## the designer's page in Chromium, which has to be installed; leaves pictures in out/browser
	@$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --require-hashes -r requirements-browser.lock
	@$(BIN)/python -m pytest -n 0 $(BROWSER) tests/web/test_browser_*.py

docs: $(VENV)/dev.stamp ## the site: all pages, gallery, reference and a search, out/site/index.html; links are checked
	@$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --require-hashes -r requirements-site.lock
	@$(BIN)/python -m tools site out/site-source
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build -q
	@echo "site       out/site/index.html"

bench: $(VENV)/dev.stamp ## speed, as ratios to floors measured in the same run; three minutes, BENCH=--quick for a short one
	@$(BIN)/python -m benchmarks $(BENCH)

lock: $(VENV)/dev.stamp ## resolve the dependencies anew
	@$(BIN)/python -m pip install -q uv
	@$(BIN)/uv pip compile pyproject.toml --extra pictures --extra fit --extra rl --group build --group dm-control --universal --python-version 3.11 --generate-hashes --no-header -q --upgrade -o requirements.lock
	@$(BIN)/uv pip compile pyproject.toml --extra pictures --extra fit --extra rl --extra minari --extra foxglove --extra notebook --extra ray --extra ros --group dev --universal --python-version 3.11 --generate-hashes --no-header -q --upgrade -c requirements.lock -o requirements-dev.lock
	@$(BIN)/uv pip compile --group browser --universal --python-version 3.11 --generate-hashes --no-header -q --upgrade -c requirements-dev.lock -o requirements-browser.lock
	@$(BIN)/uv pip compile --group site --universal --python-version 3.11 --generate-hashes --no-header -q --upgrade -c requirements-dev.lock -o requirements-site.lock

build: $(VENV)/dev.stamp ## wheel and source archive, in dist/
	@$(BIN)/python -m hatchling build

clean: ## remove the environment and everything made
	@rm -rf $(VENV) .venv-* out docs/reference build dist .pytest_cache .ruff_cache

# The environment: exactly the locked versions, checked by hash. The locks are complete, so pip resolves
# nothing (--no-deps): it would ask for labmaze, which dm-control requires and which has no wheel from Python
# 3.13 on. Finding Python comes first, so that a missing tool gives one line and not a trace.
define MAKE_VENV
for python in $(or $(PYTHON),$(PYTHONS)); do \
  if $$python -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' 2>/dev/null; then \
    $$python -c 'import venv, ensurepip' 2>/dev/null || { \
      echo "khep_twin: $$python has no venv module; on Debian or Ubuntu: apt install $$($$python -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')" >&2; exit 1; }; \
    echo "khep_twin: making the environment in $(VENV) with $$($$python --version)"; \
    $$python -m venv --clear $(VENV) && exit 0 || exit 1; \
  fi; \
done; \
echo "khep_twin: needs Python 3.11 to 3.14, found $$($(or $(PYTHON),python3) --version 2>/dev/null || echo none)" >&2; exit 1
endef

$(VENV)/made.stamp:
	@$(MAKE_VENV)
	@touch $@

$(VENV)/run.stamp: $(VENV)/made.stamp requirements.lock pyproject.toml
	@echo "khep_twin: installing what it needs (about a minute, once)"
	@$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --require-hashes -r requirements.lock
	@$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

# Compiled code is kept between processes, so that the first run without a serial line does not wait for it.
$(VENV)/compiled.stamp: $(VENV)/run.stamp
	@$(TWIN) compile
	@touch $@

$(VENV)/dev.stamp: $(VENV)/run.stamp requirements-dev.lock
	@echo "khep_twin: installing the tools of the test suite (once)"
	@$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --require-hashes -r requirements-dev.lock
	@touch $@
