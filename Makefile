# make demo | test | test-all | test-endurance | bench | lint | docs: each sets up what it needs in .venv first.
SHELL := /bin/bash
PYTHON ?= python3
BIN := .venv/bin
OUT := out
# One more than two processors: many tests wait.
WORKERS ?= 3
# Of the slow tests: 1/6 to 6/6 for a sixth of them.
PART ?= 1/1

comma := ,

# Without Python's bytecode each of some hundred processes of the tests, and each worker at each collection, compiles all modules.
unexport PYTHONDONTWRITEBYTECODE

# Installs with pip, says every ten seconds that it goes on, and notes what is there now. With --jobs, one pip waits for another.
define install
@echo "Installing $(1) into .venv, once; all that a first run needs takes 1.1 GB and some minutes."
@( for ((s = 10; ; s += 10)); do sleep 10 >/dev/null 2>&1 </dev/null; echo "  still installing: $$s s"; done ) & \
	clock=$$!; trap "kill $$clock" EXIT; flock .venv $(BIN)/pip install --quiet --constraint constraints.txt --editable '$(1)'
@touch $(2)
endef

.PHONY: demo test test-all test-endurance bench bench-loop bench-fusion bench-faults lint docs docs-links clean
.DELETE_ON_ERROR:

demo: .venv/installed
	@mkdir -p $(OUT)
	$(BIN)/gough simulate --report $(OUT)/demo.html --json $(OUT)/demo.json
	@echo "Open $(OUT)/demo.html in a browser to see it move."

# The matrices are small: threads of BLAS would only wait for each other.
test test-all test-endurance: export OPENBLAS_NUM_THREADS = 1

test: .venv/installed-test
	$(BIN)/pytest -n $(WORKERS) --dist worksteal -m "not slow and not endurance"

test-all: test
	$(BIN)/pytest -n $(WORKERS) --dist worksteal -m "slow and not endurance" --hypothesis-profile=all --durations=25 --part $(PART)

test-endurance: .venv/installed-test
	$(BIN)/pytest -n $(WORKERS) --dist worksteal -m "endurance or hypothesis" --hypothesis-profile=all

bench: bench-loop bench-fusion bench-faults

bench-loop: .venv/installed-all
	@mkdir -p $(OUT)
	$(BIN)/gough bench --json $(OUT)/bench.json $(BENCH)

bench-fusion: .venv/installed-all
	@mkdir -p $(OUT)
	$(BIN)/gough compare-fusion --json $(OUT)/fusion.json $(FUSION)
	$(BIN)/gough evaluate-fusion --json $(OUT)/evaluation.json $(EVALUATION)

bench-faults: .venv/installed-all
	@mkdir -p $(OUT)
	$(BIN)/gough faults --results $(OUT)/faults --json $(OUT)/faults.json $(FAULTS)

lint: .venv/installed-lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --strict
	$(BIN)/lint-imports

docs: .venv/installed-docs
	@mkdir -p $(OUT)
	$(BIN)/sphinx-build -n -W --keep-going -q -E docs $(OUT)/docs
	@echo "Open $(OUT)/docs/index.html in a browser."

# The links to the outside: needs the network.
docs-links: .venv/installed-docs
	$(BIN)/sphinx-build -q -E -b linkcheck docs $(OUT)/links

clean:
	rm -rf .venv build dist $(OUT) *.egg-info

.venv/bin/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo "gough needs Python 3.11 or newer as '$(PYTHON)': install it, or run 'make PYTHON=/path/to/python3.11'"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || \
		{ echo "Python's venv module is missing: install it, on Debian with 'apt install python3-venv'"; exit 1; }
	@command -v cc >/dev/null || command -v gcc >/dev/null || command -v clang >/dev/null || \
		{ echo "a C compiler is missing (it builds the plant): install one, on Debian with 'apt install gcc libc6-dev'"; exit 1; }
	$(PYTHON) -m venv .venv

# Each of these has all of those above it, so that whoever needs the last calls pip once.
INSTALLED := .venv/installed
$(INSTALLED) $(INSTALLED)-all $(INSTALLED)-docs $(INSTALLED)-test $(INSTALLED)-lint: pyproject.toml constraints.txt | .venv/bin/pip
$(INSTALLED):
	$(call install,.[reports],$@)
$(INSTALLED)-all:
	$(call install,.[all],$(INSTALLED) $@)
$(INSTALLED)-docs:
	$(call install,.[docs],$(INSTALLED) $(INSTALLED)-all $@)
$(INSTALLED)-test:
	$(call install,.[test],$(INSTALLED) $(INSTALLED)-all $(INSTALLED)-docs $@)
$(INSTALLED)-lint:
	$(call install,.[test$(comma)lint],$(INSTALLED) $(INSTALLED)-all $(INSTALLED)-docs $(INSTALLED)-test $@)
