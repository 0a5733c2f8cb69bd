# SPDX-License-Identifier: Apache-2.0
# Two commands on a fresh machine: `make demo` and `make test`; while editing: `make test-fast`.
VENV   ?= .venv
PYTHON ?= $(shell for p in python3.12 python3.11 python3.10 python3; do \
            $$p -c 'import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] < (3, 13))' 2>/dev/null && echo $$p && break; done)
OUT    ?= demo_output
PINS    = .ci/requirements.txt
export OMP_NUM_THREADS ?= 1
export OMP_WAIT_POLICY ?= passive

.PHONY: demo test test-fast lint docs figures install clean

demo: $(VENV)/.installed
	$(VENV)/bin/vitamin3d reconstruct data/demo --out $(OUT) --overwrite --scale-from-ground-truth

test: $(VENV)/.installed-dev
	$(VENV)/bin/python -m pytest

test-fast: $(VENV)/.installed-dev
	$(VENV)/bin/python -m pytest -q --ignore=tests/regression -m "not slow"

lint: $(VENV)/.installed-dev
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy

docs: $(VENV)/.installed-docs
	$(VENV)/bin/mkdocs build --strict

# Every figure of docs/figures.md that needs the sequences in DATA; hours.
DATA    ?= ../shared/data
EARLIER  = room1_v101_easy room1_v103_difficult kitchen kitti00
figures: $(VENV)/.installed-dev
	mkdir -p build/figures
	$(VENV)/bin/python tools/proving_ground.py --workers 2 --json build/figures/proving_ground.json
	for s in $(EARLIER); do $(VENV)/bin/vitamin3d reconstruct $(DATA)/$$s -o build/figures/$$s --scale-from-ground-truth --overwrite -q; \
	  $(VENV)/bin/vitamin3d evaluate build/figures/$$s -g $(DATA)/$$s $$([ $$s = kitti00 ] || echo --surface); done
	$(VENV)/bin/python tools/benchmark.py $(DATA)/room1_v101_easy
	$(VENV)/bin/python tools/benchmark_bundle_adjustment.py bal $(wildcard $(DATA)/bal/*.txt.bz2)

install: $(VENV)/.installed

$(VENV)/bin/python:
	@test -n "$(PYTHON)" || { echo "Python 3.10, 3.11 or 3.12 with venv is needed (Debian: sudo apt-get install python3-venv); or: make PYTHON=/path/to/python" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml $(PINS) | $(VENV)/bin/python
	@tools/system_libraries.sh
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint $(PINS) --editable .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml $(PINS) | $(VENV)/bin/python
	@tools/system_libraries.sh
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint $(PINS) --editable '.[dev,eval,cluster]'
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: pyproject.toml $(PINS) | $(VENV)/bin/python
	@tools/system_libraries.sh
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check --constraint $(PINS) --editable '.[docs]'
	@touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) $(OUT)
