# `make demo` and `make test` make the environments they need; a second call is quick.
PYTHON ?= python3
VENV := .venv/installed
ROBOTICS := .venv-robotics/installed

.PHONY: demo test test-slow lint venv venv-robotics experiments clean

demo: $(VENV)
	.venv/bin/simopt-envs demo --task drawer --out out/demo

test: $(VENV) $(ROBOTICS)
	.venv/bin/python -m pytest
	.venv-robotics/bin/python -m pytest

test-slow: $(VENV)
	.venv/bin/python -m pytest -m slow

lint: $(VENV)
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

venv: $(VENV)
venv-robotics: $(ROBOTICS)

# The default environment: newest MuJoCo, everything for development.
$(VENV): pyproject.toml constraints.txt
	rm -rf .venv && $(PYTHON) -m venv .venv
	.venv/bin/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $@

# robosuite 1.5 and gymnasium-robotics 1.4 need MuJoCo 3.9 and numpy 1.
$(ROBOTICS): pyproject.toml constraints-robotics.txt
	rm -rf .venv-robotics && $(PYTHON) -m venv .venv-robotics
	.venv-robotics/bin/python -m pip install --quiet --constraint constraints-robotics.txt --editable ".[robotics,sb3,report,measured,test]"
	touch $@

clean:
	rm -rf .venv .venv-robotics build dist *.egg-info out
