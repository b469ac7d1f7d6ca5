PYTHON ?= python3
BIN := .venv/bin
SETUP := .venv/.ready
SITE := .venv/.site
KERNELS ?= Nehalem
ALGEBRA := tests/invariant_sets tests/mpc tests/inner/invariant_sets tests/inner/mpc
NO_ALGEBRA := notebook or benchmark or codegen or plotting or import or bad_input or wrong_calls
PYTEST := $(BIN)/python -m pytest -n 2 --dist worksteal
export OMP_NUM_THREADS ?= 1

.PHONY: run test quick check kernels targets lint bench docs notebooks pictures clean
.DELETE_ON_ERROR:

run: $(SETUP)          ## a semi-active car on its sensors, two generations, within two minutes on two cores
	$(BIN)/ccdtools run semi_active_sensors --jobs 2 $(ARGS)

test: $(SETUP)         ## lint, types, import contracts and every quick test: within five minutes on two cores
	@$(MAKE) --no-print-directory --jobs 2 lint quick

quick: $(SETUP)        ## every quick test
	$(PYTEST) -m "not check and not long and not slow" --durations 5 --durations-min 4

check: $(SETUP)        ## everything else: whole runs, notebooks, long sweeps, and an old processor's kernels
	$(PYTEST) -m "(check or long) and not slow"
	@$(MAKE) --no-print-directory kernels

kernels: $(SETUP)      ## quick tests of the numerical packages with the OpenBLAS kernels of processors without AVX; KERNELS="Sandybridge Zen" for others
	@for kernel in $(KERNELS); do echo "OpenBLAS kernels: $$kernel"; \
	OPENBLAS_CORETYPE=$$kernel $(PYTEST) -m "not check and not slow" -k "not ($(NO_ALGEBRA))" $(ALGEBRA) || exit 1; done

targets: $(SETUP)      ## the long studies: seeds 1 and 2 of every target, the whole drive with every seed
	$(PYTEST) -m slow

lint: $(SETUP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/lint-imports
	$(BIN)/mypy

bench: $(SETUP)        ## side by side with peers
	for f in benchmarks/bench_*.py; do $(BIN)/python $$f || exit 1; done

docs: $(SITE)          ## the site, in build/docs; warnings are errors
	$(BIN)/python -m sphinx -W --keep-going -q docs build/docs

notebooks: $(SETUP)    ## run every notebook and keep what it shows, ten minutes
	$(BIN)/python docs/run_notebooks.py

pictures: $(SETUP)     ## the pictures of the pages, each by its script
	for f in docs/pictures/[!_]*.py; do $(BIN)/python $$f || exit 1; done

$(SITE): $(SETUP) requirements/docs.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements/docs.txt
	@touch $@

$(SETUP): requirements/run.txt requirements/dev.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "ccdtools needs Python >= 3.11; make PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements/dev.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	$(BIN)/python -c 'from mpc.explicit.mpqp import compile_exploration; compile_exploration()'
	@touch $@

clean:
	rm -rf .venv build *.egg-info runs
