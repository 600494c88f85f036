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
SIGNALS := 1000
EDGES := 2000
BRANCHES := 200
NIGHT :=
NIGHT_SHARE := 1
TRIALS :=
HOURS := 1000

# An environment that is there stays what it is.
ifneq ($(and $(PYTHON),$(wildcard $(BIN)/python)),)
ifneq ($(shell $(PYTHON) --version),$(shell $(BIN)/python --version))
$(error $(VENV) has $(shell $(BIN)/python --version), expected that of PYTHON=$(PYTHON); to make it anew: make clean)
endif
endif

.PHONY: help run setup test wheels check format fuzz fuzz-files fuzz-logs fuzz-page fuzz-rfc2217 night edges branches simulate mutants twin-trials record recordings soak determinism kills day worker-kills signals pyserial browser schemas mjcf three commands docs docs-blocks reference tutorial bench fidelity lock build clean

help: ## show this list
	@grep -E '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/'

run: $(VENV)/run.stamp ## the main job: a Braitenberg vehicle for 60 simulated seconds
	@mkdir -p out
	@$(TWIN) run braitenberg --playpen $(PLAYPEN) --seconds 60 --seed 1 --log out/run.mcap --force --picture out/run.png
	@$(MAKE) --no-print-directory -s $(VENV)/compiled.stamp

setup: $(VENV)/dev.stamp ## the environment with the tools of the test suite; again after a change of pyproject.toml

test: $(VENV)/dev.stamp ## the whole test suite
	@echo "khep_twin: $(or $(TESTS),the whole test suite: about six minutes on two cores)"
	@$(BIN)/python -m pytest -n auto --dist worksteal $(TESTS)

wheels: $(VENV)/dev.stamp ## which locked packages have a wheel for Python 3.11 to 3.14, as pip says; a few minutes
	@$(BIN)/python tools/wheels.py

check: $(VENV)/dev.stamp ## style and types
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@for system in Linux Darwin Windows; do $(BIN)/pyright --pythonplatform $$system || exit 1; done

format: $(VENV)/dev.stamp ## put the code into its layout
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

fuzz: $(VENV)/dev.stamp ## a million inputs for the board, and 50,000 commands against its model; a quarter of an hour
	@$(BIN)/python tools/fuzz_board.py -runs=1000000
	@KHEP_COMMANDS=50000 $(BIN)/python -m pytest -q tests/board/test_board_against_model.py

fuzz-files: $(VENV)/dev.stamp ## damaged playpens, MAT files and PNGs, 1.4 million; about ten minutes
	@$(BIN)/python tools/fuzz_files.py mat 200000 --jobs 2
	@$(BIN)/python tools/fuzz_files.py png 200000 --jobs 2
	@$(BIN)/python tools/fuzz_files.py toml 1000000 --jobs 2

fuzz-logs: $(VENV)/dev.stamp ## a million changed logs, read, exported and recovered; 5,000 viewed, repeated, branched; about 40 minutes
	@$(BIN)/python tools/fuzz_logs.py -runs=1000000
	@$(BIN)/python tools/fuzz_log_uses.py -runs=5000

fuzz-page: $(VENV)/dev.stamp ## 100,000 inputs of up to four requests to the designer's page each; about half an hour
	@$(BIN)/python tools/fuzz_page.py -runs=100000

night: $(VENV)/dev.stamp ## all long checks, and a page of what they found, out/night/index.html; goes on where it stopped; NIGHT="parser soak" for parts, NIGHT_SHARE=0.01 for less
	@$(BIN)/python tools/night.py run --share $(NIGHT_SHARE) $(NIGHT)

fuzz-rfc2217: $(VENV)/dev.stamp ## a million connections that negotiate by RFC 2217, well or not; a quarter of an hour
	@$(BIN)/python tools/fuzz_rfc2217.py -runs=1000000

simulate: $(VENV)/dev.stamp ## 1,000 simulated hours of the whole system with faults at random; HOURS=1 for fewer; hours
	@$(BIN)/python -m tools.simulate run --hours $(HOURS)

mutants: $(VENV)/dev.stamp ## broken builds, each of which the simulation must catch
	@$(BIN)/python -m tools.simulate mutants

recordings: $(VENV)/dev.stamp ## logs of 300 sound robots with random hosts, in which conform must find nothing; ten minutes
	@$(BIN)/python tools/recorded_hosts.py 300

edges: $(VENV)/dev.stamp ## 2,000 random playpens at the edge of what the check lets pass, driven through at full speed; about an hour
	@$(BIN)/python tools/edge_playpens.py $(EDGES)

branches: $(VENV)/dev.stamp ## 200 random logs resumed at random moments, unchanged and changed; BRANCHES=20 for fewer; about ten minutes
	@$(BIN)/python tools/branches.py $(BRANCHES)

twin-trials: $(VENV)/dev.stamp ## shadows of stand-in robots beside the truth: poses, alarms, healthy hours, cost; TRIALS="pose --runs 4" for a part; hours
	@$(BIN)/python -m benchmarks.twin_trials --jobs 2 $(TRIALS)

