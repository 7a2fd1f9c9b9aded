# `make demo` and `make test` are all a new user needs; both install into .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install demo test test-all lint docs bench wheel-test clean

install: $(VENV)/.installed

# what the program needs, and on top of it what tests, formats of others and documentation need
$(VENV)/.program: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(None if (3, 11) <= sys.version_info[:2] < (3, 13) else "op3 needs Python 3.11 or 3.12: make $(or $(MAKECMDGOALS),install) PYTHON=python3.12")'
	@echo "installing into $(VENV): some minutes, 3 GB"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[stand-in,video]'
	touch $@

$(VENV)/.installed: $(VENV)/.program
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: $(VENV)/.program
	$(BIN)/python experiments/sim2real.py source=emulated task=balance world=robot_4 budget=demo

# two tests at a time: more would slow down those that keep real time, on machines of any size
test: install
	$(BIN)/python -m pytest -n 2 -m "not slow"

test-all: install
	$(BIN)/python -m pytest -n 2

lint: install
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

docs: install
	$(BIN)/mkdocs build --quiet

# the wheel, installed into an environment of its own and run outside the checkout
wheel-test:
	rm -rf build/wheel-test dist && $(PYTHON) -m venv build/wheel-test
	build/wheel-test/bin/pip wheel --quiet --no-deps --wheel-dir dist .
	build/wheel-test/bin/pip install --quiet -c constraints.txt "$$(ls dist/*.whl)[stand-in,video]"
	cd build/wheel-test && bin/op3 --version && bin/op3 doctor
	cd build/wheel-test && bin/op3 evaluate policy=assets/policies/balance task=balance_eval episodes=1 video=false
	cd build/wheel-test && bin/op3 demo diagnose windows=12  # too few windows to name an effect; it only has to run

bench: install
	$(BIN)/python experiments/benchmarks/simulation_speed.py

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis build dist *.egg-info
