# `make demo` and `make test` make the environments they need; a second call is quick.
PYTHON ?= python3
VENV := .venv/installed
ROBOTICS := .venv-robotics/installed

.PHONY: demo test test-slow lint venv venv-robotics experiments experiments-quick hidden-effects hidden-effects-quick clean

# Files of tests side by side: the longest are those of the gap workflow, which need a core each.
AT_ONCE := --numprocesses 2 --dist loadfile

demo: $(VENV)
	.venv/bin/simopt-envs demo --task drawer --out out/demo

test: $(VENV) $(ROBOTICS)
	.venv/bin/python -m pytest $(AT_ONCE)
	.venv-robotics/bin/python -m pytest $(AT_ONCE)

test-slow: $(VENV)
	.venv/bin/python -m pytest -m slow

# The paper's questions: hours; the quick ones are fewer seeds and conditions. Both go on where they were stopped.
experiments: $(VENV)
	.venv/bin/python -m baselines.experiments

experiments-quick: $(VENV)
	.venv/bin/python -m baselines.experiments --quick

# The gap workflow on systems in which an effect is hidden; it never sees the folder of labels.
# The registered tasks take longer: make hidden-effects PLANTS="drawer swingpeg" HIDDEN=out/hidden_in_tasks
HIDDEN := out/hidden_effects
PLANTS := two_link arm3 slide_drive
COUNT ?=
hidden-effects: $(VENV)
	.venv/bin/python -m benchmarks.hidden_effects.generate --split test --plants $(PLANTS) --out $(HIDDEN)/cases --labels $(HIDDEN)/labels
	.venv/bin/python -m benchmarks.hidden_effects.run --cases $(HIDDEN)/cases --out $(HIDDEN)/found $(if $(COUNT),--count $(COUNT))
	.venv/bin/python -m benchmarks.hidden_effects.score --gaps $(HIDDEN)/found --labels $(HIDDEN)/labels --figure $(HIDDEN)/confusion.png

hidden-effects-quick:
	$(MAKE) hidden-effects COUNT=6

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
