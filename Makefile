# Everything here works on a machine with Python 3.11 or newer, pip and make; `make help` lists it.

.DEFAULT_GOAL := help
.PHONY: help demo missions test test-all faults mutants check dist parts deb deb-needs site clean venv-demo venv-dev venv-package

BIN := .venv/bin
DEMO_ARGS ?= --speed 4
PYTEST_ARGS ?=
MISSION_ARGS ?= --repeat 20 --jobs 2
FAULTS_ARGS ?=
MUTANTS_ARGS ?= --max-children 2
ifdef PYTHON
export PYTHON
endif
# The tests start hundreds of processes: each would compile every module again.
unexport PYTHONDONTWRITEBYTECODE

help:
	@echo "make demo    fly the simulated search and watch it (DEMO_ARGS='$(DEMO_ARGS)')"
	@echo "make missions  fly the library of missions in lockstep (MISSION_ARGS='$(MISSION_ARGS)')"
	@echo "make test    run the everyday tests, a few minutes; one: PYTEST_ARGS='-k crossing'"
	@echo "make test-all  run all tests, the slow ones too; campaigns are in CONTRIBUTING.md"
	@echo "make faults  fly hundreds of missions with faults, every invariant watched (FAULTS_ARGS)"
	@echo "make mutants  change guard and codec in a thousand places, and list the changes that no test notices"
	@echo "make check   format, lint, types and import rules"
	@echo "make dist    sdist and wheel of both distributions, into dist/"
	@echo "make parts   list of parts (CycloneDX), licences, known weaknesses, into dist/"
	@echo "make deb     Debian package of this machine's kind, into dist/ (DEB_ARGS='--architecture arm64')"
	@echo "make site    the pages as a site, into site/; open site/index.html"
	@echo "make clean   remove .venv and every cache"
	@echo "Each makes .venv by itself when needed; PYTHON=... chooses the interpreter."

demo: venv-demo
	@$(BIN)/companion demo $(DEMO_ARGS)

missions: venv-dev
	@$(BIN)/sim-link mission run configs/missions/*.yaml $(MISSION_ARGS)

test: venv-dev
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow and not campaign" $(PYTEST_ARGS)

test-all: venv-dev
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not campaign" $(PYTEST_ARGS)

faults: venv-dev
	$(BIN)/python tools/faults.py --campaign ci $(FAULTS_ARGS)

mutants: venv-dev
	rm -rf mutants
	$(BIN)/mutmut run $(MUTANTS_ARGS)
	@$(BIN)/mutmut results

check: venv-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy --strict
	$(BIN)/lint-imports

# Two builds of one commit are the same bytes; outside of git the date is the first that a zip can have.
export SOURCE_DATE_EPOCH ?= $(shell git log -1 --format=%ct 2>/dev/null || echo 315532800)

dist: venv-package
	rm -rf dist
	$(BIN)/python -m build --no-isolation --outdir dist .
	$(BIN)/python -m build --no-isolation --outdir dist sim_link
	$(BIN)/twine check --strict dist/*

parts: venv-dev dist
	PYTHONPATH=. $(BIN)/python tools/release/list_parts.py $(PARTS_ARGS)

deb: deb-needs dist
	$(BIN)/python tools/release/make_deb.py $(DEB_ARGS)

deb-needs:
	@tools/release/check_deb_needs.sh

site: venv-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

venv-demo venv-dev venv-package: venv-%:
	@tools/release/make_venv.sh $*

clean:
	rm -rf .venv build dist mutants site .coverage .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