soak: $(VENV)/dev.stamp ## hosts that misbehave for a minute each, 2,000 that come and go, 2,000 that leave a network port
	@KHEP_RUBBISH_SECONDS=60 KHEP_OPENINGS=2000 $(BIN)/python -m pytest tests/ports/test_chaos.py tests/ports/test_random_hosts.py
	@KHEP_LEAVINGS=1000 $(BIN)/python -m pytest -s tests/ports/test_leaving_hosts.py -k stale

record: $(VENV)/dev.stamp ## whether results are still those of tools/record.json; two minutes
	@$(BIN)/python tools/record.py

determinism: $(VENV)/dev.stamp ## 100,000 steps of an environment, the same bit for bit; a few minutes
	@$(BIN)/python tools/long_determinism.py

kills: $(VENV)/dev.stamp ## 200 served twins and 40 runs killed at random times, and what their logs lost; about ten minutes
	@$(BIN)/python tools/kills.py serve 200 --jobs 3
	@$(BIN)/python tools/kills.py run 40 --jobs 2

day: $(VENV)/dev.stamp ## 24 simulated hours of serve --log with a host that never stops asking, and what memory they take; about 20 minutes
	@$(BIN)/python tools/day.py 24

worker-kills: $(VENV)/dev.stamp ## 100 of Ray's workers killed in a sweep of 200 tasks; needs ray; about five minutes
	@$(BIN)/python tools/worker_kills.py --tasks 200 --kills 100

signals: $(VENV)/dev.stamp ## 1,000 signals at random moments of run, serve, design, sweep and sense; SIGNALS=100 for fewer; an hour
	@$(BIN)/python tools/signals.py $(SIGNALS) --jobs 2

pyserial: $(VENV)/dev.stamp ## pyserial's own test scripts against a looped-back line
	@$(BIN)/python tools/pyserial_suite.py

browser: $(VENV)/dev.stamp ## the designer's page in Chromium, which has to be installed; leaves pictures in out/browser
	@$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --require-hashes -r requirements-browser.lock
	@$(BIN)/python -m pytest -n 0 $(BROWSER) tests/web/test_browser_*.py

schemas: $(VENV)/dev.stamp ## Foxglove's published definition of a scene, as logs carry it
	@$(BIN)/python tools/foxglove_schema.py khep_twin/assets/foxglove_scene_update.bin

mjcf: $(VENV)/dev.stamp ## the shipped playpens as MJCF with a picture each, in mjcf; needs OpenGL
	@PYTHONPATH=. $(BIN)/python tools/mjcf.py

three: $(VENV)/dev.stamp ## three.js for the designer's page, from the npm registry; needs npm
	@$(BIN)/python tools/three_js.py khep_twin/assets/web

commands: $(VENV)/dev.stamp ## docs/commands.md, every command with its options, out of the help texts
	@$(BIN)/python tools/command_docs.py docs/commands.md

docs: $(VENV)/dev.stamp ## the site: all pages, gallery, reference and a search, out/site/index.html; links are checked
	@$(BIN)/python -m pip install -q --disable-pip-version-check --no-deps --require-hashes -r requirements-site.lock
	@PYTHONPATH=. $(BIN)/python tools/site.py out/site-source
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build -q
	@echo "site       out/site/index.html"

docs-blocks: $(VENV)/dev.stamp ## every block of the pages, run as a reader who copies it, the long ones, too; lists what cannot run; an hour
	@KHEP_DOCS=all $(BIN)/python -m pytest -n 0 -rP tests/test_docs_blocks.py

reference: $(VENV)/dev.stamp ## pages of every public function and class, docs/reference/index.html
	@$(BIN)/python tools/reference.py docs/reference
	@echo "reference  docs/reference/index.html"

tutorial: $(VENV)/dev.stamp ## the tutorial's numbers and the docs' pictures anew, by their own commands; needs Vulkan
	@$(BIN)/python tools/tutorial.py
	@PYTHONPATH=. $(BIN)/python tools/pictures.py

bench: $(VENV)/dev.stamp ## speed, as ratios to floors measured in the same run; three minutes, BENCH=--quick for a short one
	@$(BIN)/python -m benchmarks $(BENCH)

fidelity: $(VENV)/dev.stamp ## docs/fidelity.md, twin and reality compared; needs KHEP_TWIN_REFERENCE_DATA; two minutes
	@$(BIN)/python -m benchmarks.fidelity

lock: $(VENV)/dev.stamp ## resolve the dependencies anew
	@$(BIN)/python -m pip install -q uv
	@$(BIN)/uv pip compile pyproject.toml --extra pictures --extra fit --extra rl --group build --group dm-control --universal --python-version 3.11 --generate-hashes --no-header -q --upgrade -o requirements.lock
	@$(BIN)/uv pip compile pyproject.toml --all-extras --group dev --universal --python-version 3.11 --generate-hashes --no-header -q --upgrade -c requirements.lock -o requirements-dev.lock
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
