# Two commands on a fresh machine: `make demo` and `make test`. `make test-all` adds the slow tests,
# `make fuzz` tries 100,000 damaged inputs (an hour and a quarter), `make soak` drives 100 simulated cars for a week;
# `make nightly` is all of these, the soak for two hours.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
JOBS ?= 2
# PyTorch's own index of CPU builds: on Linux the default build brings some 3 GB of CUDA libraries that avtorch does not
# need. Where it cannot be reached pip warns and takes the default build. `make demo TORCH_INDEX=...` names another one.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
# pip would compile 18,000 files, of which most are never imported; an import compiles its own.
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --no-compile --constraint constraints.txt

# One thread per process: the tests run in parallel, and small tensors gain nothing from more.
export OMP_NUM_THREADS ?= 1
export MKL_NUM_THREADS ?= 1
# The tests start hundreds of interpreters, each of which would compile the package anew.
unexport PYTHONDONTWRITEBYTECODE

# Inputs of the fuzzer's nightly mode.
FUZZ ?= 100000
# Options of the soak: --cars, --hours (simulated), --minutes (of this machine), --folder.
SOAK ?= --cars 100 --hours 168
# Minutes that the soak may take in a night; the next night goes on from there.
SOAK_MINUTES ?= 120

.PHONY: demo test test-all fuzz soak nightly lint docs notebooks release clean

demo: $(VENV)/.installed
	$(BIN)/avtorch run --out out/demo
	@echo
	@echo "The pictures are in $(CURDIR)/out/demo:"
	@ls out/demo/*.png | sed 's/^/  /'
	@echo "All on one page, with what they say: $(CURDIR)/out/demo/run.html"

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile -m "not slow" $(PYTEST_ARGS)

test-all: $(VENV)/.installed-sumo
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile $(PYTEST_ARGS)

fuzz: $(VENV)/.installed-dev
	AVTORCH_FUZZ=$(FUZZ) $(BIN)/python -m pytest tests/fuzz $(PYTEST_ARGS)

# Ctrl-C ends it; the same command goes on from there. Exit code 1 where an answer, a count or memory is wrong.
soak: $(VENV)/.installed-dev
	$(BIN)/python -m benchmarks.soak $(SOAK)

# Each is run, whatever becomes of the one before. The tests marked `gpu` are among all tests, and skipped without a card.
nightly: $(VENV)/.installed-sumo
	@$(BIN)/python -c 'import torch as t; print("Tests marked gpu:", t.cuda.is_available() and "run" or "skipped, no card")'
	status=0; for what in test-all fuzz soak; do \
	  $(MAKE) $$what SOAK="$(SOAK) --minutes $(SOAK_MINUTES)" || status=1; \
	done; exit $$status

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports

docs: $(VENV)/.installed-docs
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet --doctree-dir out/.doctrees docs out/docs
	@echo "The pages are in $(CURDIR)/out/docs; begin with index.html"

# executes each notebook that differs from its source (NOTEBOOKS=--all: every one; NOTEBOOKS=4: that one) and writes its
# pair, the .ipynb beside it, which the pages show; the fifth needs recordings, AVTORCH_DATA
notebooks: $(VENV)/.installed-dev
	$(BIN)/python -m notebooks.pairing $(NOTEBOOKS)

# wheel, source archive, SBOM and licences in dist/, tried in an environment without extras; some minutes
release:
	PYTHON=$(PYTHON) TORCH_INDEX=$(TORCH_INDEX) .ci/release

clean:
	rm -rf $(VENV) out build dist

$(VENV)/.torch: constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "avtorch needs Python 3.11 or newer; try: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	@echo "Installing PyTorch (CPU build) ..."
	$(PIP) --quiet --retries 1 --extra-index-url $(TORCH_INDEX) torch
	@touch $@

$(VENV)/.installed: $(VENV)/.torch pyproject.toml
	$(PIP) --editable .
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.torch pyproject.toml
	$(PIP) --editable '.[dev]'
	@touch $@ $(VENV)/.installed

# what only the slow tests need, too heavy for `make test`; those of the report also need the system's Chromium
# (Debian: chromium-headless-shell), those of MQTT a broker (Debian: mosquitto), and are skipped without them
$(VENV)/.installed-sumo: $(VENV)/.installed-dev
	$(PIP) --editable '.[sumo,browser]'
	@touch $@

$(VENV)/.installed-docs: $(VENV)/.torch pyproject.toml
	$(PIP) --editable '.[docs]'
	@touch $@ $(VENV)/.installed
