# Every target sets up its own environment in .venv first; nothing here needs root or system packages.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest

.PHONY: demo test test-slow test-browser test-oracle parity lint format clean

demo: $(READY)
	$(BIN)/freegeo demo --output out/demo

test: $(READY)
	$(PYTEST) -n 2

test-slow: $(READY)
	$(PYTEST) -m slow

test-browser: $(READY)
	$(PYTEST) -m browser

test-oracle: $(READY)
	$(BIN)/pip install -q -c constraints.txt open3d-cpu==0.19.0
	$(PYTEST) -m oracle

# FREEGEO_FIXTURES=DIR checks another folder of recorded numbers.
parity: $(READY)
	cd tests && OMP_NUM_THREADS=1 ../$(BIN)/python parity.py

lint: $(READY)
	$(BIN)/ruff check --no-cache
	$(BIN)/ruff format --check
	$(BIN)/ty check

format: $(READY)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# torch first and pinned: no other package may choose another build of it.
$(READY): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install -q -c constraints.txt torch
	$(BIN)/pip install -q -c constraints.txt -e '.[all]'
	touch $(READY)

clean:
	rm -rf .venv out build .pytest_cache .ruff_cache
