# make run        sets up .venv and trains for about two minutes, to a picture and a table
# make test       sets up .venv and runs every test that is not slow
# make test-slow  the learning tests and everything else that takes minutes
PYTHON ?= python3
VENV := .venv
UV := $(shell command -v uv 2>/dev/null)
RUN_DIR := runs/make_run

ifdef UV
INSTALL := uv pip install --quiet --python $(VENV)/bin/python
else
INSTALL := $(VENV)/bin/python -m pip install --quiet --progress-bar off
endif

.PHONY: run test test-slow lint lock clean

run: $(VENV)/ready
	@if [ -e $(RUN_DIR) ]; then mv $(RUN_DIR) $(RUN_DIR).$$(date +%s); fi
	$(VENV)/bin/python cleanrl_thesis/ppo_continuous_kle.py --kle-rollback --d-target 0.03 \
	    --total-timesteps 400000 --save-model --run-dir $(RUN_DIR)
	@echo "learning curve: $(RUN_DIR)/learning_curve.png, evaluation: $(RUN_DIR)/evaluation.json"

test: $(VENV)/ready-test
	$(VENV)/bin/python -m pytest -m "not slow" --numprocesses 2 --dist loadfile --durations 15

test-slow: $(VENV)/ready-test
	$(VENV)/bin/python -m pytest -m slow --numprocesses 2 --dist loadfile --durations 20

lint: $(VENV)/ready-test
	$(VENV)/bin/ruff check . && $(VENV)/bin/ruff format --check .

lock:
	uv pip compile pyproject.toml --group test --group track --group bench --group study --group minari --python-version 3.11 \
	    --no-emit-index-url --no-annotate --quiet --output-file requirements.lock

clean:
	rm -rf $(VENV) *.egg-info

$(VENV)/python:
	@command -v git >/dev/null || { echo "git is missing: apt-get install git" >&2; exit 1; }
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) is missing: apt-get install python3.11" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "$(PYTHON) is older than Python 3.11: make PYTHON=python3.11" >&2; exit 1; }
ifdef UV
	uv venv --quiet --allow-existing --python $(PYTHON) $(VENV)
else
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "Python's venv is missing: apt-get install python3.11-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
endif
	@touch $@

$(VENV)/ready: pyproject.toml requirements.lock | $(VENV)/python
	@echo "downloading PyTorch and its GPU libraries, 3.1 GB (5.7 GB on disk), once; the README tells how to do without the GPU part"
	@$(if $(UV),true,$(INSTALL) --upgrade "pip>=25.1")
	$(INSTALL) --constraint requirements.lock --editable .
	@touch $@

$(VENV)/ready-test: $(VENV)/ready
	@echo "downloading what the tests need, 0.3 GB, once"
	$(INSTALL) --constraint requirements.lock --editable . --group test
	@touch $@
