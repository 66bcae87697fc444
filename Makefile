# make demo   a scene made, trained, rendered and scored
# make test   lint, format check, C++ tests of the CPU, pytest but for slow tests: three to five minutes
# make check  make test, CUDA kernels emulated, and slow tests, but neither browser nor npm
# make check-core, check-applications   the Python tests of make check in two halves: those of the core, in a copy of the
#             repository without applications and benchmarks; and those that need these. `.ci/run` has them in place of check
# make test-aarch64, test-windows, test-macos   the C++ tests, built for another platform and run under an emulator
# make test-browser   the tests that need Chromium, which is installed first where Debian's package manager may be used;
#             without npm, those of other people's viewers skip
# make test-foreign   the tests by programs of npm that read our exports; they skip without npm
# make format rewrites what the format check would complain about
# make wheels a wheel for every torch from 2.10 and every Python, one with CUDA kernels where nvcc is found, and the
#             source distribution: build/wheels
# make gate   three trainings against the stored baseline: quality and, beside an older build, time; takes minutes
# make docs   the site, build/site/index.html; a dead link or a page outside of the navigation fails
# All set up .venv first: pinned requirements and the three extensions, again only when their sources have changed.
# The site needs neither and has an environment of its own, .venv-docs.
# Variables: PYTHON (3.10 or newer); CXX, GS_CUDA, CUDA_HOME as in submodules/common/build_extension.py (after a change
# of these `rm .venv/.built-*`).

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DOCS_VENV := .venv-docs
CHECK_PYTHON := import sys; sys.exit(sys.version_info < (3, 10) and "Python 3.10 or newer is needed: make PYTHON=...")
EXTENSIONS := simple-knn fused-ssim diff-gaussian-rasterization
CXX_TESTS := $(patsubst submodules/%.cpp,build/%,$(wildcard submodules/*/csrc/tests/*.cpp))
CXX_TEST_OBJECTS := $(patsubst submodules/%.cpp,build/%.o,$(shell find submodules/*/csrc -path '*/cpu/*.cpp'))
CORES := $(shell nproc 2> /dev/null || getconf _NPROCESSORS_ONLN)
# The address sanitizer sees what the checks see that are left out, which take a third of the compiler's time.
CXX_TEST_FLAGS := -std=c++17 -O1 -Wall -Wextra -Werror -fsanitize=address,undefined -fno-sanitize-recover=all -pthread \
                  -fno-sanitize=null,object-size,pointer-overflow

CXX_SOURCES := $(shell find submodules -name build -prune -o \( -name '*.cpp' -o -name '*.cu*' -o -name '*.h' \) -print)
# What the extension $(1) is built from.
sources = $(shell find submodules/common submodules/$(1) \( -name build -o -name tests -o -name emulation \) -prune -o \
            \( -name '*.cpp' -o -name '*.cu*' -o -name '*.h' -o -name '*.py' -o -name '*.toml' \) -print)

.PHONY: install demo test check check-core check-applications test-aarch64 test-windows test-macos test-browser test-foreign lint format docs wheels gate
.PHONY: clean cpp-test cpp-test-cpu demo-plan
unexport PYTHONDONTWRITEBYTECODE  # else each of hundreds of processes compiles the same modules
ifndef PARALLEL  # which C++ tests set
.NOTPARALLEL:
endif

install: $(EXTENSIONS:%=$(VENV)/.built-%)

# Python compiles what is imported; pip would compile all of torch, which takes 20 seconds.
$(VENV)/.requirements: requirements.txt requirements-dev.txt
	@$(PYTHON) -c '$(CHECK_PYTHON)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --no-compile -r requirements-dev.txt
	@touch $@

.SECONDEXPANSION:
$(VENV)/.built-%: $(VENV)/.requirements version.txt $$(call sources,$$*)
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation ./submodules/$*
	@touch $@

demo: demo-plan install output/demo_scene
	$(BIN)/python train.py -s output/demo_scene -m output/demo --eval --iterations 1500 --test_iterations 1500
	$(BIN)/python render.py -m output/demo --skip_train
	$(BIN)/python metrics.py -m output/demo
	$(BIN)/python -m applications.demo.report output/demo

demo-plan:
	@echo 'The demo makes a ray-traced scene, trains 1,500 iterations, renders and scores the test views:'
	@echo 'one to three minutes on two cores, and one to four more to set up .venv if it is missing.'

output/demo_scene: | install
	$(BIN)/python -m applications.demo.make_scene $@

# More processes than cores, as some wait. test-foreign has the tests that are ignored. What takes long is named.
PYTEST := $(CURDIR)/$(BIN)/python -m pytest --numprocesses $(shell expr $(CORES) + 1) --maxprocesses 5 --dist worksteal \
          --durations 25 --durations-min 5 --ignore applications/export/tests/test_exports_foreign.py
test: install lint cpp-test-cpu
	$(PYTEST) -m 'not browser and not slow'

check: install lint cpp-test
	$(PYTEST) -m 'not browser'

check-core: install
	rm -rf build/core && mkdir -p build/core
	tar -c --exclude ./applications --exclude ./benchmarks --exclude ./build --exclude ./.git --exclude './.venv*' \
	    --exclude node_modules --exclude ./output --exclude ./eval . | tar -x -C build/core
	cd build/core && GS_SHARED="$${GS_SHARED:-$(CURDIR)/../shared}" $(PYTEST) -m 'not browser'

check-applications: install
	GS_TESTS=applications $(PYTEST) -m 'not browser'

test-aarch64 test-windows test-macos:
	$(PYTHON) .ci/cross.py $(@:test-%=%)

