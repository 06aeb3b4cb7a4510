# Two commands do everything: `make demo` and `make test`. Both set up .venv first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
LIBRARIES := libgl1 libegl1 libx11-6 libusb-1.0-0 libudev1 libgomp1 libiio0
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.DEFAULT_GOAL := help
.PHONY: help setup setup-dev demo test test-fast test-road lint style audit lock stability site reference bench fuzz mutants tables sample pictures full-wave compare results-gpu object-network clean

# $(call beat,WORDS) COMMAND: a line of WORDS every ten seconds until COMMAND, or the shell that runs it, has ended
beat = (s=0; while sleep 1 && kill -0 $$$$ 2>/dev/null; do s=$$((s + 1)); [ $$((s % 10)) -ne 0 ] || echo "$(1), $$s s"; done) & trap "kill $$!" EXIT;

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

# What others packed is installed by its checksum (make lock); LOCKED=no takes what pyproject.toml allows. torch alone has
# none: each kind of processor has a build of its own.
LOCKED ?= yes
install_locked = test $(LOCKED) = no || $(BIN)/pip install --progress-bar off --require-hashes -r $(1) || { echo "the package index does not serve what $(1) names; LOCKED=no takes what pyproject.toml allows, unchecked"; exit 1; }
install_here = $(BIN)/pip install --quiet $(if $(filter no,$(LOCKED)),,--no-build-isolation) --editable $(1)

$(VENV)/.installed: pyproject.toml requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' || { echo "mirrorwave needs Python 3.11 to 3.14; name one with: make PYTHON=python3.11 ..."; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { echo "cannot make $(VENV); on Debian: apt-get install python3-venv"; exit 1; }
	@echo "set-up 1 of 2: Python packages, 720 MB with all that they need"
	@$(call beat,set-up 1 of 2: Python packages) $(call install_locked,requirements.lock)
	@$(call beat,set-up 1 of 2: mirrorwave itself) $(call install_here,.)
	@# compiles the kernels of perception and simulator once, so that no node does when it starts
	@echo "set-up 2 of 2: compiling kernels, on a slow machine for minutes"
	@$(call beat,set-up 2 of 2: compiling kernels) ( $(BIN)/mirrorwave process --sample --out $(VENV)/compiled & perception=$$!; \
	for words in 'drives/side_street.yaml --for objects' 'scenes/corner.yaml --for objects' 'scenes/corner.yaml --effects all'; do \
	    $(BIN)/mirrorwave sim run launch/$$words --chirps-per-beam 8 --out $(VENV)/compiled.mcap && rm $(VENV)/compiled.mcap || exit 1; \
	done; wait $$perception && rm -r $(VENV)/compiled ) >$(VENV)/compiled.log 2>&1 || { cat $(VENV)/compiled.log; exit 1; }
	@touch $@

$(VENV)/.installed-dev: $(VENV)/.installed requirements-dev.lock
	@echo "set-up for development: packages of training, tests and linters"
	@$(call beat,set-up for development) $(call install_locked,requirements-dev.lock)
	@$(call beat,set-up for development: mirrorwave itself) $(call install_here,'.[dev]')
	@# shared libraries of open3d (annotate) and pyadi-iio (phaser); what needs them is skipped by name where they lack
	@$(call beat,set-up for development: shared libraries) if $(BIN)/python -c "import open3d, iio" 2>/dev/null; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && { apt-get -qq update && apt-get -qq install -y --no-install-recommends $(LIBRARIES); } >/dev/null 2>&1; then :; \
	else echo "some tests will be skipped; on Debian: apt-get install $(LIBRARIES)"; fi
	@touch $@

setup: $(VENV)/.installed  ## make .venv with .venv/bin/mirrorwave

setup-dev: $(VENV)/.installed-dev  ## the same with training, tests and linters

demo: setup  ## a simulated corner through the whole graph: hidden objects beside truth, and a picture
	$(BIN)/mirrorwave demo

# a run of tests is ended when it takes longer; pyproject.toml has the limit of a single test
TEST_LIMIT_S ?= 5400
CORES := $(shell getconf _NPROCESSORS_ONLN)
# one more than there are cores: that many compute while the first waits for the processes that its tests start
WORKERS ?= $(shell echo $$(($(CORES) + 1)))
# in workers: what a worker dies of, pytest outlives and names. tests/scheduling.py has their order.
PYTEST = timeout --foreground --verbose --kill-after 300 $(TEST_LIMIT_S) $(BIN)/python -m pytest -q -n $(WORKERS) --dist loadfile
# where a machine forbids it (containers often do) every process that a test starts would compile all modules again
unexport PYTHONDONTWRITEBYTECODE

test: setup-dev  ## all tests
	$(PYTEST)

# nothing to wait for
test-fast: WORKERS := $(CORES)
test-fast: setup-dev  ## all tests but those that start processes (graph) or compute for half a second or more (slow)
	$(PYTEST) -m "not graph and not slow"

# forming, detection, geometry, evidence and tracking; what they say and how it travels; the nodes that wire them
ROAD := tests/models/perception tests/msgs/bus tests/msgs/values tests/nodes/inputs $(wildcard tests/nodes/test_*.py)

test-road: setup-dev  ## the tests of the way from beams to hidden objects: perception, messages, bus, nodes
	$(PYTEST) $(ROAD)

style: setup-dev  ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

lint: style  ## style, types, house laws
	$(BIN)/python -m pytest -q tests/test_house.py

# pip-audit knows its service. One that answers without advisories would find nothing, whatever is installed: a package
# with known vulnerabilities is asked for first.
AUDIT := $(VENV)/audit/bin/pip-audit
KNOWN_VULNERABLE := pip==24.0
# exit code where no advisory service answers
UNREACHED ?= 3

audit: setup-dev  ## known vulnerabilities of all that is installed (needs an advisory service)
	@{ test -x $(AUDIT) || { $(PYTHON) -m venv $(VENV)/audit && $(VENV)/audit/bin/pip install --quiet pip-audit; }; } >/dev/null 2>&1; \
	echo '$(KNOWN_VULNERABLE)' | $(AUDIT) --no-deps --disable-pip --format json -r /dev/stdin 2>/dev/null | grep -q '"id"' \
	|| { echo "audit: no advisory service answers; nothing was checked"; exit $(UNREACHED); }; \
	$(AUDIT) --progress-spinner off --path $$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')

# uv resolves for all versions of Python and kinds of processors at once
LOCK = $(VENV)/lock/bin/uv pip compile --quiet --upgrade --universal --prerelease disallow --generate-hashes --no-header --no-annotate --no-emit-index-url --python-version 3.11 pyproject.toml -

lock:  ## requirements.lock and requirements-dev.lock: the newest versions that pyproject.toml allows, with their checksums
	@test -x $(VENV)/lock/bin/uv || { $(PYTHON) -m venv $(VENV)/lock && $(VENV)/lock/bin/pip install --quiet uv; }
	echo 'hatchling>=1.27' | $(LOCK) --output-file requirements.lock
	@# torch is left out, what it needs is not
	echo 'torch; sys_platform == "none"' >$(VENV)/lock/without.txt
	printf 'filelock\nfsspec\nnetworkx\nsympy\n' | $(LOCK) --extra dev --constraint requirements.lock --override $(VENV)/lock/without.txt --no-emit-package torch --output-file requirements-dev.lock

stability: setup-dev  ## the hard cases with the errors of the naive form and of ours: docs/results/numerical-stability.md
	$(BIN)/python -m pytest -q tests/stability --stability-page docs/results/numerical-stability.md

site: export NO_MKDOCS_2_WARNING = 1
site: setup-dev  ## the pages under docs/ as a site in build/site; a broken link is an error
	$(BIN)/mkdocs build --strict --quiet

reference: setup  ## commands, parameters and messages as pages in docs/reference, written from the code
	$(BIN)/python -m mirrorwave.reference docs/reference

bench: setup-dev  ## the live graph, measured for a minute
	$(BIN)/python -m benchmarks.live.live_graph --duration 60

soak: setup-dev  ## the whole graph at the real rate for an hour, with random kills: docs/results/README.md
	$(BIN)/python -m benchmarks.live.soak --figure runs/soak.png

# examples of each test of a node; seconds that all readers share
FUZZ_EXAMPLES ?= 2000
FUZZ_SECONDS ?= 3600

fuzz: setup-dev  ## nodes against messages and parameters, then readers against bytes: docs/results/README.md (hours)
	@$(BIN)/python -c "import atheris" 2>/dev/null || $(BIN)/pip install --quiet --editable '.[fuzz]'
	@# readers are looked at whatever was found in nodes
	$(BIN)/python -m fuzz.nodes --examples $(FUZZ_EXAMPLES) --json runs/fuzz/nodes.json; found=$$?; \
	$(BIN)/python -m fuzz --seconds $(FUZZ_SECONDS) --json runs/fuzz/readers.json && exit $$found

# ROOM: a folder or module; MUTANTS: bugs drawn of all that are possible. In a copy, since it changes the code.
MUTANTS ?= 60
COSMIC_RAY := $(abspath $(VENV)/mutants/bin)

mutants: setup-dev  ## bugs put into a room one by one, and those that its own tests miss: make mutants ROOM=models/vehicle
	@test -e "$(ROOM)" || { echo "make mutants ROOM=models/vehicle"; exit 2; }
	@test -x $(COSMIC_RAY)/cosmic-ray || { $(PYTHON) -m venv $(VENV)/mutants && $(COSMIC_RAY)/pip install --quiet 'cosmic-ray>=8.4'; }
	@rm -rf build/mutants && mkdir -p build/mutants && git archive HEAD | tar -x -C build/mutants
	@printf '%s\n' '[cosmic-ray]' 'module-path = "$(ROOM)"' 'timeout = 300.0' 'excluded-modules = []' \
	    'test-command = "$(abspath $(BIN))/python -m pytest -x -q -n 0 -m \"not graph\" tests/$(if $(wildcard tests/$(ROOM)),$(ROOM),$(dir $(ROOM)))"' \
	    '[cosmic-ray.distributor]' 'name = "local"' \
	    '[cosmic-ray.filters.operators-filter]' 'exclude-operators = ["core/ReplaceBinaryOperator_BitOr_.*"]' > build/mutants/session.toml
	@# no unions of types
	@cd build/mutants && $(COSMIC_RAY)/cosmic-ray init session.toml session.sqlite && $(COSMIC_RAY)/cr-filter-operators session.sqlite session.toml
	@cd build/mutants && $(COSMIC_RAY)/python -c 'import sqlite3; session = sqlite3.connect("session.sqlite"); session.execute("delete from work_items where job_id not in (select job_id from work_items order by random() limit $(MUTANTS))"); session.commit()'
	cd build/mutants && $(COSMIC_RAY)/cosmic-ray exec session.toml session.sqlite
	cd build/mutants && $(COSMIC_RAY)/cr-report --surviving-only --show-diff session.sqlite

tables: setup  ## the shipped reflectance table, simulated again (minutes; goes on if stopped)
	$(BIN)/mirrorwave sim reflectance --rebuild --workers 2

sample: setup  ## the shipped sample capture, simulated again: docs/guides/first-look.md
	$(BIN)/python -m benchmarks.simulator.sample_capture

pictures: setup  ## the pictures of README, first look and walls again, by the present default (minutes); others: compare, full-wave
	mkdir -p runs/pictures
	$(BIN)/mirrorwave sim reflectance --plot docs/images/fdtd_reflectance.png
	$(BIN)/mirrorwave sim run launch/scenes/two_hidden_vehicles.yaml --out runs/pictures/two.mcap --scans 1
	$(BIN)/mirrorwave process runs/pictures/two.mcap --out runs/pictures/two
	$(BIN)/mirrorwave process --sample --out runs/pictures/first-look
	cp runs/pictures/two/bev.png docs/images/two-hidden-vehicles.png
	cp runs/pictures/first-look/bev.png docs/images/first-look.png

full-wave: setup-dev  ## rays against a full-wave solution: docs/results/full-wave.md (half an hour; goes on if stopped)
	$(BIN)/python -m benchmarks.full_wave --table docs/results/full-wave.md --figure docs/images/full-wave.png

compare: setup  ## three sensors over all sweeps, the tables and pictures of docs/explain/sensors.md (half an hour; goes on if stopped)
	$(BIN)/mirrorwave compare --viewpoints 6 --workers 2 --out runs/compare
	$(BIN)/mirrorwave compare --scene launch/scenes/hidden_car_xband.yaml --out runs/compare
	cp runs/compare/compare.md docs/results/compare.md && cp runs/compare/compare.png docs/images/compare.png
	cp runs/compare/hidden_car_xband.png docs/images/three-sensors.png

results-gpu: setup-dev  ## the networks at full size and ours from data drawn meanwhile, on one GPU and many cores (8 minutes; goes on if stopped)
	$(BIN)/python -m benchmarks.accuracy.full_size --work runs/full_size --out runs/full_size/results

OBJECT_DATA := data/object
OBJECT_VALIDATION := --validation $(OBJECT_DATA)_places_validation --validation $(OBJECT_DATA)_drives_validation
DRAW := $(BIN)/mirrorwave sim dataset --workers 2

# the committed networks are of this recipe in smaller steps, each from the weights of the one before (see their cards)
object-network: setup-dev  ## field, evidence and candidate network from places and drives drawn for them (half a day on two cores; goes on if stopped)
	$(DRAW) --out $(OBJECT_DATA)_places --count 2000 --effects all --truth --seed 6100
	$(DRAW) --out $(OBJECT_DATA)_places_2 --count 8000 --effects all --truth --seed 6102
	$(DRAW) --out $(OBJECT_DATA)_places_3 --count 8000 --effects all --truth --seed 6103
	$(DRAW) --out $(OBJECT_DATA)_drives --count 200 --scans 8 --seed 6200
	$(DRAW) --out $(OBJECT_DATA)_places_5 --count 8000 --truth --seed 6106
	$(DRAW) --out $(OBJECT_DATA)_places_6 --count 6000 --truth --seed 6107
	$(DRAW) --out $(OBJECT_DATA)_places_7 --count 8000 --truth --seed 6109
	$(DRAW) --out $(OBJECT_DATA)_places_hard --count 2500 --truth --shift hard --seed 6108
	$(DRAW) --out $(OBJECT_DATA)_drives_5 --count 480 --scans 8 --seed 6205
	$(DRAW) --out $(OBJECT_DATA)_drives_6 --count 300 --scans 8 --seed 6206
	$(DRAW) --out $(OBJECT_DATA)_places_validation --count 1000 --effects all --truth --seed 6112
	$(DRAW) --out $(OBJECT_DATA)_drives_validation --count 200 --scans 8 --seed 6210
	$(BIN)/mirrorwave train objects $(OBJECT_VALIDATION) --out runs/objects_first --workers 2 --threads 2 --epochs 4 \
		$(addprefix --data $(OBJECT_DATA)_,places places_2 places_3 drives)
	$(BIN)/mirrorwave train objects $(OBJECT_VALIDATION) --out runs/objects --workers 2 --threads 2 --epochs 5 \
		--init runs/objects_first/evidence_unet.onnx \
		$(addprefix --data $(OBJECT_DATA)_,drives_5 drives_6 places_5 places_6 places_7 places_hard)
	$(BIN)/mirrorwave export runs/objects/evidence_unet.onnx --precision int8 --data $(OBJECT_DATA)_places_5 \
		--out runs/objects/evidence_unet.int8.onnx
	$(DRAW) --out $(OBJECT_DATA)_places_9 --count 6000 --truth --seed 6113
	$(DRAW) --out $(OBJECT_DATA)_places_hard_9 --count 1500 --truth --shift hard --seed 6114
	$(DRAW) --out $(OBJECT_DATA)_drives_9 --count 400 --scans 8 --seed 6213
	$(BIN)/mirrorwave train candidates runs/objects/evidence_unet.onnx --out runs/candidates --workers 2 --threads 2 --seed 2 $(OBJECT_VALIDATION) \
		$(addprefix --data $(OBJECT_DATA)_,drives_5 drives_6 drives_9 places_5 places_6 places_7 places_9 places_hard places_hard_9)
	$(BIN)/mirrorwave train candidates runs/objects/evidence_unet.int8.onnx --out runs/candidates_int8 --workers 2 --threads 2 \
		--model models/weights/compact_unet.int8.onnx $(OBJECT_VALIDATION) \
		$(addprefix --data $(OBJECT_DATA)_,drives_5 drives_6 drives_9 places_5 places_6 places_7 places_9 places_hard places_hard_9)
	$(BIN)/mirrorwave train probabilities runs/objects/evidence_unet.onnx --flip-test --out runs/probabilities --workers 2 \
		$(OBJECT_VALIDATION)
	$(BIN)/mirrorwave train probabilities runs/objects/evidence_unet.int8.onnx --out runs/probabilities_int8 --workers 2 \
		--model models/weights/compact_unet.int8.onnx $(OBJECT_VALIDATION)

clean:  ## forget the virtual environment and caches
	rm -rf $(VENV) build *.egg-info .pytest_cache .mypy_cache .ruff_cache
