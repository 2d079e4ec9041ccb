# Needs Python >= 3.11, pip and make. Everything is installed into .venv and nowhere else.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test check-docs coverage test-lowest test-newest check style fuzz format bench paper figures hangs structure weight lab docs pages slides address release binder submission clean

demo: $(VENV)/.core
	$(BIN)/s4a demo

# one process a core and one more, as tests wait for browsers and processes now and then; one thread a process; with
# bytecode, even where the shell forbids it, as many tests start Python
WORKERS = $$($(BIN)/python -c "import os; print(os.cpu_count() + 1)")
PYTEST = PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder
# types are checked beside the tests, as mypy takes one core for half a minute in a new clone; what it finds comes last
test: style
	$(BIN)/mypy > $(VENV)/types.txt 2>&1 & types=$$!; $(PYTEST); tests=$$?; \
	wait $$types || { cat $(VENV)/types.txt; exit 1; }; exit $$tests

# the rules of the project: its documentation as it is built, lessons and pages as they run, imports, the wheel
check-docs: $(VENV)/.test
	$(PYTEST) tests/project

# the same, and which lines of s4a no test has run
coverage: $(VENV)/.test
	$(PYTEST) --cov --cov-report=term:skip-covered

# the quick tests with every direct dependency in the oldest version that pyproject.toml allows, and with the newest of
# all; PYTHON=... names another Python. Old versions warn of newer ones below them, so that warnings are no errors there
QUICK := s4a tests/geometry tests/method tests/input/test_mesh_files.py tests/study/test_store.py tests/cli
test-lowest: $(VENV)-lowest/.ready
	OMP_NUM_THREADS=1 $(VENV)-lowest/bin/python -m pytest -W default $(QUICK)

test-newest: $(VENV)-newest/.ready
	OMP_NUM_THREADS=1 $(VENV)-newest/bin/python -m pytest $(QUICK)

check: style
	$(BIN)/mypy

style: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/repo-review --show errskip .

fuzz: $(VENV)/.test
	$(BIN)/python tests/fuzz.py

format: $(VENV)/.test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# seconds, memory and bytes, into docs/performance, with machine and versions; ONLY=start takes the commands with that word
bench: $(VENV)/.bench
	$(BIN)/python tools/paper.py --speed $(ONLY)

# lesson 04 twenty times, and every other one three times, on a busy machine: does one hang?
hangs: $(VENV)/.test
	$(BIN)/python benchmarks/hangs.py 04 --runs 20
	$(BIN)/python benchmarks/hangs.py --runs 3

# every table that README, documentation and papers quote, into docs/tables, with machine and versions, and every
# picture: hours. # ONLY=accuracy takes the commands with that word, ONLY=--list names all
paper: $(VENV)/.bench
	$(BIN)/python tools/paper.py $(ONLY)
	@test -n "$(ONLY)" || $(BIN)/python docs/figures.py

# the pictures of README and pages; NAME=figure_3 draws one
figures: $(VENV)/.bench
	$(BIN)/python docs/figures.py $(NAME)

# the picture, the table and the map of the subpackages, made from the code
structure: $(VENV)/.core
	$(BIN)/python tools/structure.py --write

# modules, lines, options, tests and bytes; REVISION=... prints those of that revision next to them
weight: $(VENV)/.test
	$(BIN)/python tools/weight.py $(REVISION)

lab: $(VENV)/.course
	$(BIN)/jupyter lab $(wildcard notebooks)

# S4A_DOCS=off leaves the outputs of the notebooks out, for a quick look
docs: $(VENV)/.docs
	$(BIN)/python -m sphinx -W --keep-going -b html -d docs/_build/doctrees docs docs/_build/html

# the lessons that are shown on the web: run, made into pages, and looked at in Chromium from a plain server
pages: $(VENV)/.test
	S4A_LESSONS="00 02 04 06 09" $(BIN)/python -m sphinx -q --keep-going -b html -d docs/_build/doctrees docs docs/_build/html
	$(BIN)/python benchmarks/offline.py

# the public address, NAME=name/s4a, written into every file that says it
address:
	$(PYTHON) tools/release.py address $(NAME)

# what has to hold before a release; builds dist/, tries the wheel outside of the repository, also by uvx and pipx, and
# uploads nothing
release: $(VENV)/.test
	@test -n "$(VERSION)" || { echo "make release VERSION=..."; exit 2; }
	$(PYTHON) tools/release.py check $(VERSION)
	$(BIN)/repo-review --show errskip .
	rm -rf dist && $(BIN)/python -m pip install --quiet build twine && $(BIN)/python -m build --outdir dist . && $(BIN)/python -m build --outdir dist morphometrics
	$(BIN)/python -m twine check --strict dist/*
	tools/try.sh dist/s4a-$(VERSION)-py3-none-any.whl

# what Binder builds, from an empty environment on one core, and both of its pages opened in Chromium: ten minutes;
# PICTURES=folder gets screenshots
binder:
	binder/try.sh $(PICTURES)

# what the papers lack before they are submitted, such as what only their authors can state
submission:
	$(PYTHON) tools/release.py paper

# the lecture of 45 minutes, from the notebooks, in docs/_build/slides
slides: $(VENV)/.docs
	$(BIN)/python docs/slides.py

clean:
	rm -rf $(VENV) $(VENV)-lowest $(VENV)-newest

$(VENV)/.python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "s4a needs Python 3.11 or newer; this is %s. Try make PYTHON=python3.12" % sys.version)'
	$(PYTHON) -m venv $(VENV)
	touch $@

$(VENV)/.core: $(VENV)/.python pyproject.toml
	$(BIN)/python -m pip install --quiet -e .
	touch $@

# uv takes a fifth of the time of pip, which is asked where uv finds no packages, as it does not read pip's settings
$(VENV)/.%: PACKAGES = -e ".[$*]" -e ./morphometrics
$(VENV)/.%: $(VENV)/.python pyproject.toml morphometrics/pyproject.toml
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip install --quiet --python $(BIN)/python $(PACKAGES) || $(BIN)/python -m pip install --quiet $(PACKAGES)
	touch $@

$(VENV)-lowest/.ready: RESOLUTION := lowest-direct
$(VENV)-newest/.ready: RESOLUTION := highest
$(VENV)-%/.ready: pyproject.toml morphometrics/pyproject.toml
	$(PYTHON) -m venv --clear $(VENV)-$*
	$(VENV)-$*/bin/python -m pip install --quiet uv
	$(VENV)-$*/bin/uv pip install --quiet --python $(VENV)-$*/bin/python --resolution $(RESOLUTION) -e ".[test]" -e ./morphometrics
	touch $@
