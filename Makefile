# Every target makes the environment that it needs from nothing but Python (>= 3.11), pip and make.

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV   ?= .venv
BIN    := $(VENV)/bin

# Folders that tests and tools import from.
FOLDERS := $(subst $() ,:,$(addprefix $(CURDIR)/,. tests/core tests/edges tests/worlds tests/reference tools))
TOOL   := PYTHONPATH=$(FOLDERS) $(BIN)/python

# Keep compiled files, also where the machine's setting forbids it: tests start a thousand processes, and each would
# compile all packages again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo check test tests test-edges test-ui test-wheel test-versions docs lint format bench fuzz kill mutants soak soak-explorer pyg viewers py123d maps oracle patterns sample clean duckdb-versions fuzz-queries frozen house reproduce api vendor cluster clients notebooks

help:
	@echo "make demo    run the main job on the bundled recording: ingest, ask, look, export"
	@echo "make check   the edit loop: lint, types and tests of the rooms that differ from main"
	@echo "make test    format, lint, types and the tests of the core: from a recording to an answer"
	@echo "make tests   the tests of the core only"
	@echo "make test-edges  the other tests: what is made of answers, pages, other formats, programs that run long"
	@echo "make test-ui     the explorer in a browser (Chromium), and the types of its page; without a browser it says so"
	@echo "make test-wheel  build the wheel from a clone, install it elsewhere, and run the demo and the short tests there"
	@echo "make test-versions  ingest, verify and find under the lowest and the highest versions of other packages"
	@echo "make docs    build the documentation as a site, build/site/index.html; a link that leads nowhere is an error"
	@echo "make lint    format, lint and types only"
	@echo "make reproduce  make the tables of docs/reproduction.md again from public data (SGSTORE_DATA; minutes)"
	@echo "make house   figures of the code, each beside its ratchet (tools/ratchets.toml)"
	@echo "make bench   print speeds and sizes, each beside a baseline measured in the same run"
	@echo "make fuzz    look at 100,000 recordings, texts and stores that were hurt on purpose (about an hour)"
	@echo "make fuzz-queries  ask 5,000 random queries of a store of 300 traces (an hour; FUZZ_STORE=FILE keeps the store)"
	@echo "make frozen  compare rows, verdicts and JSON with those that are kept (minutes)"
	@echo "make kill    kill verbs that write 200 times while they work, and look whether all is whole and equal (20 minutes)"
	@echo "make mutants  put faults in on purpose and look whether the tests of their room find them (about an hour)"
	@echo "make soak    one writer and eight readers on one store for ten minutes"
	@echo "make soak-explorer  the same, the readers being pages of one explorer"
	@echo "make pyg     PyTorch Geometric reads what is exported for it, and a small network learns from it (downloads torch)"
	@echo "make viewers  Rerun's reader looks at what is exported for it (downloads Rerun)"
	@echo "make py123d   logs by 123D's own writer beside what we read of them (downloads 1.6 GB)"
	@echo "make maps    the package lanelet2 and SUMO beside what we make of their maps and recordings (downloads both)"
	@echo "make oracle  100,000 random patterns and formulas against exhaustive search, 12,000 pairs of graphs against networkx (hours)"
	@echo "make cluster  1,000 random questions of collections, by each engine; S3, and faults of all (hours; installs ray, pyspark, obstore, moto)"
	@echo "make clients  DuckDB 1.0 to 2, ibis, dbt, SQLAlchemy, pandas, polars, datasets, Spark and Lance read an export (downloads them)"
	@echo "make notebooks  run the notebooks of examples/ again, and store their outputs in them"
	@echo "make duckdb-versions  every construct of the language under DuckDB 1.5 and 2.0: equal answers (minutes)"
	@echo "make patterns  draw the examples of the library, and write its page, again"
	@echo "make api     write docs/api.md and docs/relations.md from the code again"
	@echo "make vendor  make the part of the explorer's page again that is of other packages (npm)"
	@echo "make sample  record the bundled sample again (runs SUMO)"

# uv installs in a fifth of the time, without a word. Where it cannot (an index that only pip is told of), pip does.
# Into that of the tests, or into another one, whose own pip may be too old to know of groups.
install = $(BIN)/python -m uv pip install -qq --python $(or $(2),$(BIN))/python $(1) || \
  $(BIN)/python -m pip --python $(or $(2),$(BIN))/python install -q --disable-pip-version-check $(1)

# One environment, and a stamp for each set of packages in it: made again when pyproject.toml changes.
$(VENV)/.base: pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) 2>/dev/null || { \
	  rm -rf $(VENV) && $(PYTHON) -m pip install -q --user --break-system-packages virtualenv && \
	  $(PYTHON) -m virtualenv -q $(VENV); }
	@$(BIN)/python -m pip install -q --disable-pip-version-check -U 'pip>=25.1' uv
	@$(call install,-e '.[viz]')
	@touch $@

$(VENV)/.dev: $(VENV)/.base
	@$(call install,--group dev -e '.[arrow]')
	@touch $@

$(VENV)/.browser: $(VENV)/.dev
	@$(call install,--group browser)
	@touch $@

$(VENV)/.sample: $(VENV)/.base
	@$(call install,-e '.[sample]')
	@touch $@

$(VENV)/.docs: $(VENV)/.base
	@$(call install,--group docs)
	@touch $@

demo: $(VENV)/.base
	@$(BIN)/sgstore demo

lint: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(TOOL) tools/typed.py

format: $(VENV)/.dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

check: $(VENV)/.dev
	@$(TOOL) tools/check.py

# Types take one processor a minute or more, unless nothing changed that they are of: the tests run beside them.
test: $(VENV)/.dev
	@$(MAKE) --no-print-directory -j2 lint tests

# A file of tests at a time in each process: what its tests share is made once. The longest come first
# (mark `seconds`), so that no process is left alone with one of them. One process more than there are
# processors: many tests wait for a process or a time that they started.
WORKERS ?= $(shell expr $$(nproc 2>/dev/null || echo 2) + 1)
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --maxprocesses 5 --dist loadfile --no-loadscope-reorder --durations 25 --durations-min 3
tests: $(VENV)/.dev
	$(PYTEST) tests/core

test-edges: $(VENV)/.dev
	$(PYTEST) tests/edges

# The explorer in a browser; node checks the types of its page.
test-ui: $(VENV)/.browser
	$(TOOL) tools/vendor.py --check
	$(BIN)/python -m pytest -q -rs --durations 10 --durations-min 3 tests/ui

test-wheel: $(VENV)/.dev
	$(BIN)/python tools/packages.py wheel

test-versions: $(VENV)/.dev
	$(BIN)/python tools/packages.py versions

# Every page is in the list of docs/conf.py, every link and heading that a page speaks of is there.
docs: $(VENV)/.docs
	@rm -rf build/site
	$(BIN)/sphinx-build -q -W --keep-going -b html -c docs . build/site

bench: $(VENV)/.dev
	$(BIN)/python -m bench

fuzz: $(VENV)/.dev
	$(TOOL) tools/fuzz.py

fuzz-queries: $(VENV)/.dev
	$(TOOL) tools/fuzz_queries.py 5000 $(if $(FUZZ_STORE),--store $(FUZZ_STORE))

frozen: $(VENV)/.dev
	$(TOOL) tools/frozen.py

reproduce: $(VENV)/.dev
	SGSTORE_LONG=1 $(TOOL) tools/reproduce.py

house: $(VENV)/.dev
	@$(TOOL) tools/house.py

kill: $(VENV)/.dev
	$(TOOL) tools/killing.py 200

mutants: $(VENV)/.dev
	$(TOOL) tools/mutants.py

soak: $(VENV)/.dev
	$(TOOL) tools/soaking.py 600

soak-explorer: $(VENV)/.dev
	$(TOOL) tools/soaking.py 600 --explorer

# In an environment of its own, because torch is large.
pyg: $(VENV)/.base
	@test -x build/pyg/bin/python || $(BIN)/python -m venv build/pyg || $(BIN)/python -m virtualenv -q build/pyg
	@build/pyg/bin/python -m pip install -q --disable-pip-version-check -e '.[pyg,viz]' ipython
	PYTHONPATH=$(FOLDERS) build/pyg/bin/python tools/learning.py

# Likewise: Rerun takes 500 MB. Its own reader looks at what is written for it.
viewers: $(VENV)/.base
	@test -x build/viewers/bin/python || $(BIN)/python -m venv build/viewers || $(BIN)/python -m virtualenv -q build/viewers
	@build/viewers/bin/python -m pip install -q --disable-pip-version-check -e '.[rerun,viz,arrow]' pytest hypothesis foxglove-schemas-protobuf
	build/viewers/bin/python -m pytest tests/edges/test_export_rerun.py tests/edges/test_export_viewers.py

py123d: $(VENV)/.base
	@test -x build/py123d/bin/python || $(BIN)/python -m venv build/py123d || $(BIN)/python -m virtualenv -q build/py123d
	@build/py123d/bin/python -m pip install -q --disable-pip-version-check -e '.[arrow]' py123d==0.7.0
	build/py123d/bin/python tests/reference/oracle_py123d.py

# Likewise: readers of maps and simulators, each the oracle of what we read of it.
maps: $(VENV)/.base
	@test -x build/maps/bin/python || $(BIN)/python -m venv build/maps || $(BIN)/python -m virtualenv -q build/maps
	@build/maps/bin/python -m pip install -q --disable-pip-version-check -e . lanelet2==1.2.3 eclipse-sumo==1.28.0 libsumo==1.28.0
	PYTHONPATH=$(FOLDERS) build/maps/bin/python tests/reference/oracle_lanelet2.py
	PYTHONPATH=$(FOLDERS) build/maps/bin/python tests/reference/oracle_sumo.py

oracle: $(VENV)/.dev
	$(TOOL) tests/reference/oracle_temporal.py 100000
	$(TOOL) tests/reference/oracle_monitor.py 100000
	$(TOOL) tests/reference/oracle_robustness.py 100000
	$(TOOL) tests/reference/oracle.py 100000 0 2
	$(TOOL) tests/reference/oracle_constructs.py 5000
	$(TOOL) tests/reference/oracle_over_time.py 1000
	$(TOOL) tests/reference/oracle_steps.py 10000
	$(TOOL) tests/reference/oracle_watched.py $(addprefix $${SGSTORE_DATA:-../shared/data}/,traces real)
	$(TOOL) tests/reference/oracle_turned.py $(addprefix $${SGSTORE_DATA:-../shared/data}/traces/,carla/Town01.carla.mcap esmini/swarm_Town04.mcap sumo/Town10HD_sumo_osi.mcap)
	SGSTORE_LONG=1 $(BIN)/python -m pytest -m long tests/core tests/edges
	SGSTORE_LONG=1 $(BIN)/python -m pytest tests/core/test_geometry.py
	SGSTORE_CLASS_PAIRS=12000 $(BIN)/python -m pytest tests/core/test_classes.py
	SGSTORE_HURT_GRAPHS=20000 $(BIN)/python -m pytest tests/edges/test_importing.py
	SGSTORE_COVERAGE_RATE=2 $(BIN)/python -m pytest tests/edges/test_coverage.py

# In an environment of its own, because Ray and Spark are large, and bring older packages.
ENGINES := arrow,cluster,ray,spark,viz
cluster: $(VENV)/.base
	@test -x build/cluster/bin/python || $(BIN)/python -m venv build/cluster || $(BIN)/python -m virtualenv -q build/cluster
	@$(call install,--group dev --group cluster -e '.[$(ENGINES)]',build/cluster/bin)
	PYTHONPATH=$(FOLDERS) build/cluster/bin/python tests/reference/oracle_collection.py 1000 'local+ray+spark:local[2,4]' 1 3 20
	SGSTORE_LONG=1 build/cluster/bin/python -m pytest $(wildcard tests/edges/test_collection*.py)

# Each in an environment of its own: old versions, and large packages.
clients: $(VENV)/.dev
	$(TOOL) tools/client_matrix.py

notebooks: $(VENV)/.dev
	$(TOOL) tools/notebook_outputs.py

duckdb-versions: $(VENV)/.dev
	$(TOOL) tools/duckdb_versions.py

patterns: $(VENV)/.dev
	$(TOOL) tools/library_page.py

vendor: $(VENV)/.dev
	$(TOOL) tools/vendor.py

api: $(VENV)/.dev
	$(TOOL) tools/api_page.py

sample: $(VENV)/.sample
	$(BIN)/python samples/town/record.py

clean:
	rm -rf $(VENV) build dist *.egg-info sgstore-demo