test-browser: install
	tests/browser/install.sh
	@if command -v npm > /dev/null; then cd tests/browser && npm ci --ignore-scripts --no-audit --no-fund --silent; fi
	$(BIN)/python -m pytest -m browser tests/browser

test-foreign: install
	@if command -v npm > /dev/null; then cd tests/foreign && npm ci --ignore-scripts --no-audit --no-fund --silent; fi
	PATH="$(CURDIR)/tests/foreign/node_modules/.bin:$$PATH" $(BIN)/python -m pytest applications/export/tests/test_exports_foreign.py \
	    applications/export/tests/test_tileset.py tests/browser/test_streamed.py

lint: $(VENV)/.requirements
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/clang-format --dry-run -Werror $(CXX_SOURCES)
	PATH="$(CURDIR)/$(BIN):$$PATH" .ci/lint

format: $(VENV)/.requirements
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/clang-format -i $(CXX_SOURCES)

# A test that has passed is run again only when it was built again.
CXX_EMULATED := $(filter %_emulated,$(CXX_TESTS))
cpp-test: TESTS := $(CXX_TESTS)
cpp-test-cpu: TESTS := $(filter-out $(CXX_EMULATED),$(CXX_TESTS))
cpp-test cpp-test-cpu:
	@$(MAKE) --no-print-directory -j $(CORES) PARALLEL=1 $(TESTS:%=%.passed)

build/%.passed: build/%
	$<
	@touch $@

# Compiles for the submodule $(1); sources and more flags follow.
compile = $(CXX) $(CXX_TEST_FLAGS) -Isubmodules/$(1)/csrc -Isubmodules/common/include -Isubmodules/common/tests
# The submodule of SUBMODULE/..., its objects, and the headers of a test.
submodule = $(firstword $(subst /, ,$(1)))
objects = $(filter build/$(1)/%,$(CXX_TEST_OBJECTS))
test_headers = $(wildcard submodules/$(dir $(1))*.h submodules/common/tests/gs/*.h)

# CUDA kernels on the CPU: the .cu files, rewritten as C++, instead of a GPU. $(1): a submodule.
EMULATION := submodules/common/emulation
EMULATION_FILES := $(shell find $(EMULATION) -type f ! -name '*.py*')
EMULATION_FLAGS := -Wno-unknown-pragmas -I$(EMULATION) -iquote$(EMULATION)
translation = build/$(1)/csrc/tests/emulated/translated
kernels = $(patsubst submodules/%.cu,build/%.o,\
          $(subst /csrc/,/csrc/tests/emulated/,$(shell find submodules/$(1)/csrc -name '*.cu')))
compile_emulated = $(call compile,$(1)) -iquotebuild/$(1)/csrc/tests/emulated $(EMULATION_FLAGS)
CXX_EMULATION_OBJECTS := build/emulation.o $(CXX_EMULATED:%=%.o) \
                         $(foreach test,$(CXX_EMULATED:build/%=%),$(call kernels,$(call submodule,$(test))))

build/%_emulated: build/%_emulated.o build/emulation.o $$(call kernels,$$(call submodule,$$*)) \
                  $$(call objects,$$(call submodule,$$*))
	$(CXX) $(CXX_TEST_FLAGS) $^ -o $@

build/%_emulated.o: submodules/%_emulated.cpp $$(call test_headers,$$*) $$(call translation,$$(call submodule,$$*))
	$(call compile_emulated,$(call submodule,$*)) $< -c -o $@

$(filter-out build/emulation.o %_emulated.o,$(CXX_EMULATION_OBJECTS)): build/%.o: $$(call translation,$$(call submodule,$$*))
	$(call compile_emulated,$(call submodule,$*)) build/$*.cpp -c -o $@

build/%/csrc/tests/emulated/translated: $$(call sources,$$*) $(EMULATION_FILES) $(EMULATION)/translate.py
	rm -rf $(@D) && mkdir -p $(@D)
	$(PYTHON) $(EMULATION)/translate.py submodules/$*/csrc $(@D)
	@touch $@

build/emulation.o: $(EMULATION_FILES) $(wildcard submodules/common/include/gs/*.h)
	@mkdir -p $(@D)
	$(call compile,common) $(EMULATION_FLAGS) $(EMULATION)/emulation.cpp -c -o $@

build/%.o: submodules/%.cpp $$(call sources,$$(call submodule,$$*))
	@mkdir -p $(@D)
	$(call compile,$(call submodule,$*)) $< -c -o $@

build/%: submodules/%.cpp $$(call objects,$$(call submodule,$$*)) $$(call test_headers,$$*)
	@mkdir -p $(@D)
	$(call compile,$(call submodule,$*)) $< $(call objects,$(call submodule,$*)) -o $@

.SECONDARY: $(CXX_TESTS) $(CXX_TEST_OBJECTS) $(CXX_EMULATION_OBJECTS)

wheels: $(VENV)/.requirements
	.ci/wheels $(BIN)/python

gate: install
	$(BIN)/python -m benchmarks.gate

docs: $(DOCS_VENV)/.requirements
	NO_MKDOCS_2_WARNING=true $(DOCS_VENV)/bin/mkdocs build --strict

$(DOCS_VENV)/.requirements: requirements-docs.txt
	@$(PYTHON) -c '$(CHECK_PYTHON)'
	$(PYTHON) -m venv $(DOCS_VENV)
	$(DOCS_VENV)/bin/pip install --quiet --disable-pip-version-check --no-compile -r $<
	@touch $@

clean:
	rm -rf $(VENV) $(DOCS_VENV) build submodules/*/build submodules/*/*.egg-info
