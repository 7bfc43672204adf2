# Set-up and every routine job. `make demo` and `make test` install what they need first.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
READY_TO_TRAIN := $(VENV)/.ready-to-train

export OMP_NUM_THREADS = 1

.PHONY: help setup docs site dist demo pictures reproduce audit test test-slow test-fresh fuzz mutants test-gymnasium test-lowest test-ray test-tutorial lint format benchmark wheel-test clean clean-kernels

help:  ## Show this list.
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

setup: $(READY)  ## Make the virtual environment with pinned packages.

$(READY_TO_TRAIN): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make setup PYTHON=python3.11; this is " + sys.version)'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	# torch first and pinned: a looser request may bring gigabytes of GPU libraries.
	@echo "Installing packages of 2 GB, some minutes."
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[train]'
	touch $@

$(READY): $(READY_TO_TRAIN)
	@echo "Installing what the tests need, another 1.2 GB."
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: $(READY_TO_TRAIN)  ## Train a query policy for two minutes and compare it with rules on other traffic; results/demo.
	$(BIN)/python examples/demo.py

pictures: setup  ## Draw the pictures of the pages anew; docs/images.
	$(BIN)/python docs/_site/pictures.py

reproduce: setup  ## Write the reports of all studies anew, after playing what their rows lack; results/.
	$(BIN)/dptse study paper
	$(BIN)/dptse study guarantees
	$(BIN)/dptse study estimators
	$(BIN)/dptse study roads
	$(BIN)/dptse study suite

CAPPED = --env 'dptse_env:dptse/PrivateHighway-v1 {"estimator": "ekf", "bandwidth": 5, "privacy": "capped"}'
PACED = --env 'dptse_env:dptse/PrivateHighway-v1 {"estimator": "ekf", "bandwidth": 5}'
IS_REJECTED = ; test $$? -eq 3
audit: setup  ## Attack the privacy presets, 5,000 runs in each of two worlds or one run; results/audit.
	$(BIN)/dptse audit --force --output results/audit/printed --env dptse_env:dptse/PaperHighway-v0 --target replaced $(IS_REJECTED)
	$(BIN)/dptse audit --force --output results/audit/corrected --env 'dptse_env:dptse/PaperHighway-v0 {"privacy": "corrected"}' --target replaced $(IS_REJECTED)
	$(BIN)/dptse audit --force --output results/audit/capped-weak $(CAPPED) --noise-factor 0.709 $(IS_REJECTED)
	$(BIN)/dptse audit --force --output results/audit/capped $(CAPPED)
	$(BIN)/dptse audit --force --output results/audit/paced-weak $(PACED) --noise-factor 0.709 $(IS_REJECTED)
	$(BIN)/dptse audit --force --output results/audit/paced $(PACED)
	$(BIN)/dptse audit --force --output results/audit/paced-replaced $(PACED) --target replaced
	$(BIN)/dptse audit --force --output results/audit/printed-one-run --env dptse_env:dptse/PaperHighway-v0 --one-run $(IS_REJECTED)
	$(BIN)/dptse audit --force --output results/audit/paced-one-run-weak $(PACED) --one-run --noise-factor 0.5 $(IS_REJECTED)
	$(BIN)/dptse audit --force --output results/audit/paced-one-run $(PACED) --one-run

test: setup  ## Run the tests, without the slow ones.
	$(BIN)/python -m pytest -m 'not slow' -n 2 --dist loadfile

test-tutorial: setup  ## Run the tutorial as a notebook, two to four minutes.
	$(BIN)/python -m pytest tests/docs/test_tutorial.py -m slow

test-slow: setup  ## Run the slow tests: before a release, and after a change to kernels, workers or benchmarks.
	$(BIN)/python -m pytest -m 'slow and not ray' -n 2 --dist loadfile

test-fresh: setup  ## Run the tests of properties with examples that are drawn anew.
	$(BIN)/python -m pytest -m 'hypothesis and not slow' --hypothesis-profile fresh

fuzz: setup  ## Try random configurations and hostile files, ten minutes.
	$(BIN)/python -m tests.fuzz

mutants: setup  ## Break lines of the code in a copy, and see a fast test fail; an hour.
	$(BIN)/python -m tests.mutants

test-gymnasium: setup  ## Run the tests of environments with the oldest Gymnasium, which RLlib needs.
	$(BIN)/python -m pip install --quiet --no-deps --upgrade --target build/gymnasium gymnasium==1.2.2
	PYTHONPATH=build/gymnasium $(BIN)/python -c 'import gymnasium; assert gymnasium.__version__ == "1.2.2"'
	PYTHONPATH=build/gymnasium $(BIN)/python -m pytest -m 'not slow' -n 2 --dist loadfile tests/sb3 tests/spaces \
		tests/test_env.py tests/test_plugin.py tests/test_vector_env.py

test-ray: setup  ## Run the tests of Ray clusters on this machine, with killed workers and lost nodes.
	$(BIN)/python -m pytest -m ray

site: setup  ## Build the documentation site and check its links; build/site.
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[docs]'
	$(BIN)/python docs/_site/build.py

docs: setup  ## Write the notebook of the tutorial anew.
	$(BIN)/python docs/_site/notebook.py

lint: setup  ## Check style, types and import rules.
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

format: setup  ## Format the code.
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

benchmark: setup  ## Time estimators, environments, learning and long roads; results/benchmarks.
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[benchmark]'
	$(BIN)/python -m benchmarks --output results/benchmarks

dist: setup  ## Build and check the archives of a release; dist/.
	$(BIN)/python -m build --outdir dist
	$(BIN)/python -m twine check --strict dist/*

wheel-test: setup  ## Build the archives, install the wheel for PYTHON elsewhere and use it there; ARCHIVES=dist for built ones.
	$(BIN)/python tests/wheel/run.py --python $(PYTHON) $(ARCHIVES:%=--archives %)

test-lowest: setup  ## Use the wheel, and run the tests, with the lowest versions that are allowed; TORCH=2.13.0 for another torch.
	$(BIN)/python -m pip install --quiet --constraint constraints.txt uv
	$(BIN)/python tests/wheel/run.py --python $(PYTHON) --lowest $(TORCH:%=--torch %)

clean:  ## Remove the virtual environment, builds and caches; results/ stays.
	rm -rf $(VENV) build dist .mypy_cache .pytest_cache .ruff_cache .hypothesis

clean-kernels: setup  ## Remove the compiled kernels, which all environments of this user share.
	$(BIN)/python -c 'import shutil; from dptse_env.utils.kernels import default_folder; shutil.rmtree(default_folder())'
