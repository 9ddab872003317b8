# The commands of the README. Each installs what it needs on its first run.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: train test fuzz lint bench bench-train install
install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt --editable .[dev,sweeps]
	touch $@

train: install
	$(BIN)/python train.py model=rcnn_reg

test: install
	$(BIN)/pytest

fuzz: install
	$(BIN)/pytest tests/test_fuzz.py --hypothesis-profile=long

bench: install
	$(BIN)/python -m rcnn_odom.training.bench

bench-train: install
	$(BIN)/python -m rcnn_odom.training.bench_train

lint: install
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
