# Two commands for a fresh machine with Python 3.11 or newer: make demo, make test.
# Both set up .venv by themselves, and again when pyproject.toml changes.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip -qq --disable-pip-version-check

.PHONY: demo test docs bench clean

demo: $(VENV)/.installed-demo
	@$(BIN)/testbed run scenarios/demo.toml --out runs/demo
	@echo
	@echo "Open the report in a browser: file://$(CURDIR)/runs/demo/report.html"

test: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache
	$(BIN)/pytest -n 2 --dist loadfile

docs: $(VENV)/.installed-docs
	@$(BIN)/python docs/generate.py
	@$(BIN)/sphinx-build -q -W -b html docs docs/_build/html
	@echo "Open the pages in a browser: file://$(CURDIR)/docs/_build/html/index.html"

bench: $(VENV)/.installed-dev
	@$(BIN)/python -m benchmarks

clean:
	rm -rf $(VENV) build dist runs docs/_build .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "Python 3.11 or newer is needed; name it: make PYTHON=python3.12 demo" >&2; exit 1; }
	@echo "Setting up $(VENV) …"
	@rm -rf $(VENV)
	@$(PYTHON) -m venv $(VENV) || \
	    { rm -rf $(VENV); echo "Python lacks its venv module (on Debian and Ubuntu: apt install python3-venv)" >&2; exit 1; }
	@touch $@

$(VENV)/.installed-demo: pyproject.toml $(VENV)/.made
	@echo "Installing the testbed into $(VENV) …"
	@$(PIP) install -e .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml $(VENV)/.made
	@echo "Installing the testbed and its tools into $(VENV) …"
	@$(PIP) install -e '.[dev]'
	@touch $@

$(VENV)/.installed-docs: pyproject.toml $(VENV)/.made
	@echo "Installing the testbed and its documentation tools into $(VENV) …"
	@$(PIP) install -e '.[docs]'
	@touch $@
