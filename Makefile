# Tagcell's everyday commands. A fresh clone needs Python 3.11 or newer and make, nothing else.
#   make pick   set-up and the main job: 5 scenes, 2 parts a class, scored      make test   set-up and tests
#   make check  lint, types, import rules                                       make help   all of them

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
OUT    ?= runs/pick
SCENES ?= 5
SEED   ?= 0
ESTIMATOR ?= learned
MASKRCNN := .venv-maskrcnn
MASKRCNN_NEEDS := torchvision scipy trimesh networkx opencv-python-headless pycocotools safetensors tyro matplotlib
SCRATCH ?= runs/scratch
MINUTES ?= 28
DATA   ?=
DETECTIONS ?= runs/maskrcnn/$(notdir $(DATA:/=)).json

.PHONY: help setup pick test test-slow check format cad from-scratch maskrcnn clean
.DEFAULT_GOAL := help

help:
	@sed -n 's/^#   //p' Makefile
	@echo "also: make setup, test-slow (the long tests), format, cad (rebuild parts and samples; installs build123d), clean"
	@echo "      make from-scratch (render, train $(MINUTES) minutes and evaluate into $(SCRATCH): an hour on two cores)"
	@echo "      make maskrcnn DATA=DIR (what Mask R-CNN finds in a data set, for tagcell evaluate; an environment of its own, 6 GB)"
	@echo "variables: OUT=$(OUT) SCENES=$(SCENES) SEED=$(SEED) ESTIMATOR=$(ESTIMATOR) PYTHON=$(PYTHON)"

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(f"Tagcell needs Python 3.11 or newer; {sys.executable} is {sys.version.split()[0]}. Run: make PYTHON=/path/to/python3.11" if sys.version_info < (3, 11) else 0)'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	$(BIN)/tagcell doctor --fix
	@touch $@

setup: $(READY)

pick: setup
	$(BIN)/tagcell pick --scenes $(SCENES) --parts-per-class 2 --seed $(SEED) --estimator $(ESTIMATOR) --out $(OUT)

test: setup
	$(BIN)/python -m pytest

test-slow: setup
	$(BIN)/python -m pytest -m slow

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

cad: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[cad]'
	$(BIN)/python -m cad.models.build
	$(BIN)/python -m cad.models.samples

from-scratch: setup
	@began=$$(date +%s) && \
	$(BIN)/tagcell train --minutes $(MINUTES) --data $(SCRATCH)/data --out $(SCRATCH) && \
	$(BIN)/tagcell evaluate --domain classic --count 20 --methods tagcell --weights $(SCRATCH)/weights --out $(SCRATCH)/evaluation && \
	echo "from CAD to evaluated networks in $$(( ($$(date +%s) - began) / 60 )) minutes"

$(MASKRCNN)/.ready: constraints-maskrcnn.txt
	@test -x $(MASKRCNN)/bin/python || $(PYTHON) -m venv $(MASKRCNN)
	$(MASKRCNN)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints-maskrcnn.txt $(MASKRCNN_NEEDS)
	@touch $@

maskrcnn: $(MASKRCNN)/.ready
	$(if $(DATA),$(MASKRCNN)/bin/python -m perception.run_maskrcnn --data $(DATA) --out $(DETECTIONS))

clean:
	rm -rf $(VENV) $(MASKRCNN) build *.egg-info runs .pytest_cache .ruff_cache .import_linter_cache
