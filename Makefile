# The commands of the README. Each installs what it needs on its first run.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: train test test-all coverage fuzz lint bench bench-train figures install robot-wheel
install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --constraint constraints.txt --editable .[dev,sweeps]
	touch $@

train: install
	$(BIN)/python train.py model=cnn_warp

# One thread for each of two processes. The tests of a file share what they prepare, and stay in one process.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

test: install
	$(PYTEST) -m "not slow"

test-all: install
	$(PYTEST)

coverage: install
	$(PYTEST) -m "not slow" --cov --cov-report=
	$(BIN)/coverage report --skip-covered --sort=cover

fuzz: install
	$(BIN)/pytest tests/recordings/test_fuzz.py --hypothesis-profile=long

bench: install
	$(BIN)/python -m rcnn_odom.training.bench

bench-train: install
	$(BIN)/python -m rcnn_odom.training.bench_train

# All of docs/, or PAGES="docs/matcher.md docs/training.md".
figures: install
	$(BIN)/python docs/update_figures.py $(PAGES)

# From the files as they are, not as an earlier build has left them.
robot-wheel: install
	rm -rf robot/build
	$(BIN)/pip wheel --no-deps --wheel-dir dist ./robot

lint: install
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
