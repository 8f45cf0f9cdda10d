# Everything runs in .venv, made on first use: with uv where it is there, else with venv and pip.
# A user needs Python 3.11 or newer and make.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.ready
FRESH := .venv/.fresh
# many small matrix products: threads inside each would only wait for each other
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: demo test check prove bench format lock clean

demo: $(FRESH)  ## simulate a hall, run the receiver on it, show picture and table
	$(BIN)/sonofix demo

test: check  ## every check and every test
	$(BIN)/python -m pytest -n auto --dist loadfile

check: $(FRESH)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

prove: $(FRESH)  ## long statistics (many minutes); prints tables and renews docs/statistics.md
	$(BIN)/python benchmarks/prove.py docs/statistics.md

bench: $(FRESH)  ## benchmarks against peers and floors in the same run (a quarter of an hour); renews the documents' tables
	$(BIN)/python benchmarks/street.py --into docs/benchmarks.md
	$(BIN)/python benchmarks/updates.py --into docs/benchmarks.md
	$(BIN)/python benchmarks/adaptive.py --into docs/studies.md
	$(BIN)/python benchmarks/accuracy.py --into README.md

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

lock:  ## renew requirements.lock (needs uv)
	uv pip compile --quiet --universal --python-version 3.11 --no-header --no-annotate --no-emit-index-url \
	  --no-emit-find-links --generate-hashes --all-extras --group dev --group peers pyproject.toml -o requirements.lock

$(STAMP): pyproject.toml requirements.lock
	@if command -v uv >/dev/null 2>&1; then \
	  test -x $(BIN)/python || uv venv --quiet --python $(PYTHON) .venv; \
	  uv pip install --quiet --compile-bytecode --python $(BIN)/python --require-hashes -r requirements.lock; \
	  uv pip install --quiet --python $(BIN)/python --no-deps -e .; \
	else \
	  test -x $(BIN)/python || $(PYTHON) -m venv .venv; \
	  $(BIN)/python -m pip install --quiet --require-hashes -r requirements.lock; \
	  $(BIN)/python -m pip install --quiet --no-deps -e .; \
	fi
	@touch $@

# a compiled kernel is renewed when its own file changes, not when one that it inlines does: after a change all go
$(FRESH): $(STAMP) $(shell grep -rl --include='*.py' njit src)
	@find src \( -name '*.nbi' -o -name '*.nbc' \) -delete
	@touch $@

clean:
	rm -rf .venv demo
