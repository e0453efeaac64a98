# Every target works on a bare machine: it makes $(VENV) from $(PYTHON) first when it is not there.
# The one that the pins were tested with comes first, then what there is of 3.10 or newer.
PYTHON ?= $(shell for p in python3.11 python3.12 python3.13 python3.14 python3.10 python3; do \
	$$p -c 'import sys, venv; sys.exit(sys.version_info < (3, 10))' 2>/dev/null && echo $$p && break; \
	done)
VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

# The main job's task and run folder; a run folder that exists is taken up where it stopped.
ENV ?= FollowObject/PnPShelf-v0
RUN ?= runs/pnp-shelf

.PHONY: train quick test lint docs settings bench test-mujoco-range test-foreign clean

train: $(INSTALLED)
	$(BIN)/sb3-follow-object train --env $(ENV) --run $(RUN) --set torch_threads=2 --resume-or-start

# What breaks most when a room changes, within a minute together with the linters.
QUICK := tests/settings tests/imagination tests/callbacks/test_callbacks.py tests/envs/test_tasks.py \
	tests/replay/test_her_replay_buffer.py tests/replay/test_record_buffer.py \
	tests/ddpg/test_her_ddpg.py

quick: lint
	$(BIN)/pytest -q -n 2 --dist loadfile -k "not learns and not stock and not subprocesses" $(QUICK)

# Whole files go to a process, so that what their tests share is made once.
test: lint
	$(BIN)/pytest -q -n 2 --dist loadfile

# Builds throwaway environments with the lowest and the highest mujoco that pyproject.toml admits.
test-mujoco-range: $(INSTALLED)
	$(BIN)/pytest -q -m mujoco_range

# Downloads the tests of Stable-Baselines3 and Gymnasium-Robotics, and runs them over this package.
test-foreign: $(INSTALLED)
	$(BIN)/python benchmarks/foreign_tests.py

# Against stock SB3, Gymnasium-Robotics and EnvPool; two minutes on a machine left alone.
bench: $(INSTALLED)
	$(BIN)/pip install -c constraints.txt -e '.[bench]' --no-build-isolation
	$(BIN)/python benchmarks/speed.py

# mypy and import-linter read no setuptools package-dir, so they are shown the package in the shape
# that is installed.
lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@rm -rf build/package && mkdir -p build/package
	@cp -r sb3_follow_object build/package/
	@cp -r envs zoo_configs build/package/sb3_follow_object/
	MYPYPATH=build/package $(BIN)/mypy -p sb3_follow_object
	cd build/package && $(abspath $(BIN))/lint-imports --no-cache --no-logo $(CURDIR)/pyproject.toml

# The site, in build/docs; what the pages show is tested by tests/docs.
docs: $(INSTALLED)
	$(BIN)/python -m sphinx -W --keep-going -q -b html -d build/doctrees docs build/docs
	@echo build/docs/index.html

# The tables of settings in the docs are what the code says.
settings: $(INSTALLED)
	$(BIN)/python -m sb3_follow_object.settings.docs_tables docs/runs.md

# torch goes first and by its pin: a range would let pip fetch a newer build with CUDA.
$(INSTALLED): pyproject.toml constraints.txt
	@test -x $(BIN)/python || test -n "$(PYTHON)" || \
		{ echo "no Python of 3.10 or newer with venv is on PATH: make PYTHON=/path/to/python"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -c constraints.txt torch setuptools wheel
	$(BIN)/pip install -c constraints.txt --no-build-isolation -e '.[zoo,plots,video,ray,docs,onnx,test]'
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache
