# `make demo` and `make test` are complete on a fresh machine: each makes the virtual environment that it needs.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
DEMO ?= demo-output

.PHONY: demo test test-quadrants lint docs clean

$(BIN)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -e '.[dev]'
	touch $@

demo: $(BIN)/.installed
	rm -rf $(DEMO)
	$(BIN)/leafflow-ti demo $(DEMO)

test: $(BIN)/.installed
	$(BIN)/python -m pytest -n 2 --dist loadfile

test-quadrants: $(BIN)/.installed
	LEAFFLOW_TI_ENGINE=quadrants $(BIN)/python -m pytest -n 2 --dist loadfile $(TESTS)

lint: $(BIN)/.installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(BIN)/.installed
	$(BIN)/python -m sphinx -W --keep-going -q docs docs/_build/html
	@echo docs/_build/html/index.html

clean:
	rm -rf $(VENV) $(DEMO) docs/_build .pytest_cache .mypy_cache .ruff_cache
