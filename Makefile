# Two commands do everything: `make demo` and `make test`. Both set up .venv once and reuse it.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DEV := $(VENV)/.ready-dev
DOCS := $(VENV)/.ready-docs
OLDEST := .venv-oldest
# The CPU build of torch, which tests need: the default one brings gigabytes of CUDA. For a GPU set TORCH_INDEX. The
# version is one that every test has run with: where an index is not reached, a range could bring the CUDA build.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
TORCH ?= torch==2.13.0

.PHONY: demo test test-slow coverage test-oldest lint check docs results setup clean

demo: $(READY)
	$(BIN)/conformodal demo --out demo-out

test: $(DEV)
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

# trainings and whole commands; tests of one file share what they made, and conftest.py puts the longest files first
test-slow: $(DEV)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m slow

# all tests, with the lines that none reaches; measuring them takes the tests much longer
coverage: $(DEV)
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --cov --cov-report=term

# quick tests, and those with the small trained model, with the oldest version of each package that pyproject.toml
# allows, in an environment of its own. Python 3.11, for which all of them have wheels. Without the extra view: its
# package needs NumPy 2. Without an index of CPU builds, torch brings gigabytes of CUDA.
test-oldest:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || { echo "the oldest versions have wheels for Python 3.11; found $$($(PYTHON) --version). Set PYTHON=..."; exit 1; }
	$(PYTHON) -m venv $(OLDEST)
	$(OLDEST)/bin/python scripts/oldest.py > $(OLDEST)/oldest.txt
	$(OLDEST)/bin/python -m pip install --quiet --upgrade "pip>=25.1"
	$(OLDEST)/bin/python -m pip install --quiet --constraint $(OLDEST)/oldest.txt --editable '.[train,arrow,save,hub,networks,ray,ros,colmap]' --group dev --retries 1 --extra-index-url $(TORCH_INDEX)
	$(OLDEST)/bin/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder -m "not slow or trained"

lint: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check: test test-slow lint

# the site, in site/; a warning is an error
docs: $(DOCS)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

# every table of benchmarks/results, from one revision without changes; data sets lie in $CONFORMODAL_DATA
results: $(DEV)
	$(BIN)/python -m pip install --quiet --no-deps -r benchmarks/peers/requirements.txt -r benchmarks/peers/recordings.txt
	$(BIN)/python benchmarks/results.py

setup: $(DEV)

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "conformodal needs Python 3.11 or newer; found $$($(PYTHON) --version). Set PYTHON=..."; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' || { echo "Python's venv module is missing; on Debian: apt install python3-venv"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable '.[train]'
	@touch $(READY)

# what tests, linters and optional extras need on top
$(DEV): $(READY) pyproject.toml
	$(BIN)/python -m pip install --quiet --no-deps --retries 1 --index-url $(TORCH_INDEX) "$(TORCH)"
	$(BIN)/python -m pip install --quiet --editable '.[all]' --group dev
	@touch $(DEV)

# the site is made from the source alone: nothing of the package is installed for it
$(DOCS): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --group docs
	@touch $(DOCS)

clean:
	rm -rf $(VENV) $(OLDEST) demo-out site
