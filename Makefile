# Every target sets up its own environment in .venv first; nothing here needs root or system packages.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest

.PHONY: demo docs torture test test-slow test-browser test-oracle test-matrix parity lint format lock licences audit clean

demo: $(READY)
	$(BIN)/freegeo demo --output out/demo

test: $(READY)
	$(PYTEST) -n 2

test-slow: $(READY)
	$(PYTEST) -n 2 -m slow

test-browser: $(READY)
	$(PYTEST) -m browser

test-oracle: $(READY)
	$(BIN)/pip install -q -c constraints.txt -e '.[oracle]'
	$(PYTEST) -m oracle

# Strictly: a broken link, a page that is nowhere in the navigation and a public name without a docstring fail.
docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict -d out/site

# Hours: damages every kind of file that is read, kills and disturbs whole commands, and adapts again and again. TORTURE: number of cases and seed.
TORTURE := 20000 1
torture: $(READY)
	cd tests && export OMP_NUM_THREADS=1; ../$(BIN)/python -m torture.fuzz $(TORTURE) && \
	    ../$(BIN)/python -m torture.crash && ../$(BIN)/python -m torture.faults && ../$(BIN)/python -m torture.soak

# The suite with each instruction set of PyTorch and code path of MKL, with one and two threads: one line per setting.
# MATRIX_ARGS are passed on to pytest; reports of failures stay in out/matrix.
MATRIX := native ATEN_CPU_CAPABILITY=default ATEN_CPU_CAPABILITY=avx2 MKL_CBWR=COMPATIBLE MKL_CBWR=AVX2
test-matrix: $(READY)
	@mkdir -p out/matrix; failed=0; for threads in 1 2; do for setting in $(MATRIX); do \
	    log=out/matrix/$$setting-$$threads.txt; begun=$$(date +%s); \
	    if env $${setting#native} OMP_NUM_THREADS=$$threads $(BIN)/python -m pytest -n $$((3 - threads)) \
	        $(MATRIX_ARGS) >$$log 2>&1; then word=passed; else word=FAILED; failed=1; fi; \
	    echo "$$setting, threads: $$threads: $$word in $$(($$(date +%s) - begun)) s: $$(tail -1 $$log)"; \
	done; done; exit $$failed

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

# Everything but torch comes with its hashes. torch is pinned by its version alone, since its builds differ by machine and
# index; what it needs besides is there by then, but for the libraries of a CUDA build. Nothing is resolved anew.
$(READY): pyproject.toml constraints.txt requirements.lock
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install -q --no-deps --require-hashes -r requirements.lock
	$(BIN)/pip install -q -c constraints.txt torch
	$(BIN)/pip install -q --no-deps --no-build-isolation -e .
	$(BIN)/pip check
	touch $(READY)

# The hashes of every file that the index has of the versions in constraints.txt, for all platforms.
lock:
	test -x out/uv/bin/python || $(PYTHON) -m venv out/uv
	out/uv/bin/pip install -q uv==0.13.9
	out/uv/bin/uv pip compile -q -U --no-deps --universal --python-version 3.11 --generate-hashes --no-annotate \
	    --no-emit-package torch --custom-compile-command 'make lock' constraints.txt -o requirements.lock

licences: $(READY)
	$(BIN)/python tools/licences.py

# What is installed fits together, and its licences are those of docs/licences.md.
audit: $(READY)
	$(BIN)/pip check
	$(BIN)/python tools/licences.py --check

clean:
	rm -rf .venv out build .pytest_cache .ruff_cache
